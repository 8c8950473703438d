"""What there is to draw: a trained run or a PLY, with a background and cameras."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.io.parameters import RawGaussians
from freqgs_plugin.io.ply import read_ply
from freqgs_plugin.rendering.base import Rasterizer, get_rasterizer
from freqgs_plugin.reports.bench.trained import load, views_of_split
from freqgs_plugin.training.presets import LARGEST_SCALE
from freqgs_plugin.types import Camera, Gaussians

MOST_PIXELS = 1 << 28
"""of a picture: 16384 x 16384, for which about 10 GB of memory are taken"""


@dataclass(frozen=True)
class Scene:
    """Gaussians and how they are drawn."""

    gaussians: Gaussians
    background: Float[Tensor, " 3"]
    rasterizer: Rasterizer
    antialiased: bool
    scene_distance: float | None
    """what decay divides distances by, world units; None: not known"""
    run: Any = None
    """`studio.checkpoint.Run`; None for a file alone"""

    @property
    def largest_scale(self) -> float:
        """The largest distance scale that decays were trained for; of a file alone that is not known: the default's."""
        trained = None if self.run is None else self.run.largest_scale
        return LARGEST_SCALE if trained is None else trained


def open_scene(load_config: Path | None, ply: Path | None, rasterizer: str) -> Scene:
    """The Gaussians of `ply` where it is given, else of the run; with both, everything else is the run's.

    Raises:
        ValueError: neither is given.
        FileNotFoundError, BenchError, SplatFileError: they cannot be read.
    """
    if load_config is None and ply is None:
        raise ValueError("nothing to draw: give --load-config RUN/config.yml, or --ply FILE.")
    run = None if load_config is None else load(load_config)
    if ply is None:
        assert run is not None
        chosen = run.rasterizer if rasterizer == "auto" else get_rasterizer(rasterizer, run.background.device)
        return Scene(run.gaussians, run.background, chosen, run.antialiased, run.scene_distance, run)
    raw, summary = read_ply(ply)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    chosen = get_rasterizer(rasterizer, device, absgrad=False)
    if run is None:
        antialiased = bool(summary.antialiased)
        return Scene(activated(raw, device), torch.zeros(3, device=device), chosen, antialiased, None)
    antialiased = run.antialiased if summary.antialiased is None else summary.antialiased
    return Scene(activated(raw, device), run.background.to(device), chosen, antialiased, run.scene_distance, run)


def activated(raw: RawGaussians, device: str = "cpu") -> Gaussians:
    """Gaussians from stored parameters. Colours of a file are unsigned; without levels it has one."""
    level = torch.ones(len(raw), dtype=torch.int32) if raw.level is None else raw.level.int()
    return Gaussians(
        means=raw.means.to(device),
        quats=raw.quats.to(device),
        scales=raw.scales.exp().to(device),
        opacities=raw.opacities.sigmoid().squeeze(-1).to(device),
        features_dc=raw.features_dc.to(device),
        features_rest=raw.features_rest.to(device),
        level=level.to(device),
        signed_residuals=False,
        decay=None if raw.decay is None else raw.decay.to(device),
    )


@dataclass(frozen=True)
class Shot:
    """Cameras in order, and what they are called."""

    cameras: list[Camera]
    names: list[str]
    fps: float | None = None
    """frames per second of a camera path; None: single views"""


def shots(scene: Scene, path: Path | None, split: Literal["test", "train"], size: tuple[int, int] | None) -> Shot:
    """The views of `path`, a camera path of nerfstudio's viewer, or of the run's split; at `size` (w, h) if given.

    Raises:
        ValueError: a file alone without a path, or no views in the split.
    """
    if path is not None:
        from freqgs_plugin.studio.camera_path import read_camera_path

        found = read_camera_path(path)
        shot = Shot(found.cameras, [f"frame_{i:05d}" for i in range(len(found.cameras))], found.fps)
    elif scene.run is None:
        raise ValueError("a PLY has no cameras: give --path FILE (saved in the viewer), or --load-config of its run.")
    else:
        views = views_of_split(scene.run, split)
        if not views:
            raise ValueError(f"the run has no views in the split '{split}'; choose the other one, or give --path.")
        shot = Shot([view.camera for view in views], [Path(view.name).stem for view in views])
    for camera in shot.cameras[: 0 if size is not None else None]:
        check_size(camera.width, camera.height)
    device = scene.gaussians.means.device
    cameras = [replace(c, viewmat=c.viewmat.to(device), K=c.K.to(device)) for c in shot.cameras]
    return replace(shot, cameras=cameras if size is None else [resized(c, *size) for c in cameras])


def check_size(width: int, height: int) -> None:
    """Refuse, with a ValueError, pictures without a pixel, and with so many that no machine draws them."""
    if min(width, height) < 1:
        raise ValueError(f"size is {width}x{height}; both must be at least 1 px.")
    if width * height > MOST_PIXELS:
        raise ValueError(
            f"size is {width}x{height}, {width * height / 1e6:,.0f} million pixels; give a --size of at most "
            f"{MOST_PIXELS / 1e6:,.0f} million."
        )


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The same field of view across, square pixels, at `width` x `height` px."""
    factor = width / camera.width
    K = camera.K.clone()
    K[:2] *= factor
    K[1, 2] += (height - factor * camera.height) / 2
    return Camera(camera.viewmat, K, width, height)
