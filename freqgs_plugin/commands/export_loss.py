"""What a written file loses: it is read back, drawn as its consumers draw it, and compared with our own pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from freqgs_plugin.commands.export_source import Source
from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.plain_ply import read_plain
from freqgs_plugin.reports.tables import psnr
from freqgs_plugin.types import Camera

_SAME = 120.0
"""dB from which on only rounding differs: a thousandth of what 8 bit can tell"""


@dataclass(frozen=True)
class Shown:
    """Pictures by one kind of viewer."""

    to_ours: float
    """PSNR against our own pictures, dB"""
    to_photographs: float
    """PSNR against the photographs, dB"""

    @property
    def same(self) -> bool:
        """They differ from our own pictures by rounding only."""
        return self.to_ours >= _SAME


@dataclass(frozen=True)
class Loss:
    """Means over the views."""

    views: int
    ours: float
    """our own pictures' PSNR against the photographs, dB"""
    mip: Shown | None
    """by viewers that heed `SplatRenderMode: mip`; None: the file is not for these"""
    classic: Shown
    """by all others"""

    @property
    def best(self) -> Shown:
        """By the viewers that the file is for."""
        return self.mip or self.classic

    @property
    def lost(self) -> float:
        """What photographs lose by the viewers that the file is for, dB."""
        return self.ours - self.best.to_photographs

    def json(self) -> dict[str, Any]:
        """Numbers; the PSNR is null where pictures are the same."""

        def shown(pictures: Shown | None) -> dict[str, Any] | None:
            if pictures is None:
                return None
            return {
                "psnr_to_our_pictures": None if pictures.same else round(pictures.to_ours, 3),
                "same_pictures": pictures.same,
                "psnr_to_photographs": round(pictures.to_photographs, 3),
                "psnr_lost": round(self.ours - pictures.to_photographs, 3),
            }

        return {
            "views": self.views,
            "our_psnr_to_photographs": round(self.ours, 3),
            "mip_viewers": shown(self.mip),
            "classic_viewers": shown(self.classic),
        }


@dataclass(frozen=True)
class Written:
    """A file or folder that an export wrote."""

    path: Path
    count: int
    """Gaussians"""
    loss: Loss | None
    """None: it is no picture of its own"""
    seconds: float
    """to make, write and measure it"""
    note: str = ""

    @property
    def size(self) -> int:
        """Bytes."""
        files = self.path.rglob("*") if self.path.is_dir() else [self.path]
        return sum(file.stat().st_size for file in files if file.is_file())

    def json(self) -> dict[str, Any]:
        loss = None if self.loss is None else self.loss.json()
        return {"gaussians": self.count, "bytes": self.size, "loss": loss, "note": self.note}


@torch.no_grad()
def measure_loss(path: Path, source: Source, mip: bool, move: Similarity) -> Loss:
    """Read the PLY at `path` and draw it as viewers do, those that compensate opacities (`mip`) and those that do not.

    `move` leads from the scene's frame to the file's. Pictures are clamped to [0, 1], as screens do.
    """
    scene = read_plain(path, source.scene.background.device)
    cameras = [moved(view.camera, move) for view in source.views]

    photographs = [view.image.to(scene.means) for view in source.views]

    def shown(antialiased: bool) -> Shown:
        pictures = []
        for camera in cameras:
            rendering = source.scene.rasterizer(
                scene.splats(camera), camera, background=source.scene.background, antialiased=antialiased, depth=False
            )
            pictures.append(rendering.features.clamp(0, 1))
        return Shown(mean_psnr(pictures, source.pictures), mean_psnr(pictures, photographs))

    ours = mean_psnr(source.pictures, photographs)
    return Loss(len(cameras), ours, shown(True) if mip else None, shown(False))


def mean_psnr(pictures: Sequence[torch.Tensor], targets: Sequence[torch.Tensor]) -> float:
    """Mean over pairs of pictures in [0, 1], dB."""
    return sum(psnr(a, b) for a, b in zip(pictures, targets, strict=True)) / len(pictures)


def moved(camera: Camera, move: Similarity) -> Camera:
    """The same view of the moved scene, x -> s (R x + t): its depths are s times as large."""
    if move.is_identity():
        return camera
    old = camera.viewmat.double().cpu()
    rotation = old[:3, :3] @ move.rotation.T
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = move.scale * (old[:3, 3] - rotation @ move.translation)
    return replace(camera, viewmat=viewmat.to(camera.viewmat))
