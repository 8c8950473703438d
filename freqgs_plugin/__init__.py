"""freqgs: level of detail for Gaussian splatting, inside nerfstudio."""

__version__ = "0.1.0"
