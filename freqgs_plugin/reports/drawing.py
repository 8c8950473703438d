"""Pictures of a trained run, as reports show and measure them."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, LevelCut
from freqgs_plugin.functional.harmonics import C0
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.types import Camera, Gaussians, Rendering

# Okabe and Ito, told apart by colour-blind readers: coarse to fine, then again from the start
LEVEL_COLOURS = ((0.90, 0.62, 0.00), (0.34, 0.71, 0.91), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.94, 0.89, 0.26))


@runtime_checkable
class TrainedRun(Protocol):
    """What a report needs of a run (`studio.checkpoint.Run` has it)."""

    @property
    def gaussians(self) -> Gaussians: ...
    @property
    def background(self) -> Float[Tensor, " 3"]: ...
    @property
    def rasterizer(self) -> Rasterizer: ...
    @property
    def num_levels(self) -> int: ...
    @property
    def antialiased(self) -> bool: ...


@runtime_checkable
class HeldOutView(Protocol):
    """A view with its photograph (`studio.checkpoint.View`)."""

    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def image(self) -> Float[Tensor, "h w 3"]:
        """RGB in [0, 1]."""
        ...


@torch.no_grad()
def draw(run: TrainedRun, camera: Camera, attenuation: Attenuation | None = None) -> Rendering:
    """The run's picture, not clamped; `info["drawn"]` counts the Gaussians passed to the rasterizer."""
    return render(
        run.gaussians,
        camera,
        attenuation,
        rasterizer=run.rasterizer,
        background=run.background,
        antialiased=run.antialiased,
        depth=False,
    )


def prefix(run: TrainedRun, camera: Camera, level: float | int) -> Float[Tensor, "h w 3"]:
    """The picture of all levels <= `level`, not clamped."""
    return draw(run, camera, LevelCut(level)).features


def band(run: TrainedRun, camera: Camera, level: int) -> Float[Tensor, "h w 3"]:
    """What `level` adds to the picture: prefix `level` minus the prefix before it, the base as it is; signed."""
    picture = prefix(run, camera, level)
    return picture if level == 1 else picture - prefix(run, camera, level - 1)


def colour_by_level(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians, each in the colour of its level."""
    palette = gaussians.means.new_tensor(LEVEL_COLOURS)
    colours = palette[(gaussians.level.long() - 1) % len(LEVEL_COLOURS)]
    return Gaussians(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        features_dc=(colours - 0.5) / C0,
        features_rest=colours.new_zeros(len(colours), 0, 3),
        level=gaussians.level,
        signed_residuals=False,
    )


@torch.no_grad()
def levels_picture(run: TrainedRun, camera: Camera) -> Float[Tensor, "h w 3"]:
    """The picture in which every Gaussian shows the colour of its level, on black."""
    return render(
        colour_by_level(run.gaussians),
        camera,
        rasterizer=run.rasterizer,
        background=torch.zeros_like(run.background),
        antialiased=run.antialiased,
        depth=False,
    ).features
