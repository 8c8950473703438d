"""Cases that are pictures: Gaussians and a camera, put to every rasterizer."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.rendering.base import BLUR, get_rasterizer
from freqgs_plugin.reports.stability.case import Case, Compute, Group, Nothing, Refused, Setting, Tensors, Value
from freqgs_plugin.reports.stability.dense import dense
from freqgs_plugin.types import Camera, Splats

SETTINGS = (
    Setting("torch", torch.float32),
    Setting("torch", torch.float64),
    Setting("numba", torch.float32),
    *((Setting("gsplat", torch.float32),) if torch.cuda.is_available() else ()),
)
LEAVES = ("means", "quats", "scales", "opacities", "features")
ON_THRESHOLD = 1e-5
"""on a threshold, both sides are right for numbers within this relative distance: some 100 roundings of float32"""
BACKGROUND = (0.3, -0.2, 0.9)

Scene = tuple[Splats, Camera]


def camera(
    width: int = 37,
    height: int = 29,
    *,
    focal: float = 40.0,
    shift: tuple[float, float] = (0.0, 0.0),
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    angles: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """Looks along +z from `position`; `angles` turn it about y and z, radians; `shift` moves the centre, px."""
    (a, b), zero = angles, 0.0
    about_y = torch.tensor([[math.cos(a), zero, math.sin(a)], [zero, 1, zero], [-math.sin(a), zero, math.cos(a)]])
    about_z = torch.tensor([[math.cos(b), -math.sin(b), zero], [math.sin(b), math.cos(b), zero], [zero, zero, 1]])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = about_y.double() @ about_z.double()
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor(position, dtype=torch.float64)
    K = torch.tensor(
        [[focal, 0, width / 2 + shift[0]], [0, 1.1 * focal, height / 2 + shift[1]], [0, 0, 1]], dtype=torch.float64
    )
    return Camera(viewmat.float().double(), K.float().double(), width, height)


def splats(n: int = 24, *, seed: int = 0, size: tuple[float, float] = (0.05, 0.4)) -> Splats:
    """n Gaussians at depths 2 to 6 that fill the view of `camera()`, with signed features; scales in `size`, world."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    z = uniform(n) * 4 + 2
    low, high = (math.log(s) for s in size)
    return Splats(
        means=torch.cat([(uniform(n, 2) - 0.5) * z[:, None], z[:, None]], -1),
        quats=torch.randn(n, 4, generator=generator, dtype=torch.float64),
        scales=torch.exp(uniform(n, 3) * (high - low) + low),
        opacities=uniform(n) * 0.9 + 0.05,
        features=torch.randn(n, 3, generator=generator, dtype=torch.float64),
    )


def single(
    *,
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    scale: float | tuple[float, float, float] = 0.1,
    opacity: float = 0.7,
    feature: tuple[float, float, float] = (1.0, -0.5, 0.25),
) -> Splats:
    """One Gaussian without rotation."""
    scales = (scale, scale, scale) if isinstance(scale, float) else scale
    values = (mean, (1.0, 0.0, 0.0, 0.0), scales, opacity, feature)
    means, quats, scales, opacities, features = (torch.tensor([v], dtype=torch.float64) for v in values)
    return Splats(means, quats, scales, opacities, features)


def changed(scene: Splats, **values: Tensor | float) -> Splats:
    """The same Gaussians with some fields replaced; a number fills the whole field."""
    tensors = {k: torch.full_like(getattr(scene, k), v) if isinstance(v, float) else v for k, v in values.items()}
    return replace(scene, **tensors)


def together(*parts: Splats) -> Splats:
    """All Gaussians of several scenes."""
    return Splats(*(torch.cat([getattr(part, name) for part in parts]) for name in LEAVES))


def rendering_case(
    group: Group,
    name: str,
    scene: Callable[[], Scene],
    expected: Value | Nothing | Refused = Value(),  # noqa: B008
    *,
    antialiased: bool = True,
    blur: float = BLUR,
    shift: float = 0.0,
    large: bool = False,
    by_hand: bool = True,
) -> Case:
    """The picture of a scene on a coloured background, with all its gradients.

    `shift`: relative distance from a threshold (alpha, transmittance, near plane) within which both sides are right.
    `by_hand`: the truth is `dense`, not torch in float64; for up to some millions of Gaussians times pixels.
    """

    def inputs() -> Tensors:
        gaussians, view = scene()
        leaves = {key: getattr(gaussians, key) for key in LEAVES}
        background = torch.tensor(BACKGROUND, dtype=torch.float64)
        return {**leaves, "background": background, "viewmat": view.viewmat, "K": view.K}

    def view_of(leaves: Tensors) -> Camera:
        _, view = scene()
        return Camera(leaves["viewmat"], leaves["K"], view.width, view.height)

    def compute(setting: Setting) -> Compute:
        rasterizer = get_rasterizer(setting.backend, setting.device)

        def render(leaves: Tensors) -> Tensors:
            gaussians = Splats(*(leaves[key] for key in LEAVES))
            rendering = rasterizer(
                gaussians, view_of(leaves), background=leaves["background"], blur=blur, antialiased=antialiased
            )
            return {"features": rendering.features, "alpha": rendering.alpha, "depth": rendering.depth}

        return render

    def exact(leaves: Tensors) -> list[Tensors]:
        gaussians = Splats(*(leaves[key] for key in LEAVES))
        return [
            dense(gaussians, view_of(leaves), leaves["background"], blur=blur, antialiased=antialiased, shift=side)
            for side in ((0.0, -shift, shift) if shift else (0.0,))
        ]

    return Case(
        group=group,
        name=name,
        inputs=inputs,
        compute=compute,
        truth=exact if by_hand else None,
        expected=expected,
        settings=SETTINGS,
        units=_natural_units,
        fixed=frozenset({"viewmat", "K"}),
        large=large,
    )


def both_filters(name: str, scene: Callable[[], Scene], group: Group, *expected: Value | Nothing) -> list[Case]:
    """The case without and with the antialiasing compensation; one outcome for each, or one for both."""
    classic, antialiased = expected * 2 if len(expected) == 1 else expected
    return [
        rendering_case(group, name, scene, classic, antialiased=False),
        rendering_case(group, f"{name}, antialiased", scene, antialiased, antialiased=True),
    ]


def _natural_units(inputs: Tensors) -> dict[str, Float[Tensor, "n _"]]:
    """Gradients per pixel of displacement, per relative change of scale, per radian of rotation."""
    depths = inputs["means"] @ inputs["viewmat"][2, :3] + inputs["viewmat"][2, 3]
    pixel = depths.clamp_min(0.01) / inputs["K"][0, 0]
    return {
        "means": pixel[:, None].detach(),
        "scales": inputs["scales"].detach(),
        "quats": inputs["quats"].norm(dim=-1, keepdim=True).detach(),
    }
