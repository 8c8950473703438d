"""An object's mask in one photograph from a box or a point, by GrabCut (Rother, Kolmogorov and Blake 2004).

Pixels are counted from the upper left corner, x to the right and y down. The same input gives the same mask.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from freqgs_plugin.apps.masks import MaskError
from freqgs_plugin.io.images import to_uint8

Picture = UInt8[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]
Trimap = UInt8[np.ndarray, "h w"]
"""OpenCV's: 0 background, 1 object, 2 and 3 perhaps background, perhaps object"""

ITERATIONS = 5
SURROUNDINGS = 0.25
"""of a box: share of its sides by which it is widened for what the background is learned from"""
SIZES = 24
"""boxes that are tried around a point"""
SMALLEST = 0.02
"""half side of the smallest of them, share of the image's longer side; the largest has the image's shorter side"""
_SEED = 0.15
"""radius of the disc around a point that is the object for sure, share of the box's half side"""
_STEEPEST = 60.0
"""slopes above this count as this, units of Lab per 8 pixels"""
_FULL = 0.4
"""a mask that fills this share of its box or more is not small for it"""


def mask_from_box(image: Float[Tensor, "h w 3"], box: tuple[int, int, int, int]) -> Bool[Tensor, "h w"]:
    """What fills a box around the object.

    Args:
        image: RGB in [0, 1].
        box: left, top, right, bottom, pixels; the object lies inside, right and bottom are one past its last.

    Raises:
        MaskError: the box holds no pixel of the image, or nothing that stands out from what is around it.
    """
    picture = to_uint8(image.detach().cpu().numpy())
    height, width = picture.shape[:2]
    left, top, right, bottom = max(0, box[0]), max(0, box[1]), min(width, box[2]), min(height, box[3])
    if left >= right or top >= bottom:
        raise MaskError(f"the box {box} holds no pixel of the {width}x{height} image; give left, top, right, bottom.")
    mask = _inside_box(picture, (left, top, right, bottom), SURROUNDINGS, None, ITERATIONS)
    if not mask.any():
        raise MaskError(f"nothing in the box {box} stands out from what is around it; draw it closer to the object.")
    return torch.from_numpy(mask).to(image.device)


def mask_from_point(image: Float[Tensor, "h w 3"], point: tuple[int, int]) -> Bool[Tensor, "h w"]:
    """What lies at a point on the object: boxes of many sizes around it are tried, and the clearest mask is taken.

    Clear is a mask with a sharp border that fills its box without leaving it, and hardly differs from that of the
    box one size smaller. It is a guess, and wrong more often than a box.

    Args:
        image: RGB in [0, 1].
        point: x, y, pixels.

    Raises:
        MaskError: the point lies outside of the image, or nothing around it stands out.
    """
    picture = to_uint8(image.detach().cpu().numpy())
    height, width = picture.shape[:2]
    x, y = point
    if not (0 <= x < width and 0 <= y < height):
        raise MaskError(f"the point {point} lies outside of the {width}x{height} image; give x, y in pixels.")
    slope = _slope(picture)
    best, best_score, smaller = np.zeros((height, width), bool), 0.0, np.zeros((height, width), bool)
    for half in np.geomspace(max(SMALLEST * max(height, width), 2.0), max(0.5 * min(height, width), 2.0), SIZES):
        mask, score = _around(picture, slope, point, float(half))
        score *= 0.5 + overlap(mask, smaller)
        if score > best_score:
            best, best_score = mask, score
        smaller = mask
    if not best.any():
        raise MaskError(f"nothing stands out around the point {point}; draw a box around the object instead.")
    return torch.from_numpy(best).to(image.device)


def cut(picture: Picture, trimap: Trimap, iterations: int = ITERATIONS) -> Mask:
    """GrabCut; where there is nothing to learn the object or the background from, the object is what it may be."""
    trimap = np.ascontiguousarray(trimap)
    possible = (trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)
    if not possible.any() or possible.all():
        return possible
    # its mixtures of colours begin with random centres; with a trimap, it does not read the rectangle
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(picture), trimap, (0, 0, 1, 1), *models, iterations, cv2.GC_INIT_WITH_MASK)
    return (trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)


def overlap(first: Mask, second: Mask) -> float:
    """Intersection over union; 0 where both are empty."""
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 0.0


def _inside_box(
    picture: Picture, box: tuple[int, int, int, int], surroundings: float, seed: Mask | None, iterations: int
) -> Mask:
    """GrabCut of the box and a rim around it; the rest of the image is not looked at."""
    height, width = picture.shape[:2]
    left, top, right, bottom = box
    rim_x, rim_y = (int(surroundings * side) + 2 for side in (right - left, bottom - top))
    window = (
        slice(max(0, top - rim_y), min(height, bottom + rim_y)),
        slice(max(0, left - rim_x), min(width, right + rim_x)),
    )
    trimap = np.full((height, width), cv2.GC_BGD, np.uint8)
    trimap[top:bottom, left:right] = cv2.GC_PR_FGD
    if seed is not None:
        trimap[seed] = cv2.GC_FGD
    mask = np.zeros((height, width), bool)
    mask[window] = cut(picture[window], trimap[window], iterations)
    return mask


def _around(
    picture: Picture, slope: Float[np.ndarray, "h w"], point: tuple[int, int], half: float
) -> tuple[Mask, float]:
    """The mask in a box of this half side around a point, and how clear it is."""
    height, width = picture.shape[:2]
    x, y = point
    left, top = max(0, int(x - half)), max(0, int(y - half))
    right, bottom = min(width, int(x + half + 1)), min(height, int(y + half + 1))
    seed = np.zeros((height, width), np.uint8)
    cv2.circle(seed, point, max(1, int(_SEED * half)), (1,), -1)
    mask = component(_inside_box(picture, (left, top, right, bottom), SURROUNDINGS, seed > 0, 3), seed > 0)
    rim = np.zeros((height, width), bool)
    rim[top:bottom, left:right] = True
    rim[top + 1 : bottom - 1, left + 1 : right - 1] = False
    leaves = (mask & rim).sum() / rim.sum()
    filled = min(mask.sum() / (4 * half * half), _FULL)
    border = border_of(mask)
    sharp = float(np.minimum(slope[border], _STEEPEST).mean()) if border.any() else 0.0
    return mask, float(sharp * (1 - leaves) * filled)


def component(mask: Mask, seed: Mask) -> Mask:
    """The connected parts of `mask` that meet `seed`."""
    _, label = cv2.connectedComponents(mask.astype(np.uint8))
    return mask & np.isin(label, np.unique(label[mask & seed]))


def border_of(mask: Mask) -> Mask:
    """Pixels next to the other side of the mask's border, on both sides; not those on the image's own border."""
    square, inside = np.ones((3, 3), np.uint8), mask.astype(np.uint8)
    border = (cv2.dilate(inside, square) > 0) & (cv2.erode(inside, square, borderValue=(1,)) == 0)
    border[[0, -1]] = border[:, [0, -1]] = False
    return border


def _slope(picture: Picture) -> Float[np.ndarray, "h w"]:
    lab = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), 1)
    x, y = cv2.Sobel(lab, -1, 1, 0), cv2.Sobel(lab, -1, 0, 1)
    return np.sqrt((x * x + y * y).sum(2))
