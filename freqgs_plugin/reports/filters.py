"""Filters side by side: pictures of each from several views, and how far it is the same from a step aside."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.apps.filters import Filter
from freqgs_plugin.rendering.render import render
from freqgs_plugin.reports.contact_sheet import Picture
from freqgs_plugin.reports.drawing import HeldOutView, TrainedRun
from freqgs_plugin.types import Camera, Gaussians, Rendering

PLAIN = "plain"
SAME_DEPTH = 0.02
"""share of the depth by which a point seen from another view may lie off and still count as the same surface"""
STEP = 0.05
"""how far aside, share of the picture's median depth"""
OPAQUE = 0.9
"""alpha from which a pixel shows a surface"""


@dataclass(frozen=True)
class FilterRow:
    """One filter."""

    name: str
    gaussians: int
    changed: float
    """RMSE against the plain picture of the same view, over all views"""
    step_aside: float | None
    """RMSE of the pictures against those from a step aside, of the surfaces that both show; None: there are none"""
    shared: float
    """share of the pixels that show such surfaces"""


Sheet = list[tuple[str, list[tuple[str, Picture]]]]
"""a row per view, as `contact_sheet.write_sheet` takes them"""


def draw_filters(
    run: TrainedRun, views: Sequence[HeldOutView], filters: Mapping[str, Filter],
    tick: Callable[[], object] = lambda: None,
) -> tuple[list[FilterRow], Sheet]:  # fmt: skip
    """Each filter measured, and its pictures: a row per view, a column per filter, the plain scene first.

    Each filter is applied once, and its pictures are of that one scene. `tick` is called after each scene.

    Raises:
        ValueError: no views, or a filter cannot be applied.
    """
    if not views:
        raise ValueError("no views for a contact sheet; choose at least one.")
    scenes = {PLAIN: run.gaussians, **{name: make(run.gaussians) for name, make in filters.items()}}
    cameras = [view.camera for view in views]

    @torch.no_grad()
    def draw(scene: Gaussians, camera: Camera) -> Rendering:
        look = {"rasterizer": run.rasterizer, "background": run.background, "antialiased": run.antialiased}
        return render(scene, camera, **look)

    rows, plain, sheet = [], [], [(Path(view.name).stem, []) for view in views]
    for name, scene in scenes.items():
        drawn = [draw(scene, camera) for camera in cameras]
        plain = plain or drawn
        rows.append(_row(name, scene, draw, cameras, drawn, plain))
        for (_, pictures), rendering in zip(sheet, drawn, strict=True):
            pictures.append((name, rendering.features.clamp(0, 1).float().cpu().numpy()))
        tick()
    return rows, sheet


def _row(
    name: str, scene: Gaussians, draw: Callable[[Gaussians, Camera], Rendering], cameras: Sequence[Camera],
    drawn: Sequence[Rendering], plain: Sequence[Rendering],
) -> FilterRow:  # fmt: skip
    pairs = zip(drawn, plain, strict=True)
    changed = [(a.features.clamp(0, 1) - b.features.clamp(0, 1)).square().mean() for a, b in pairs]
    squares, count, pixels = 0.0, 0, 0
    for camera, here in zip(cameras, drawn, strict=True):
        aside = stepped_aside(camera, STEP * float(here.depth.median()))
        colours, seen = seen_from(aside, draw(scene, aside), camera, here)
        squares += float((colours - here.features.clamp(0, 1))[seen].square().mean(-1).sum())
        count, pixels = count + int(seen.sum()), pixels + seen.numel()
    aside = (squares / count) ** 0.5 if count else None
    return FilterRow(name, len(scene), float(torch.stack(changed).mean().sqrt()), aside, count / pixels)


def stepped_aside(camera: Camera, step: float) -> Camera:
    """The camera moved to its right by `step`, world units; it looks the same way."""
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] -= step
    return replace(camera, viewmat=viewmat)


def seen_from(
    other: Camera, picture: Rendering, camera: Camera, here: Rendering
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """The colours that `picture`, as `other` saw it, has for what each pixel of `camera` shows; and where it shows it.

    Pixels are taken to the world by the depth `here`, and onto `other`; where that lies outside, or the depth there is
    another one by more than SAME_DEPTH, something hides the point, or there is no surface.
    """
    depth = here.depth[..., 0].double()
    y, x = torch.meshgrid(
        torch.arange(camera.height, device=depth.device) + 0.5,
        torch.arange(camera.width, device=depth.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([x, y, torch.ones_like(x)], -1).double()
    points = (pixels @ torch.linalg.inv(camera.K.double()).T) * depth[..., None]
    motion = other.viewmat.double() @ torch.linalg.inv(camera.viewmat.double())
    points = points @ motion[:3, :3].T + motion[:3, 3]
    z = points[..., 2]
    front = z > 0
    projected = points @ other.K.double().T / torch.where(front, z, 1.0)[..., None]
    grid = projected[..., :2] / torch.tensor([other.width, other.height], device=depth.device) * 2 - 1
    stack = torch.cat([picture.features.clamp(0, 1), picture.depth, picture.alpha], -1).double()
    found = torch.nn.functional.grid_sample(stack.permute(2, 0, 1)[None], grid[None], align_corners=False)[0]
    there, alpha = found[3], found[4]
    inside = (grid.abs() < 1).all(-1) & front
    same = (there - z).abs() < SAME_DEPTH * z
    opaque = (alpha > OPAQUE) & (here.alpha[..., 0] > OPAQUE)
    return found[:3].permute(1, 2, 0).to(here.features), inside & same & opaque


def spread(count: int, wanted: int) -> list[int]:
    """`wanted` of `count` places, evenly, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, wanted).round().astype(int)).tolist()
