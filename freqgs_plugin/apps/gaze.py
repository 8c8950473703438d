"""Where one looks, frame by frame: given, read from a file, or found in the picture by its saliency."""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

Point = tuple[float, float]
"""shares of the image's width and height, from its upper left corner"""
AUTO = "auto"
_BLUR = 0.05
"""standard deviation of what saliency is averaged over, share of the longer side: a fovea is no single pixel"""


def gaze_points(text: str, frames: int) -> list[Point | None]:
    """Each frame's gaze from `0.5,0.4`, from a file with one such line per frame, or from `auto` (None: to be found).

    A JSON file holds a list of pairs. A file of one line is for all frames.

    Raises:
        ValueError: another form, a gaze outside of the image, or another number of lines than frames.
        FileNotFoundError: it reads like a file, and there is none.
    """
    if text == AUTO:
        return [None] * frames
    if re.fullmatch(r"\s*[-+.\de]+\s*[,\s]\s*[-+.\de]+\s*", text):
        return [_point(text, "gaze")] * frames
    points = _read(Path(text))
    if len(points) == 1:
        return [points[0]] * frames
    if len(points) != frames:
        raise ValueError(f"{text} has {len(points)} gazes for {frames} frames; give one per frame, or a single one.")
    return list(points)


def salient_point(picture: Float[np.ndarray, "h w 3"]) -> Point:
    """The most salient place of a picture (values in [0, 1]): OpenCV's fine-grained saliency, averaged over a fovea.

    A picture without contrast has none: its middle. Of equal places the one nearest to the middle.
    """
    import cv2

    height, width = picture.shape[:2]
    image = np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)[..., ::-1]
    ok, saliency = cv2.saliency.StaticSaliencyFineGrained.create().computeSaliency(np.ascontiguousarray(image))
    if not ok or not np.ptp(image):
        return 0.5, 0.5
    sigma = _BLUR * max(width, height)
    blurred = cv2.GaussianBlur(saliency.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    y, x = np.indices(blurred.shape)
    off_centre = np.hypot(x + 0.5 - width / 2, y + 0.5 - height / 2)
    best = np.lexsort((off_centre.ravel(), -blurred.ravel()))[0]
    return (float(x.ravel()[best]) + 0.5) / width, (float(y.ravel()[best]) + 0.5) / height


def _read(path: Path) -> Sequence[Point]:
    if not path.is_file():
        raise FileNotFoundError(
            f"gaze is '{path}', which is no file; give x,y (shares of the image), a file or {AUTO}."
        )
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeError as error:
        raise ValueError(f"{path} is no text ({error}); give one gaze per line, as in 0.5,0.4.") from error
    try:
        lines = [f"{x},{y}" for x, y in json.loads(text)]
    except (ValueError, TypeError):
        lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise ValueError(f"{path} is empty; give one gaze per line, as in 0.5,0.4.")
    return [_point(line, f"line {number} of {path}") for number, line in enumerate(lines, start=1)]


def _point(text: str, where: str) -> Point:
    try:
        x, y = (float(part) for part in re.split(r"[,\s]+", text.strip()))
    except ValueError:
        raise ValueError(f"{where} is '{text[:40]}'; it must be two numbers, as in 0.5,0.4.") from None
    if not (0 <= x <= 1 and 0 <= y <= 1) or not math.isfinite(x + y):
        raise ValueError(
            f"{where} is {x:g},{y:g}, outside of the image; give shares of its width and height, from 0,0 (upper left) "
            "to 1,1."
        )
    return x, y
