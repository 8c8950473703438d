"""Half precision around everything: under autocast all numbers stay those of float32."""

from collections.abc import Callable
from dataclasses import replace

import torch

from freqgs_plugin.functional.attenuation import DistanceDecay
from freqgs_plugin.functional.harmonics import level_colours, level_colours_in_torch
from freqgs_plugin.functional.image_loss import image_distance
from freqgs_plugin.functional.pyramid import laplacian, low_pass, reduce, reduce_by_convolution
from freqgs_plugin.functional.spectrum import band_energy, magnitude, magnitude_distance_to, radial_energy
from freqgs_plugin.reports.stability import plain
from freqgs_plugin.reports.stability.case import Case, Compute, Setting, Tensors, Value
from freqgs_plugin.reports.stability.cases_losses import noise
from freqgs_plugin.reports.stability.rendering import camera, rendering_case, splats
from freqgs_plugin.training.objective import pyramid_objective
from freqgs_plugin.types import Camera, Gaussians

HALVES = {"bfloat16": torch.bfloat16, "float16": torch.float16}
FLOAT32 = (Setting("torch", torch.float32),)
COMPILED = (Setting("numba", torch.float32),)
BOTH_WAYS = (Setting("torch", torch.float32), Setting("numba", torch.float32))


def cases() -> list[Case]:
    out = []
    for name, dtype in HALVES.items():
        out += [_under(name, dtype, case) for case in (_picture(), *_images(), *_geometry())]
    return out


def _under(name: str, dtype: torch.dtype, case: Case) -> Case:
    """The case with forward and backward inside of autocast; its truth is computed outside."""
    settings = tuple(s for s in case.settings if s.dtype == torch.float32)
    return replace(case, name=f"{case.name}, {name}", settings=settings, autocast=dtype)


def _picture() -> Case:
    return rendering_case(
        "autocast", "picture", lambda: (splats(), camera(position=(0.3, 0.2, -0.5), angles=(0.1, 0.2)))
    )


def _images() -> list[Case]:
    def case(
        name: str,
        function: Callable[..., torch.Tensor],
        truth: Callable[..., torch.Tensor] | None = None,
        settings: tuple[Setting, ...] = FLOAT32,
        expected: Value = Value(),  # noqa: B008
    ) -> Case:
        """`function(pred, target)`, whose target wants a gradient only in the plain torch form."""

        def compute(setting: Setting) -> Compute:
            def f(leaves: Tensors) -> Tensors:
                target = leaves["target"].detach().requires_grad_(setting.backend == "torch")
                return {"out": function(leaves["pred"], target)}

            return f

        def exact(leaves: Tensors) -> list[Tensors]:
            return [{"out": (truth or function)(leaves["pred"], leaves["target"])}]

        return Case(
            group="autocast",
            name=name,
            inputs=lambda: {"pred": noise(40, 37), "target": noise(40, 37, 1)},
            compute=compute,
            truth=exact,
            expected=expected,
            settings=settings,
            fixed=frozenset({"target"}),
        )

    def objective(pred: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        prefixes = [0.5 * pred[0].permute(1, 2, 0), pred[0].permute(1, 2, 0)]
        return torch.stack(list(pyramid_objective(prefixes, target[0].permute(1, 2, 0)).values())).sum()

    coarse = Value(value=2e-4, gradient=1e-3)
    return [
        case("DFT distance", lambda x, t: magnitude_distance_to(x, magnitude(t)), plain.dft_distance, BOTH_WAYS),
        case("image term", image_distance, None, BOTH_WAYS, coarse),
        case("whole objective of two levels", objective, None, BOTH_WAYS, coarse),
        case("REDUCE", lambda x, t: reduce(x), lambda x, t: plain.reduce(x), COMPILED),
        case("REDUCE by convolution", lambda x, t: reduce_by_convolution(x), lambda x, t: plain.reduce(x)),
        case("low-pass", lambda x, t: low_pass(x, 2), lambda x, t: plain.low_pass(x, 2)),
        case("Laplacian pyramid", lambda x, t: laplacian(x, 3)[2], lambda x, t: laplacian(x, 3)[2]),
        case("energy of octaves", lambda x, t: radial_energy(x, 3)),
        case("energy of bands", lambda x, t: band_energy(x, 3)),
    ]


def _geometry() -> list[Case]:
    def inputs() -> Tensors:
        generator = torch.Generator().manual_seed(3)
        scene, view = splats(), camera(position=(0.3, 0.2, -0.5), angles=(0.1, 0.2))
        sh = torch.randn(24, 9, 3, generator=generator, dtype=torch.float64)
        decay = 3 * torch.rand(24, generator=generator, dtype=torch.float64) + 1
        leaves = {"means": scene.means, "opacities": scene.opacities, "sh": sh, "decay": decay}
        return {**leaves, "viewmat": view.viewmat, "K": view.K}

    def case(name: str, function: Callable[[Tensors], torch.Tensor]) -> Case:
        return Case(
            group="autocast",
            name=name,
            inputs=inputs,
            compute=lambda setting: lambda leaves: {"out": function(leaves)},
            truth=lambda leaves: [{"out": function(leaves)}],
            expected=Value(),
            settings=FLOAT32,
            fixed=frozenset({"K"}),
        )

    def view(leaves: Tensors) -> Camera:
        return Camera(leaves["viewmat"], leaves["K"], 37, 29)

    def coloured(function: Callable[..., torch.Tensor], leaves: Tensors) -> torch.Tensor:
        level = torch.arange(24) % 2 + 1
        return function(leaves["sh"][:, 0], leaves["sh"][:, 1:], leaves["means"] - view(leaves).centre, level, True)

    def decayed(leaves: Tensors) -> torch.Tensor:
        level = torch.ones(24, dtype=torch.int64)
        still = torch.ones_like(leaves["means"])
        quats = torch.cat([still, still[:, :1]], 1)
        colours = (leaves["sh"][:, 0], leaves["sh"][:, 1:])
        gaussians = Gaussians(
            leaves["means"], quats, still, leaves["opacities"], *colours, level, decay=leaves["decay"]
        )
        return DistanceDecay(2.0, "frustum_max")(gaussians, view(leaves))

    return [
        case("camera centre", lambda leaves: view(leaves).centre),
        case("colours", lambda leaves: coloured(level_colours, leaves)),
        case("colours in torch", lambda leaves: coloured(level_colours_in_torch, leaves)),
        case("distance decay", decayed),
    ]
