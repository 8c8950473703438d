"""Masks from a text prompt, by whatever segmenter is installed."""

import importlib
from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.apps.masks import MaskError

ENTRY_POINT_GROUP = "freqgs_plugin.segmenters"
_BUILT_IN = {"clipseg": ("freqgs_plugin.apps.clipseg", "CLIPSeg")}


class SegmenterError(RuntimeError):
    """A segmenter that cannot be had or used; the message holds the remedy."""


class MissingWeightsError(SegmenterError):
    """Weights that cannot be had: `what` is wrong, without the remedy, which depends on who asks."""

    def __init__(self, what: str, remedy: str = "") -> None:
        super().__init__(f"{what} {remedy}".strip())
        self.what = what


@runtime_checkable
class Segmenter(Protocol):
    """Finds what a text describes in an image."""

    def __call__(self, image: Float[np.ndarray, "h w 3"], prompt: str) -> Float[np.ndarray, "h w"]:
        """Probability, [0, 1], that a pixel belongs to what `prompt` describes.

        Args:
            image: RGB in [0, 1].
            prompt: for example `the red ball`.
        """
        ...


def available_segmenters() -> list[str]:
    """Names that `get_segmenter` knows: built in and registered by entry point."""
    return [*_BUILT_IN, *(e.name for e in entry_points(group=ENTRY_POINT_GROUP) if e.name not in _BUILT_IN)]


def get_segmenter(name: str, **options: Any) -> Segmenter:
    """The segmenter called `name`, made with `options`.

    Third parties add theirs by an entry point in the group `freqgs_plugin.segmenters` that names a callable which
    returns a `Segmenter`.

    Raises:
        ValueError: no such segmenter; the message names those that there are.
        SegmenterError: it lacks what it needs.
    """
    if name in _BUILT_IN:
        module, attribute = _BUILT_IN[name]
        return getattr(importlib.import_module(module), attribute)(**options)
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            return entry.load()(**options)
    raise ValueError(f"unknown segmenter '{name}'. Choose one of: {', '.join(available_segmenters())}.")


def prompt_masks(
    segmenter: Segmenter, images: Sequence[Float[Tensor, "_ _ 3"]], prompt: str, threshold: float = 0.5
) -> list[Bool[Tensor, "_ _"]]:
    """A mask for each image: where the probability is above `threshold`. Some may be empty.

    Args:
        segmenter: from `get_segmenter`, or any other.
        images: RGB in [0, 1].
        prompt: what to look for.
        threshold: in (0, 1).

    Raises:
        MaskError: nothing is above the threshold in any image, or there is no image.
        SegmenterError: the segmenter's answer is of another size than the image, or not finite.
        ValueError: the prompt is empty, or the threshold out of range.
    """
    if not prompt.strip():
        raise ValueError("the prompt is empty; describe the object, for example 'the red ball'.")
    if not 0 < threshold < 1:
        raise ValueError(f"threshold is {threshold}; it must be a probability between 0 and 1.")
    if not images:
        raise MaskError("there is no image to look for the prompt in; give one or more.")
    masks, highest = [], 0.0
    for image in images:
        probability = _probability(segmenter, image, prompt)
        highest = max(highest, float(probability.max()))
        masks.append(torch.from_numpy(probability > threshold).to(image.device))
    if not any(bool(mask.any()) for mask in masks):
        raise MaskError(
            f"'{prompt}' was found in none of {len(images)} images: the highest probability is {highest:.3f}, and the "
            f"threshold {threshold:g}. Describe the object in other words, or lower the threshold."
        )
    return masks


def _probability(segmenter: Segmenter, image: Float[Tensor, "h w 3"], prompt: str) -> Float[np.ndarray, "h w"]:
    answer = np.asarray(segmenter(image.detach().float().cpu().numpy(), prompt))
    wanted = tuple(image.shape[:2])
    if answer.shape != wanted:
        raise SegmenterError(f"the segmenter answered with the shape {answer.shape} for an image of {wanted} (h, w).")
    if not np.isfinite(answer).all():
        raise SegmenterError(f"{(~np.isfinite(answer)).sum()} of the segmenter's probabilities are not finite.")
    return answer
