"""The views that a stream's order is judged by."""

from collections.abc import Sequence
from dataclasses import replace

from freqgs_plugin.types import Camera

MARGIN = 1.25
"""pictures are this many times wider and higher than the training views at the same focal length: other views see what
lies beside them, and holes there, too"""


def judging_views(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """At most so many of the cameras, evenly taken, and seeing more."""
    return [widened(camera, MARGIN) for camera in cameras[:: max(1, -(-len(cameras) // most))]]


def widened(camera: Camera, factor: float) -> Camera:
    """A picture with more at all sides."""
    width, height = round(camera.width * factor), round(camera.height * factor)
    K = camera.K.clone()
    K[0, 2] += (width - camera.width) / 2
    K[1, 2] += (height - camera.height) / 2
    return replace(camera, K=K, width=width, height=height)


def reduced(camera: Camera, factor: int) -> Camera:
    """The same view in a picture that is so many times smaller."""
    K = camera.K.clone()
    K[:2] /= factor
    return replace(camera, K=K, width=max(1, camera.width // factor), height=max(1, camera.height // factor))
