"""Progressive streaming: a scene as chunks, coarse levels first, of which any number that has arrived is a scene."""
