"""What `freqgs` does with a trained scene: each command's options, and what brings the parts together for it."""
