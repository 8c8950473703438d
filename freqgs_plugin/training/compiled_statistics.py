"""Densification's statistics on the CPU in one pass: `LevelStrategy.observe` is the interface."""

import math

import numpy as np

from freqgs_plugin.functional.numba_threads import njit, prange


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def observe(grads, weight, radii, width, height, grad2d, count, largest):
    """Add one view: `grads` [n, 2] of the image position in pixels, divided by `weight` [n] (or []: by 1), as a norm in
    half images to `grad2d` [n], 1 to `count` [n], and to `largest` [n] the radius as a share of the longer side, all of
    Gaussians with a radius above 0 only.
    """
    half_width, half_height = np.float32(0.5 * width), np.float32(0.5 * height)
    longer = np.float32(max(width, height))
    for i in prange(len(radii)):
        if radii[i] > 0:
            scale = weight[i] if len(weight) > 0 else np.float32(1)
            x, y = grads[i, 0] / scale * half_width, grads[i, 1] / scale * half_height
            grad2d[i] += math.hypot(x, y)
            count[i] += np.float32(1)
            largest[i] = max(largest[i], np.float32(radii[i]) / longer)
