"""A camera's way along a straight line, near to far."""

from dataclasses import replace

import numpy as np
import torch

from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.rendering.render import render
from freqgs_plugin.reports.drawing import TrainedRun
from freqgs_plugin.types import Camera

NEAREST, FARTHEST = 0.3, 3.3
"""of the distance from a view to what it looks at: the ends of a way that is made; more than a factor of 10 apart"""


def in_frame(camera: Camera, frame: Similarity, device: torch.device) -> Camera:
    """The same view of a scene that was moved: x -> scale (R x + t) for its points.

    The rotation part of the view becomes V R^T, its translation scale (v - V R^T t).
    """
    viewmat = camera.viewmat.double().cpu()
    rotation = viewmat[:3, :3] @ frame.rotation.T
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3] = rotation
    moved[:3, 3] = frame.scale * (viewmat[:3, 3] - rotation @ frame.translation)
    return replace(camera, viewmat=moved.to(device, camera.viewmat.dtype), K=camera.K.to(device))


def made_from(run: TrainedRun, camera: Camera, count: int) -> list[Camera]:
    """`count` cameras on the line through `camera` and what it looks at, near to far, spaced geometrically.

    What it looks at lies straight ahead, at the median depth of the picture's inner half. The camera of ratio 1 is
    `camera` itself.

    Raises:
        ValueError: nothing is there to look at.
    """
    rendering = draw_depth(run, camera)
    h, w = rendering.shape
    inner = rendering[h // 4 : max(h - h // 4, 1), w // 4 : max(w - w // 4, 1)]
    seen = inner[inner > 0]
    if not len(seen):
        raise ValueError("the view shows no Gaussian to move away from")
    depth = float(seen.median())
    ratios = np.geomspace(NEAREST, FARTHEST, count)
    return [backwards(camera, depth * (float(ratio) - 1)) for ratio in ratios]


def backwards(camera: Camera, distance: float) -> Camera:
    """The camera moved against its viewing direction, world units."""
    viewmat = camera.viewmat.clone()
    viewmat[2, 3] += distance
    return replace(camera, viewmat=viewmat)


def draw_depth(run: TrainedRun, camera: Camera) -> torch.Tensor:
    """Expected depth [h, w], world units; 0 where nothing was hit."""
    with torch.no_grad():
        return render(
            run.gaussians, camera, rasterizer=run.rasterizer, background=run.background, antialiased=run.antialiased
        ).depth[..., 0]
