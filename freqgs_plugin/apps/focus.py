"""Detail on one object: which Gaussians belong to it, by a vote over views, and an attenuation that draws it in full.

The Laplacian-pyramid paper lets masks of several views vote by projected centres (`vote_by_centres`). `vote` asks for
more: how much of what a Gaussian adds to the pictures lies within the masks. What is hidden behind the object adds
nothing there, so that view has no say about it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from freqgs_plugin.apps.masks import MaskError, check_masks, read_masks
from freqgs_plugin.apps.visibility import VISIBLE, composite, empty_weights, view_weights
from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.functional.projection import NEAR_PLANE, working_dtype
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.types import Camera, Gaussians


@dataclass(frozen=True)
class Focus:
    """An attenuation: an object in all levels, everything else in the levels up to `outside_level`."""

    rows: Bool[Tensor, " n"]
    """the object's Gaussians"""
    outside_level: int = 1
    """drawn everywhere; 0: the object alone"""

    def __post_init__(self) -> None:
        if self.outside_level < 0:
            raise ValueError(f"outside_level is {self.outside_level}; it must be 0 (the object alone) or a level.")

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        check_rows(gaussians, self.rows)
        shown = self.rows.to(gaussians.level.device) | (gaussians.level <= self.outside_level)
        return shown.to(gaussians.opacities.dtype)


@dataclass(frozen=True)
class Selection:
    """What a vote found."""

    rows: Bool[Tensor, " n"]
    """Gaussians that belong to the object"""
    inside: Float[Tensor, " n"]
    """rendered weight within the masks, summed over pixels and views; of `vote_by_centres`, a number of views"""
    total: Float[Tensor, " n"]
    """the same within the masks and outside of them; 0: seen in no view"""

    @property
    def count(self) -> int:
        """How many Gaussians belong to the object."""
        return int(self.rows.sum())


def vote(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    masks: Sequence[Bool[Tensor, "_ _"]],
    *,
    rasterizer: Rasterizer,
    antialiased: bool = True,
    attenuation: Attenuation | None = None,
    share: float | int = 0.5,
    visible: float | int = VISIBLE,
) -> Selection:
    """The Gaussians of which more than `share` of the rendered weight lies within the masks.

    The rendered weight is that in front-to-back compositing of all levels, summed over pixels and over the views that
    see the Gaussian, so large and near views count more than small ones. One at just `share` does not belong; nor does
    one that no view sees.

    Args:
        gaussians: the scene.
        cameras: one or more views.
        masks: the object in each view [h w].
        rasterizer: what composites; any backend.
        antialiased: as the scene was trained.
        attenuation: the scene is seen under; None: everything is drawn.
        share: in [0, 1).
        visible: a view sees a Gaussian of which at least this share, [0, 1], gets through what lies in front of it.
            With 0 a trace of light is enough, and what lies behind the object is taken for a part of it.

    Raises:
        MaskError: no views, masks of another number or size than the views, or nothing in any mask.
        ValueError: `share` or `visible` out of its range.
    """
    check_shares(share, visible)
    check_masks(cameras, masks)
    options = {"rasterizer": rasterizer, "antialiased": antialiased, "attenuation": attenuation, "visible": visible}
    weights = empty_weights(gaussians)
    for camera, mask in zip(cameras, masks, strict=True):
        weights += view_weights(gaussians, camera, mask, **options)
    return elected(weights, share)


def vote_in_folder(
    gaussians: Gaussians, names: Sequence[str], cameras: Sequence[Camera], folder: Path, **options: Any
) -> Selection:
    """`vote` by the masks in `folder`, which are called like the views; `options` are those of `vote`.

    Raises:
        MaskError: as `read_masks`, or no Gaussian lies in the masks.
    """
    masks = read_masks(folder, names, cameras)
    found = vote(gaussians, [cameras[i] for i in masks], list(masks.values()), **options)
    if not found.count:
        raise MaskError(
            f"of none of the {len(gaussians):,} Gaussians does most lie within the masks in {folder}; mark the whole "
            "object, in views that show it."
        )
    return found


def elected(weights: Float[Tensor, "n 2"], share: float | int = 0.5) -> Selection:
    """The outcome of a vote, from `view_weights` summed over views."""
    inside, total = weights.unbind(1)
    return Selection(inside > share * total, inside, total)


def vote_by_centres(gaussians: Gaussians, cameras: Sequence[Camera], masks: Sequence[Bool[Tensor, "_ _"]]) -> Selection:
    """The Gaussians whose centre lies in the mask in more than half of the views that show it: the paper's way.

    What hides behind the object counts as well as the object. A centre outside of every image belongs to nothing.

    Raises:
        MaskError: no views, masks of another number or size than the views, or nothing in any mask.
    """
    check_masks(cameras, masks)
    weights = empty_weights(gaussians)
    for camera, mask in zip(cameras, masks, strict=True):
        column, row, shown = _pixels(gaussians, camera)
        weights += torch.stack([shown & mask.to(row.device)[row, column], shown], 1)
    return elected(weights)


@torch.no_grad()
def selection_picture(
    gaussians: Gaussians,
    rows: Bool[Tensor, " n"],
    camera: Camera,
    *,
    rasterizer: Rasterizer,
    antialiased: bool = True,
    attenuation: Attenuation | None = None,
) -> Float[Tensor, "h w"]:
    """Share of each pixel's opacity that comes from `rows`, [0, 1]; 0 where nothing is drawn.

    Everything is drawn, so what hides the object hides it here, too. Above 0.5 is the object's mask.

    Raises:
        ValueError: `rows` is for another number of Gaussians.
    """
    check_rows(gaussians, rows)
    chosen = rows.to(gaussians.opacities)[:, None]
    picture = composite(
        gaussians, camera, chosen, rasterizer=rasterizer, antialiased=antialiased, attenuation=attenuation
    )
    alpha = picture.alpha[..., 0]
    # alpha is one minus a product and the feature is a sum, so they may differ in the last digit
    return (picture.features[..., 0] / torch.where(alpha > 0, alpha, 1.0)).clamp(0.0, 1.0)


def check_rows(gaussians: Gaussians, rows: Bool[Tensor, " n"]) -> None:
    """Refuse a selection of another scene, with a ValueError."""
    if len(rows) != len(gaussians):
        raise ValueError(
            f"the selection is of {len(rows)} Gaussians, and the scene has {len(gaussians)}; select on this scene."
        )


def check_shares(share: float | int, visible: float | int) -> None:
    """Refuse thresholds of a vote that are out of range, with a ValueError."""
    if not 0 <= share < 1:
        raise ValueError(f"share is {share}; it must be in [0, 1) (0.5: more inside than outside).")
    if not 0 <= visible <= 1:
        raise ValueError(f"visible is {visible}; it must be in [0, 1] ({VISIBLE}: a twentieth gets through).")


@torch.no_grad()
def _pixels(gaussians: Gaussians, camera: Camera) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"], Bool[Tensor, " n"]]:
    """Column and row of each projected centre (0, 0 where it is not shown), and whether it lies in the image."""
    like = torch.empty(0, dtype=working_dtype(gaussians.means), device=gaussians.means.device)
    means, viewmat, intrinsics = (t.to(like) for t in (gaussians.means, camera.viewmat, camera.K))
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    front = z > NEAR_PLANE
    depth = torch.where(front, z, 1.0)
    column = torch.floor(intrinsics[0, 0] * x / depth + intrinsics[0, 2])
    row = torch.floor(intrinsics[1, 1] * y / depth + intrinsics[1, 2])
    shown = front & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return torch.where(shown, column, 0).long(), torch.where(shown, row, 0).long(), shown
