"""Distance decay: dead and immortal Gaussians, scales to 1e6, distance 0, splats far off the scene, empty views."""

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from freqgs_plugin.functional.attenuation import EPSILON, TAU, DistanceDecay, Reference
from freqgs_plugin.rendering.base import NEAR_PLANE, get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.reports.stability.case import (
    Bounded,
    Case,
    Compute,
    Expected,
    Nothing,
    Refused,
    Setting,
    Tensors,
    Value,
)
from freqgs_plugin.reports.stability.dense import dense
from freqgs_plugin.reports.stability.rendering import BACKGROUND, LEAVES, SETTINGS, camera, changed, splats
from freqgs_plugin.training.detail import CountGradient, count_loss, target_share
from freqgs_plugin.types import Camera, Gaussians, Splats

TORCH = (Setting("torch", torch.float32), Setting("torch", torch.float64))
SCENE_DISTANCE = 6.0
"""world units: about the farthest Gaussian of `splats()`"""


def cases() -> list[Case]:
    return [*_decays(), *_scales(), *_distances(), *_thresholds(), *_pictures(), *_count_losses()]


def plain_weight(
    opacities: Tensor, distance: Tensor, decay: Tensor, scale: float, soft: bool, shift: float = 0.0
) -> Tensor:
    """α'' / α where α'' > τ s (1 + shift), by Eq. 2 as it is written; `soft` fades between 1 and 2 times that."""
    weight = torch.exp(-((distance * scale) ** 2) / (2 * torch.relu(decay) ** 2 + EPSILON))
    over = opacities * weight / (TAU * scale)
    if not soft:
        return weight * (over > 1 + shift)
    fade = (over - 1).clamp(0, 1)
    return weight * (3 * fade**2 - 2 * fade**3)


def _normalised(means: Tensor, view: Camera, reference: Reference) -> Tensor:
    rotation, translation = view.viewmat[:3, :3], view.viewmat[:3, 3]
    # rounded to float32, the rotation also stretches by up to 1e-7: lengths are those of the world, not of its image
    distance = (means.detach() - torch.linalg.solve(rotation, -translation)).norm(dim=-1)
    points = means.detach() @ rotation.T + translation
    if reference == "scene" or not len(distance):
        return distance / SCENE_DISTANCE
    pixels = points[:, :2] / points[:, 2:] @ view.K[:2, :2].T + view.K[:2, 2]
    size = pixels.new_tensor([view.width, view.height])
    inside = (points[:, 2] > NEAR_PLANE) & (pixels >= 0).all(-1) & (pixels <= size).all(-1)
    shown = (distance[inside] if bool(inside.any()) else distance).sort().values
    largest = shown[-1] if reference == "frustum_max" else shown[math.ceil(0.99 * len(shown)) - 1]
    return distance / largest if largest > 0 else distance


def _case(
    name: str,
    *,
    decay: float | Tensor = 5.0,
    scale: float = 1.0,
    reference: Reference = "scene",
    soft: bool = True,
    scene: Callable[[], Splats] = splats,
    view: Callable[[], Camera] = camera,
    expected: Expected = Value(),  # noqa: B008
    shift: float = 0.0,
) -> Case:
    """Weights of `DistanceDecay`, with gradients by opacity and decay; the mean has none."""

    def inputs() -> Tensors:
        gaussians, eye = scene(), view()
        values = decay if isinstance(decay, Tensor) else torch.full((len(gaussians),), decay, dtype=torch.float64)
        return {
            "means": gaussians.means, "opacities": gaussians.opacities, "decay": values,
            "viewmat": eye.viewmat, "K": eye.K,
        }  # fmt: skip

    def eye_of(leaves: Tensors) -> Camera:
        eye = view()
        return Camera(leaves["viewmat"], leaves["K"], eye.width, eye.height)

    def compute(setting: Setting) -> Compute:
        def f(leaves: Tensors) -> Tensors:
            attenuation = DistanceDecay(scale, reference, SCENE_DISTANCE if reference == "scene" else None, soft)
            return {"weight": attenuation(_gaussians(leaves), eye_of(leaves))}

        return f

    def truth(leaves: Tensors) -> list[Tensors]:
        distance = _normalised(leaves["means"], eye_of(leaves), reference)
        arguments = (leaves["opacities"], distance, leaves["decay"], scale, soft)
        return [{"weight": plain_weight(*arguments, side)} for side in ((0.0, -shift, shift) if shift else (0.0,))]

    return Case(
        group="decay",
        name=name,
        inputs=inputs,
        compute=compute,
        truth=truth,
        expected=expected,
        settings=TORCH,
        units=lambda leaves: {"decay": leaves["decay"].detach()},
        fixed=frozenset({"viewmat", "K"}),
    )


