"""Ways to an object's Gaussians, measured on a scene whose true masks are known."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from freqgs_plugin.apps.focus import Selection, selection_picture, vote, vote_by_centres
from freqgs_plugin.apps.grabcut import mask_from_box, mask_from_point
from freqgs_plugin.apps.masks import MaskError
from freqgs_plugin.apps.propagate import propagate
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.types import Camera, Gaussians

BOX_MARGIN = 0.05
"""share of its sides by which a true bounding box is widened on each side, as by a hand"""


@dataclass(frozen=True)
class TrueView:
    """A view with what it truly shows."""

    camera: Camera
    image: Float[Tensor, "h w 3"]
    ids: Int[Tensor, "h w"]
    """number of the object at each pixel"""


@dataclass(frozen=True)
class FocusSubject:
    """What is measured."""

    gaussians: Gaussians
    rasterizer: Rasterizer
    antialiased: bool
    train: Sequence[TrueView]
    """whose masks vote"""
    test: Sequence[TrueView]
    """held out: on these, selections are compared with the truth"""
    objects: Sequence[tuple[str, int]]
    """names and numbers"""

    @property
    def drawing(self) -> dict[str, Any]:
        return {"rasterizer": self.rasterizer, "antialiased": self.antialiased}


@dataclass(frozen=True)
class Outcome:
    """Of one way for one object."""

    iou: float | None
    """of the rendered selection with the truth, pixels of all held-out views together; None: it found no object"""
    seconds: float
    mask_iou: float | None = None
    """of the first view's mask with the truth, where it came from a box or a point"""


def outcomes(subject: FocusSubject, number: int, few: int) -> dict[str, Outcome]:
    """All ways for one object; `few` is the number of views that vote by the true masks in the ways called so."""
    masks = [view.ids == number for view in subject.train]
    cameras = [view.camera for view in subject.train]
    some = np.unique(np.linspace(0, len(cameras) - 1, few).round().astype(int)).tolist()

    def by_weight(which: Sequence[int]) -> Selection:
        chosen = [cameras[i] for i in which], [masks[i] for i in which]
        return vote(subject.gaussians, *chosen, **subject.drawing)

    def by_centres(which: Sequence[int]) -> Selection:
        return vote_by_centres(subject.gaussians, [cameras[i] for i in which], [masks[i] for i in which])

    everything = range(len(cameras))
    ways = {
        "weight": lambda: by_weight(everything),
        "centres": lambda: by_centres(everything),
        "weight, few": lambda: by_weight(some),
        "centres, few": lambda: by_centres(some),
    }
    found = {name: _outcome(subject, number, way) for name, way in ways.items()}
    first = clearest_view(masks)
    picture, mask = subject.train[first].image, masks[first]
    found["box"] = _propagated(subject, number, first, lambda: mask_from_box(picture, box_of(mask)))
    found["point"] = _propagated(subject, number, first, lambda: mask_from_point(picture, point_in(mask)))
    return found


def _outcome(subject: FocusSubject, number: int, way: Callable[[], Selection]) -> Outcome:
    start = time.perf_counter()
    try:
        rows = way().rows
    except MaskError:
        return Outcome(None, time.perf_counter() - start)
    seconds = time.perf_counter() - start
    return Outcome(rendered_iou(subject, rows, number), seconds)


def _propagated(subject: FocusSubject, number: int, first: int, make: Callable[[], Bool[Tensor, "h w"]]) -> Outcome:
    made: list[Bool[Tensor, "h w"]] = []

    def way() -> Selection:
        made.append(make())
        cameras, images = [view.camera for view in subject.train], [view.image for view in subject.train]
        return propagate(subject.gaussians, cameras, images, first, made[0], **subject.drawing)[0]

    outcome = _outcome(subject, number, way)
    true = subject.train[first].ids == number
    counts = [(made[0] & true).sum(), (made[0] | true).sum()] if made else [0, 0]
    return Outcome(outcome.iou, outcome.seconds, _ratio(*(int(count) for count in counts)))


def rendered_iou(subject: FocusSubject, rows: Bool[Tensor, " n"], number: int) -> float | None:
    """Intersection over union of where the selection makes up more than half of a pixel's opacity with the truth."""
    both = either = 0
    for view in subject.test:
        drawn = selection_picture(subject.gaussians, rows, view.camera, **subject.drawing) > 0.5
        true = (view.ids == number).to(drawn.device)
        both += int((drawn & true).sum())
        either += int((drawn | true).sum())
    return _ratio(both, either)


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def clearest_view(masks: Sequence[Bool[Tensor, "_ _"]]) -> int:
    """The view that shows most of the object, of those whose border does not cut it where there are such."""

    def shown(mask: Bool[Tensor, "_ _"]) -> tuple[bool, int]:
        cut = bool(mask[0].any() | mask[-1].any() | mask[:, 0].any() | mask[:, -1].any())
        return bool(mask.any()) and not cut, int(mask.sum())

    return max(range(len(masks)), key=lambda i: shown(masks[i]))


def box_of(mask: Bool[Tensor, "h w"]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the mask, widened by `BOX_MARGIN` and at least a pixel."""
    sides = []
    for axis in (0, 1):
        there = torch.nonzero(mask.any(axis)).flatten()
        low, high = int(there[0]), int(there[-1]) + 1
        margin = max(1, round(BOX_MARGIN * (high - low)))
        sides.append((low - margin, high + margin))
    (left, right), (top, bottom) = sides
    return left, top, right, bottom


def point_in(mask: Bool[Tensor, "h w"]) -> tuple[int, int]:
    """The pixel farthest from the mask's border."""
    padded = np.pad(mask.cpu().numpy().astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.unravel_index(depth.argmax(), depth.shape)
    return int(x), int(y)
