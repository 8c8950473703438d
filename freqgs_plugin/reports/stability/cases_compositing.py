"""Opacity and colour: thresholds, the cap, signed sums, and stacks of thousands of layers."""

from functools import partial

import torch

from freqgs_plugin.rendering.base import ALPHA_MAX, ALPHA_MIN
from freqgs_plugin.reports.stability.case import Case, Nothing, Value
from freqgs_plugin.reports.stability.rendering import (
    ON_THRESHOLD,
    Scene,
    camera,
    changed,
    rendering_case,
    single,
    splats,
)
from freqgs_plugin.types import Camera, Splats

case = partial(rendering_case, "compositing", antialiased=False)
LAYERS = 10_000


def cases() -> list[Case]:
    return [*_opacities(), *_thresholds(), *_signed(), *_stacks()]


def _opacities() -> list[Case]:
    mixed = splats().opacities.clone()
    mixed[::2], mixed[1::4] = 1.0, 0.0
    return [
        case("opacity 0", lambda: (changed(splats(), opacities=0.0), camera()), Nothing()),
        case("opacity 1e-30", lambda: (changed(splats(), opacities=1e-30), camera()), Nothing()),
        case("opacity 1", lambda: (changed(splats(), opacities=1.0), camera()), Value(gradient=1e-3)),
        case("opacity 0 and 1", lambda: (changed(splats(), opacities=mixed), camera())),
        case("opacity 1, all cover the image", _opaque_walls, Value(gradient=1e-3)),
    ]


def _opaque_walls() -> Scene:
    return changed(splats(size=(3.0, 9.0)), opacities=1.0), camera()


def _facing_pixel(opacity: float) -> Scene:
    """One wide Gaussian centred on the only pixel, whose alpha there is its opacity."""
    return single(opacity=opacity, scale=1.0), camera(1, 1)


def _thresholds() -> list[Case]:
    """On a threshold both answers are right; a part in 1000 to either side only one is."""
    second_ends = _stack([0.99, 0.99, 0.5])  # transmittance 1e-2, then 1e-4
    return [
        case("opacity on the threshold 1/255", partial(_facing_pixel, ALPHA_MIN), shift=ON_THRESHOLD),
        case("opacity just above 1/255", partial(_facing_pixel, ALPHA_MIN * 1.001)),
        case("opacity just below 1/255", partial(_facing_pixel, ALPHA_MIN * 0.999), Nothing()),
        case("opacity on the cap 0.999", partial(_facing_pixel, ALPHA_MAX), shift=ON_THRESHOLD),
        case("opacity just above the cap", partial(_facing_pixel, 0.9995), Value(gradient=1e-3)),
        case("opacity just below the cap", partial(_facing_pixel, 0.9985), Value(gradient=1e-3)),
        case("transmittance on the threshold 1e-4", lambda: second_ends, Value(gradient=2e-3), shift=ON_THRESHOLD),
    ]


def _signed() -> list[Case]:
    alternating = torch.tensor([1e3, -1e3]).double().repeat(12)[:, None].expand(24, 3)
    big = splats().features * 1e3
    return [
        case("features times 1e3", lambda: (changed(splats(), features=big), camera())),
        case("features +1e3 and -1e3 in turn", lambda: (changed(splats(), features=alternating), camera())),
        case("features 1e30", lambda: (changed(splats(), features=1e30), camera()), Value(gradient=1e-3)),
        case("features +-1e3 that cancel in 10,000 layers", _cancelling, Value(gradient=2e-3)),
    ]


def _stack(opacities: list[float] | torch.Tensor, size: Camera | None = None) -> Scene:
    """Wide layers one behind the other on one pixel; features are random."""
    values = torch.as_tensor(opacities, dtype=torch.float64)
    n = len(values)
    layers = splats(n, seed=4)
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = 2 + torch.arange(n) * 1e-3
    upright = torch.tensor([1.0, 0, 0, 0]).double().expand(n, 4)
    wide = Splats(means, upright, torch.full((n, 3), 100.0).double(), values, layers.features)
    return wide, size or camera(1, 1)


def _cancelling() -> Scene:
    layers, view = _stack(torch.full((LAYERS,), 0.005))
    signs = torch.tensor([1e3, -1e3]).double().repeat(LAYERS // 2)[:, None].expand(LAYERS, 3)
    return changed(layers, features=signs), view


def _stacks() -> list[Case]:
    """10,000 nearly transparent layers. The pixel is finished before the layer that brings 1e-4 or less."""
    opaque_first = torch.full((LAYERS,), 0.005).double()
    opaque_first[0] = 1.0
    opaque_first[1] = 0.95
    hundredth = 1 - 10 ** (-4 / 100.5)
    never = torch.where(torch.arange(LAYERS) % 5 == 0, 1.05, 0.95).double() * ALPHA_MIN
    return [
        case("10,000 layers, finished at layer 1", lambda: _stack(opaque_first), Value(gradient=2e-3)),
        case(
            "10,000 layers, finished at layer 100",
            lambda: _stack(torch.full((LAYERS,), hundredth)),
            Value(gradient=2e-3),
        ),
        case(
            "10,000 layers, finished at layer 1,840", lambda: _stack(torch.full((LAYERS,), 0.005)), Value(gradient=2e-3)
        ),
        case("10,000 layers, never finished", lambda: _stack(never), Value(gradient=2e-3)),
        case(
            "10,000 layers on 37x29 pixels",
            lambda: _stack(torch.full((LAYERS,), 0.01), camera()),
            Value(gradient=2e-3),
            large=True,
            by_hand=False,
        ),
    ]