def _gaussians(leaves: Tensors) -> Gaussians:
    """Gaussians of which the attenuation sees means, opacities and decay only."""
    n = len(leaves["means"])
    ones = leaves["means"].new_ones(n, 4)
    level = torch.ones(n, dtype=torch.int64)
    black = (leaves["means"].new_zeros(n, 3), leaves["means"].new_zeros(n, 0, 3))
    return Gaussians(leaves["means"], ones, ones[:, :3], leaves["opacities"], *black, level, decay=leaves["decay"])


def _decays() -> list[Case]:
    mixed = torch.tensor([-1e8, -1.0, 0.0, 1e-8, 1e-3, 0.1, 1.0, 5.0, 100.0, 1e8, 1e30, 1e38]).double()
    out = [_case(f"decay {value:g}", decay=value, expected=Nothing()) for value in (-1e8, -1.0, -1e-8, 0.0, 1e-8, 1e-4)]
    out += [_case(f"decay {value:g}", decay=value) for value in (0.1, 1.0, 1e8, 1e30, 1e38)]
    out.append(_case("decays from -1e8 to 1e38", decay=mixed.repeat(2)))
    return out


def _scales() -> list[Case]:
    out = [_case(f"scale {value:g}", scale=value) for value in (1e-6, 1.0, 5.0, 20.0, 100.0)]
    out += [_case(f"scale {value:g}", scale=value, expected=Nothing()) for value in (255.0, 1e3, 1e6, 1e30)]
    out += [
        _case(f"scale {value:g} is refused", scale=value, expected=Refused(ValueError, "must be a finite number > 0"))
        for value in (0.0, -1.0, math.inf, math.nan)
    ]
    return out


def _one_far() -> Splats:
    """200 Gaussians, of which one in the middle of the view is 1e4 times as far as the scene."""
    gaussians = splats(200)
    means = gaussians.means.clone()
    means[7] = torch.tensor([0.0, 0.0, 6e4])
    return changed(gaussians, means=means)


def _distances() -> list[Case]:
    at_origin = changed(splats(), means=0.0)
    behind = changed(splats(), means=splats().means * torch.tensor([1.0, 1.0, -1.0]))
    place = (1e6, -1e6, 5e5)
    distant = changed(splats(), means=splats().means + torch.tensor(place).double())
    far = changed(splats(), means=splats().means * 1e12)
    references: tuple[Reference, ...] = ("scene", "frustum_max", "frustum_quantile")
    out = []
    for reference in references:
        out += [
            _case(f"all at the camera's centre, {reference}", scene=lambda: at_origin, reference=reference, decay=0.5),
            _case(f"empty frustum, {reference}", scene=lambda: behind, reference=reference, decay=0.5),
            _case(f"no Gaussians, {reference}", scene=lambda: splats(0), reference=reference),
            _case(
                f"one splat at 1e4 times the scene, {reference}",
                scene=_one_far,
                reference=reference,
                decay=0.5,
                scale=2.0,
            ),
            _case(
                f"scene and camera 1e6 units from the origin, {reference}",
                scene=lambda: distant,
                view=lambda: camera(position=place, angles=(0.2, 0.4)),
                reference=reference,
                decay=0.5,
            ),
        ]
    out += [
        _case("dead at the camera's centre", scene=lambda: at_origin, decay=0.0),
        _case("distances of 1e12", scene=lambda: far, decay=1e12),
        _case("distances of 1e12, ordinary decay", scene=lambda: far, decay=5.0, expected=Nothing()),
    ]
    return out


def _thresholds() -> list[Case]:
    """α'' on τ s: a step there (both sides are right), or a fade that begins with slope 0."""
    near = changed(splats(), means=0.0, opacities=2 * TAU)
    return [
        _case("opacity on the threshold, step", scene=lambda: near, scale=2.0, soft=False, shift=1e-5),
        _case("opacity on the threshold, fade", scene=lambda: near, scale=2.0, expected=Bounded(gradient=1e-2)),
        _case("opacity 0", scene=lambda: changed(splats(), opacities=0.0), expected=Nothing()),
        _case("opacity 1e-38", scene=lambda: changed(splats(), opacities=1e-38), expected=Nothing()),
        _case("opacity 1", scene=lambda: changed(splats(), opacities=1.0), decay=0.7, scale=2.0),
        _case("step instead of a fade", decay=0.7, scale=2.0, soft=False),
    ]


