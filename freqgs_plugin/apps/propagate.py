"""From an object's mask in one view to masks in all views, and to its Gaussians.

Views are taken in the order of how near they lie, as seen from the object, to one that is done. In each, what was
elected so far is drawn; what no view has seen yet is open; and GrabCut decides there and along the border.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.apps.focus import Selection, elected
from freqgs_plugin.apps.grabcut import component, cut
from freqgs_plugin.apps.masks import MaskError, check_masks, check_size
from freqgs_plugin.apps.visibility import composite, view_weights
from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.io.images import to_uint8
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.types import Camera, Gaussians

BAND = 0.08
"""half width of the strip along the border in which GrabCut decides, share of the root of the object's area"""
GROWTH = 0.2
"""how far the object may grow into what no view has seen, share of the root of its area"""
ROUNDS = 1
"""how often all masks are made again once every view has voted"""
_FEWEST = 4
"""pixels: an object of fewer is drawn too small to be cut out"""
_ITERATIONS = 3


def propagate(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[Float[Tensor, "_ _ 3"]],
    first: int,
    mask: Bool[Tensor, "h w"],
    *,
    rasterizer: Rasterizer,
    antialiased: bool = True,
    attenuation: Attenuation | None = None,
    rounds: int = ROUNDS,
) -> tuple[Selection, list[Bool[Tensor, "_ _"]]]:
    """The object's Gaussians by the votes of all views, and its mask in each.

    `images` are the views' photographs, RGB in [0, 1], and `mask` is the object in view `first`, which is kept as it
    is. In each of `rounds`, all other masks are made again from the votes of all views. Further arguments are those of
    `vote`.

    Raises:
        MaskError: the mask is empty, images or mask are of another number or size than the views, or no Gaussian lies
            in the mask.
        ValueError: there is no view `first`.
    """
    _check_views(cameras, images, first, mask)
    drawing: dict[str, Any] = {"rasterizer": rasterizer, "antialiased": antialiased, "attenuation": attenuation}
    start = view_weights(gaussians, cameras[first], mask, **drawing)
    if not bool(elected(start).rows.any()):
        raise MaskError("no Gaussian belongs to what the mask marks; mark something that the scene shows there.")
    masks: dict[int, Tensor] = {first: mask}
    order = _order(gaussians, cameras, first, elected(start).rows)
    weights = start
    for repeat in range(rounds + 1):
        before, weights = weights, start.clone()
        for i in order:
            # in the first round, of the views that are done; then of all of them in the round before
            votes = weights if repeat == 0 else before
            masks[i] = _mask(gaussians, cameras[i], images[i], votes, drawing)
            weights += view_weights(gaussians, cameras[i], masks[i], **drawing)
    return elected(weights), [masks[i] for i in range(len(cameras))]


def _check_views(
    cameras: Sequence[Camera], images: Sequence[Float[Tensor, "_ _ 3"]], first: int, mask: Bool[Tensor, "h w"]
) -> None:
    if len(images) != len(cameras):
        raise MaskError(f"{len(images)} images for {len(cameras)} views; give one for each.")
    if not 0 <= first < len(cameras):
        raise ValueError(f"first is {first}; views are numbered from 0 to {len(cameras) - 1}.")
    check_masks([cameras[first]], [mask])
    for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        check_size(f"image {i}", image.shape[1], image.shape[0], camera)


def _order(gaussians: Gaussians, cameras: Sequence[Camera], first: int, rows: Bool[Tensor, " n"]) -> list[int]:
    """All views but the first: always the one whose direction from the object is closest to one that is done."""
    middle = gaussians.means[rows].double().mean(0)
    directions = torch.stack([camera.centre.to(middle) - middle for camera in cameras])
    cosines = torch.nn.functional.normalize(directions, dim=1)
    cosines = cosines @ cosines.T
    nearest, order = cosines[first].clone(), []
    nearest[first] = -torch.inf
    for _ in range(len(cameras) - 1):
        i = int(nearest.argmax())
        order.append(i)
        nearest = torch.maximum(nearest, cosines[i])
        nearest[[first, *order]] = -torch.inf
    return order


def _mask(
    gaussians: Gaussians,
    camera: Camera,
    image: Float[Tensor, "h w 3"],
    weights: Float[Tensor, "n 2"],
    drawing: dict[str, Any],
) -> Bool[Tensor, "h w"]:
    """The object in a view, from votes of others."""
    chosen = elected(weights)
    features = torch.stack([chosen.rows, chosen.total > 0], 1).to(gaussians.opacities)
    with torch.no_grad():
        picture = composite(gaussians, camera, features, **drawing)
    # of each pixel's opacity, more than half
    drawn, known = (picture.features > 0.5 * picture.alpha).cpu().numpy().transpose(2, 0, 1)
    return torch.from_numpy(refine(to_uint8(image.detach().cpu().numpy()), drawn, known)).to(image.device)


def refine(
    picture: np.ndarray, drawn: Bool[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """GrabCut along the border of what is drawn of the object, and into what is not known around it.

    Parts that do not meet what is drawn are left out. Where hardly anything is drawn, that is the answer.

    Args:
        picture: the photograph, 8-bit RGB [h w 3].
        drawn: what is the object by all that is known.
        known: what any view has seen.
    """
    area = int(drawn.sum())
    if area < _FEWEST:
        return drawn
    band, growth = (max(least, round(share * area**0.5)) for share, least in ((BAND, 1), (GROWTH, 2)))
    inside = drawn.astype(np.uint8)
    trimap = np.where(drawn, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[cv2.erode(inside, _disc(band), borderValue=(1,)) > 0] = cv2.GC_FGD
    trimap[(cv2.dilate(inside, _disc(band)) == 0) & known] = cv2.GC_BGD
    trimap[cv2.dilate(inside, _disc(growth)) == 0] = cv2.GC_BGD
    y, x = np.nonzero(drawn)
    rim = 2 * growth + 8
    window = slice(max(0, y.min() - rim), y.max() + rim + 1), slice(max(0, x.min() - rim), x.max() + rim + 1)
    mask = np.zeros_like(drawn)
    mask[window] = cut(picture[window], trimap[window], _ITERATIONS)
    return component(mask, drawn)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
