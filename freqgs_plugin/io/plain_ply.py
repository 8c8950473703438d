"""A 3DGS PLY as an ordinary viewer takes it: ordinary properties alone, colours clamped at 0.

On purpose this shares no code with `io.ply`, which writes these files: what both agree on is in the file.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.harmonics import basis
from freqgs_plugin.types import Camera, Splats

_TYPES = {
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1", "char": "i1",
    "int8": "i1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4",
    "uint": "<u4", "uint32": "<u4",
}  # fmt: skip


@dataclass(frozen=True)
class PlainScene:
    """What a viewer holds of a file."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """wxyz"""
    scales: Float[Tensor, "n 3"]
    """standard deviations, units of the file"""
    opacities: Float[Tensor, " n"]
    """in [0, 1]"""
    harmonics: Float[Tensor, "n k 3"]
    mip: bool | None
    """what the header's `SplatRenderMode` says; None: nothing"""

    def __len__(self) -> int:
        return self.means.shape[0]

    def splats(self, camera: Camera) -> Splats:
        """For one view: colours are max(SH + 0.5, 0)."""
        offsets = self.means.double() - camera.centre.double()
        directions = (offsets / offsets.norm(dim=-1, keepdim=True).clamp_min(1e-12)).to(self.means.dtype)
        degree = round(self.harmonics.shape[1] ** 0.5) - 1
        colours = (basis(directions, degree)[..., None] * self.harmonics).sum(1) + 0.5
        return Splats(self.means, self.quats, self.scales, self.opacities, colours.clamp_min(0.0))


def read_plain(path: Path, device: torch.device | str = "cpu") -> PlainScene:
    """Read a binary little-endian PLY.

    Raises:
        ValueError: it is no such file, or has fewer rows than it says.
    """
    content = Path(path).read_bytes()
    end = content.find(b"end_header\n")
    if not content.startswith(b"ply\nformat binary_little_endian") or end < 0:
        raise ValueError(f"{path} is no binary little-endian PLY.")
    lines = [line.split() for line in content[:end].decode("ascii").splitlines()]
    count = next(int(words[2]) for words in lines if words[:2] == ["element", "vertex"])
    dtype = np.dtype([(words[2], _TYPES[words[1]]) for words in lines if words[:1] == ["property"]])
    start = end + len(b"end_header\n")
    if len(content) < start + count * dtype.itemsize:
        raise ValueError(f"{path} is shorter than its header says.")
    rows = np.frombuffer(content, dtype, count, start)
    modes = [words[2] for words in lines if words[:2] == ["comment", "SplatRenderMode:"] and len(words) == 3]

    def columns(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([rows[name].astype(np.float32) for name in names], -1)).to(device)

    rest = sum(name.startswith("f_rest_") for name in dtype.names or ())
    per_channel = [columns(f"f_dc_{c}", *(f"f_rest_{c * (rest // 3) + i}" for i in range(rest // 3))) for c in range(3)]
    return PlainScene(
        means=columns("x", "y", "z"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=columns("scale_0", "scale_1", "scale_2").exp(),
        opacities=columns("opacity")[:, 0].sigmoid(),
        harmonics=torch.stack(per_channel, -1),
        mip=None if not modes else modes[-1] == "mip",
    )
