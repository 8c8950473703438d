"""What is exported: the Gaussians of a run, how we draw them, and the views that a loss is measured on."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.commands.export_options import ExportOptions
from freqgs_plugin.commands.scene import Scene, open_scene
from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.rendering.render import render
from freqgs_plugin.reports.bench.trained import views_of, views_of_split
from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.types import Camera, Gaussians


@dataclass(frozen=True)
class Source:
    """Gaussians of a run, in its scene's frame: finite ones, inside of the crop, up to a level."""

    scene: Scene
    raw: RawGaussians
    """as they are trained"""
    gaussians: Gaussians
    """the same rows, activated"""
    attenuation: Attenuation | None
    """with which we draw them"""
    views: list[HeldOutView]
    """that losses are measured on"""
    cameras: list[Camera]
    """training views"""
    frame: Similarity
    """from the data set's frame to the scene's"""
    left_out: str = ""
    """what is not exported and why; empty: nothing"""

    @property
    def levels(self) -> int:
        """The finest level that holds a Gaussian."""
        return int(self.gaussians.level.max())

    @property
    def signed(self) -> bool:
        """Colours above level 1 are signed residuals, and there are such levels."""
        return self.gaussians.signed_residuals and self.levels > 1

    @property
    def method(self) -> str:
        return self.scene.run.config.method_name

    @property
    def experiment(self) -> str:
        return self.scene.run.config.experiment_name

    @torch.no_grad()
    def picture(self, camera: Camera) -> Float[Tensor, "h w 3"]:
        """Our own picture of these Gaussians, not clamped."""
        return render(
            self.gaussians,
            camera,
            self.attenuation,
            rasterizer=self.scene.rasterizer,
            background=self.scene.background,
            antialiased=self.scene.antialiased,
            depth=False,
        ).features

    @cached_property
    def pictures(self) -> list[Float[Tensor, "h w 3"]]:
        """Our own pictures of `views`, in [0, 1]."""
        return [self.picture(view.camera).clamp(0, 1) for view in self.views]

    def up_to(self, level: int) -> "Source":
        """The prefix of levels."""
        return self if level >= self.levels else self.select(self.gaussians.level <= level)

    def select(self, rows: Bool[Tensor, " n"]) -> "Source":
        return replace(self, raw=select(self.raw, rows), gaussians=self.gaussians.select(rows))


def open_source(options: ExportOptions) -> Source:
    """Load the run and choose its rows.

    Raises:
        ValueError: options that do not fit the scene, or nothing is left to export.
        FileNotFoundError, BenchError: the run cannot be read.
    """
    if options.load_config is None:
        raise ValueError("nothing to export: give --load-config RUN/config.yml.")
    scene = open_scene(options.load_config, None, options.rasterizer)
    run, raw, gaussians = scene.run, scene.run.raw, scene.gaussians
    decays = gaussians.decay is not None
    if not decays and (options.distance is not None or options.detail != 1):
        raise ValueError("--distance and --detail are for scenes with decay; this one has none (use --level).")
    if "decay" in options.extra and not decays:
        raise ValueError("--extra decay: this scene has no decay; train clodsplat, or leave it out.")
    levels = int(gaussians.level.max()) if len(raw) else 0
    if options.level is not None and not 1 <= options.level <= levels:
        raise ValueError(f"--level {options.level}: this scene has levels 1..{levels}.")
    source = Source(
        scene=scene,
        raw=raw,
        gaussians=gaussians,
        attenuation=run.model.attenuation(options.detail) if decays else None,
        views=views_of(run),
        cameras=[view.camera for view in views_of_split(run, "train")],
        frame=run.frame,
    )
    return _chosen(source, options)


def _chosen(source: Source, options: ExportOptions) -> Source:
    raw, said = source.raw, []
    keep = finite(raw)
    if lost := int((~keep).sum()):
        said.append(f"{lost:,} of {len(raw):,} Gaussians hold values that are NaN or infinite")
    if options.crop is not None:
        inside = _inside(raw.means, options.crop)
        if outside := int((keep & ~inside).sum()):
            said.append(f"{outside:,} Gaussians lie outside of the crop")
        keep &= inside
    left_out = "; ".join(said)
    if options.level is not None:
        higher = source.gaussians.level > options.level
        said.append(f"{int((keep & higher).sum()):,} are of levels above {options.level}")
        keep &= ~higher
    if not bool(keep.any()):
        raise ValueError(f"nothing is left to export: {'; '.join(said)}. {_extent(raw)}")
    return replace(source if bool(keep.all()) else source.select(keep), left_out=left_out)


def finite(raw: RawGaussians) -> Bool[Tensor, " n"]:
    """Rows whose every value is finite."""
    values = [getattr(raw, name) for name in GROUPS] + ([] if raw.decay is None else [raw.decay])
    return torch.stack([torch.isfinite(x).reshape(len(raw), -1).all(-1) for x in values]).all(0)


def select(raw: RawGaussians, rows: Bool[Tensor, " n"]) -> RawGaussians:
    """The raw Gaussians at `rows`."""
    chosen: dict[str, Any] = {name: getattr(raw, name)[rows] for name in GROUPS}
    for name in ("level", "decay"):
        value = getattr(raw, name)
        chosen[name] = None if value is None else value[rows]
    return RawGaussians(**chosen)


def _inside(means: Float[Tensor, "n 3"], box: tuple[float, ...]) -> Bool[Tensor, " n"]:
    low, high = means.new_tensor(box[:3]), means.new_tensor(box[3:])
    return ((means >= low) & (means <= high)).all(-1)


def _extent(raw: RawGaussians) -> str:
    means = raw.means[finite(raw)]
    if not len(means):
        return "Go back to an earlier checkpoint."
    low, high = (" ".join(f"{x:.3g}" for x in corner.tolist()) for corner in (means.amin(0), means.amax(0)))
    return f"Centres reach from {low} to {high}: choose a box there."