def _pictures() -> list[Case]:
    """The whole way to a picture; rows of weight 0 never reach the rasterizer."""

    def case(name: str, decay: float, scale: float, expected: Value | Nothing) -> Case:
        def inputs() -> Tensors:
            gaussians, eye = splats(), camera()
            generator = torch.Generator().manual_seed(5)
            dc = torch.randn(24, 3, generator=generator, dtype=torch.float64)
            leaves = {key: getattr(gaussians, key) for key in LEAVES if key != "features"}
            background = torch.tensor(BACKGROUND, dtype=torch.float64)
            decays = torch.full((24,), decay).double()
            return {**leaves, "dc": dc, "decay": decays, "background": background, "viewmat": eye.viewmat, "K": eye.K}

        def compute(setting: Setting) -> Compute:
            rasterizer = get_rasterizer(setting.backend, setting.device)

            def f(leaves: Tensors) -> Tensors:
                level = torch.ones(24, dtype=torch.int64, device=leaves["means"].device)
                means, quats, scales, opacities, dc = (leaves[key] for key in (*LEAVES[:4], "dc"))
                rest = dc.new_zeros(24, 0, 3)
                gaussians = Gaussians(means, quats, scales, opacities, dc, rest, level, decay=leaves["decay"])
                view = Camera(leaves["viewmat"], leaves["K"], 37, 29)
                decayed = DistanceDecay(scale, "scene", SCENE_DISTANCE)
                rendering = render(gaussians, view, decayed, rasterizer=rasterizer, background=leaves["background"])
                return {"features": rendering.features, "alpha": rendering.alpha}

            return f

        def truth(leaves: Tensors) -> list[Tensors]:
            view = Camera(leaves["viewmat"], leaves["K"], 37, 29)
            distance = _normalised(leaves["means"], view, "scene")
            weight = plain_weight(leaves["opacities"], distance, leaves["decay"], scale, True)
            colours = torch.relu(0.28209479177387814 * leaves["dc"] + 0.5)
            values = {key: leaves[key] for key in ("means", "quats", "scales")}
            faded = Splats(**values, opacities=leaves["opacities"] * weight, features=colours)
            out = dense(faded, view, leaves["background"], antialiased=True)
            return [{"features": out["features"], "alpha": out["alpha"]}]

        return Case(
            group="decay",
            name=name,
            inputs=inputs,
            compute=compute,
            truth=truth,
            expected=expected,
            settings=SETTINGS,
            units=lambda leaves: {"scales": leaves["scales"].detach(), "decay": leaves["decay"].detach()},
            fixed=frozenset({"viewmat", "K"}),
        )

    return [
        case("picture, some faded", 0.7, 2.0, Value()),
        case("picture, all cut", 0.7, 300.0, Nothing()),
        case("picture, all dead", -1.0, 1.0, Nothing()),
    ]


def _count_losses() -> list[Case]:
    """The loss on the drawn share; `ste` has the value of `none` and the gradient of sigmoids."""
    kinds: tuple[CountGradient, ...] = ("none", "ste", "soft")

    def case(name: str, margins: Tensor, scale: float, kind: CountGradient, largest: float = 5.0) -> Case:
        def compute(setting: Setting) -> Compute:
            return lambda leaves: {
                "loss": count_loss(leaves["margin"], scale, largest, kind) + 0 * leaves["margin"].sum()
            }

        def truth(leaves: Tensors) -> list[Tensors]:
            margin = leaves["margin"]
            drawn, fades = (margin > 0).double(), torch.sigmoid(2 * margin)
            # rows that are not drawn have no gradient in `ste`
            sinks = drawn * fades + (1 - drawn) * fades.detach()
            share = {"none": drawn.mean(), "soft": fades.mean(), "ste": sinks.mean() + (drawn - sinks).mean().detach()}
            weight = (scale - 1) ** 2 / (1 if kind == "none" else (largest - 1) ** 2)
            return [{"loss": weight * torch.relu(share[kind] - target_share(scale)) ** 2 + 0 * margin.sum()}]

        return Case(
            group="decay",
            name=name,
            inputs=lambda: {"margin": margins},
            compute=compute,
            truth=truth,
            expected=Value(),
            settings=TORCH,
        )

    spread: Tensor = torch.linspace(-20, 20, 101).double()
    huge: Tensor = torch.linspace(-1e4, 1e4, 101).double()
    modes: tuple[Literal["none", "ste", "soft"], ...] = kinds
    return [
        *(case(f"count loss {kind}, scale 1", spread, 1.0, kind) for kind in modes),
        *(case(f"count loss {kind}, scale 5", spread, 5.0, kind) for kind in modes),
        *(case(f"count loss {kind}, margins to 1e4", huge, 3.0, kind) for kind in modes),
        *(case(f"count loss {kind}, all on the threshold", 0 * spread, 3.0, kind) for kind in modes),
        *(case(f"count loss {kind}, scale 1e6", spread, 1e6, kind, 1e6) for kind in modes),
    ]
