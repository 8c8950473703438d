"""Everything that knows nerfstudio."""
