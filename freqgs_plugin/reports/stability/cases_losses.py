"""Losses and pyramids: magnitudes at zero, constant and shifted images, odd and tiny sizes, every size 1..65."""

from collections.abc import Callable

import torch
from torch import Tensor

from freqgs_plugin.functional.image_loss import image_distance, ssim
from freqgs_plugin.functional.pyramid import collapse, laplacian, low_pass, reduce, reduce_by_convolution
from freqgs_plugin.functional.spectrum import magnitude, magnitude_distance_to
from freqgs_plugin.reports.stability import plain
from freqgs_plugin.reports.stability.case import Bounded, Case, Compute, Setting, Tensors, Value

TORCH = (Setting("torch", torch.float32), Setting("torch", torch.float64))
COMPILED = (Setting("numba", torch.float32), Setting("numba", torch.float64))
SIZES = range(1, 66)

Images = tuple[Tensor, Tensor]
Loss = Callable[[Tensor, Tensor], Tensor]


def cases() -> list[Case]:
    return [*_spectra(), *_similarities(), *_distances(), *_pyramids()]


def noise(height: int, width: int, seed: int = 0, channels: int = 3) -> Tensor:
    """A random image in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, channels, height, width, generator=generator, dtype=torch.float64)


def _loss_case(
    name: str,
    images: Callable[[], Images],
    loss: Loss,
    truth: Loss,
    expected: Value | Bounded = Value(),  # noqa: B008
) -> Case:
    """`loss(pred, target)`: compiled, and in plain torch, which is what runs where the target wants a gradient too."""

    def inputs() -> Tensors:
        pred, target = images()
        return {"pred": pred, "target": target}

    def compute(setting: Setting) -> Compute:
        def f(leaves: Tensors) -> Tensors:
            target = leaves["target"].detach()
            return {"loss": loss(leaves["pred"], target.requires_grad_(setting.backend == "torch"))}

        return f

    return Case(
        group="losses",
        name=name,
        inputs=inputs,
        compute=compute,
        truth=lambda leaves: [{"loss": truth(leaves["pred"], leaves["target"])}],
        expected=expected,
        settings=TORCH + COMPILED,
        fixed=frozenset({"target"}),
    )


def _dft(pred: Tensor, target: Tensor) -> Tensor:
    """Both ways to the same number: magnitudes of the target are differentiable only in plain torch."""
    return magnitude_distance_to(pred, magnitude(target))


def _spectra() -> list[Case]:
    """A magnitude has no direction at 0, and the distance none at 0: there only a bound on the gradient is right."""

    def case(name: str, images: Callable[[], Images], expected: Value | Bounded = Value()) -> Case:  # noqa: B008
        return _loss_case(f"DFT distance, {name}", images, _dft, plain.dft_distance, expected)

    black, white = (lambda s=s: torch.full((1, 3, 24, 31), s).double() for s in (0.0, 1.0))
    kink = Bounded(gradient=1.0)
    shifted = lambda: (noise(24, 31), noise(24, 31).roll((1, 1), (-2, -1)))  # noqa: E731
    out = [
        case("noise", lambda: (noise(24, 31), noise(24, 31, 1))),
        case("black against noise", lambda: (black(), noise(24, 31, 1)), Value()),
        case("black against black", lambda: (black(), black()), Value()),
        case("noise against black", lambda: (noise(24, 31), black())),
        case("white against noise", lambda: (white(), noise(24, 31, 1)), kink),
        case("white against white", lambda: (white(), white()), kink),
        case("constants 0.3 and 0.7", lambda: (0.3 * white(), 0.7 * white()), kink),
        case("an image and itself", lambda: (noise(24, 31), noise(24, 31)), kink),
        case("an image and its shift by 1 pixel", shifted, kink),
        case("values of +-1e3", lambda: (2e3 * noise(24, 31) - 1e3, noise(24, 31, 1)), Value(gradient=1e-3)),
        case("values of 1e-30", lambda: (1e-30 * noise(24, 31), 1e-30 * noise(24, 31, 1)), kink),
        case("values of 1e30", lambda: (1e30 * noise(24, 31), noise(24, 31, 1)), Value(gradient=1e-3)),
    ]
    for height, width in ((1, 1), (1, 2), (2, 1), (1, 3), (2, 2), (3, 3), (1, 64), (63, 1), (5, 8), (7, 64), (65, 65)):
        out.append(case(f"{height}x{width}", lambda h=height, w=width: (noise(h, w), noise(h, w, 1))))
    return out


def _similarities() -> list[Case]:
    """Float32 knows a variance to about 1e-7 of the squared mean; SSIM adds 9e-4 to it."""
    coarse = Value(value=2e-4, gradient=1e-3)

    def case(name: str, images: Callable[[], Images], expected: Value | Bounded = Value()) -> Case:  # noqa: B008
        return _loss_case(f"SSIM, {name}", images, ssim, plain.ssim, expected)

    def constant(value: float) -> Tensor:
        return torch.full((1, 3, 20, 23), value).double()

    still = Bounded(value=2e-4, gradient=1e-4)
    out = [
        case("noise", lambda: (noise(20, 23), noise(20, 23, 1)), coarse),
        case("an image and itself", lambda: (noise(20, 23), noise(20, 23)), still),
        case("black against black", lambda: (constant(0.0), constant(0.0)), still),
        case("white against white", lambda: (constant(1.0), constant(1.0)), still),
        case("black against white", lambda: (constant(0.0), constant(1.0)), coarse),
        case("constants 0.3 and 0.7", lambda: (constant(0.3), constant(0.7)), coarse),
        case("constant against noise", lambda: (constant(0.5), noise(20, 23)), coarse),
        case("values of +-10", lambda: (20 * noise(20, 23) - 10, noise(20, 23, 1)), coarse),
        case("values of +-1e3", lambda: (2e3 * noise(20, 23) - 1e3, noise(20, 23, 1)), coarse),
        case("values around 1e3", lambda: (1e3 + noise(20, 23), 1e3 + noise(20, 23, 1)), coarse),
        case("values around 1e3 against noise", lambda: (1e3 + noise(20, 23), noise(20, 23, 1)), coarse),
        case("constants 10 and 10.01", lambda: (constant(10.0), constant(10.01)), coarse),
        case("constants 100 and 100.01", lambda: (constant(100.0), constant(100.01)), coarse),
    ]
    for height, width in ((1, 1), (1, 5), (10, 10), (11, 11), (12, 3), (2, 40), (43, 43)):
        out.append(case(f"{height}x{width}", lambda h=height, w=width: (noise(h, w), noise(h, w, 1)), coarse))
    return out


def _distances() -> list[Case]:
    def truth(pred: Tensor, target: Tensor) -> Tensor:
        return 0.8 * (pred - target).abs().mean() + 0.2 * (1 - plain.ssim(pred, target))

    coarse = Value(value=2e-4, gradient=1e-3)
    return [
        _loss_case("image term, noise", lambda: (noise(20, 23), noise(20, 23, 1)), image_distance, truth, coarse),
        _loss_case(
            "image term, an image and itself",
            lambda: (noise(20, 23), noise(20, 23)),
            image_distance,
            truth,
            Bounded(value=2e-4, gradient=1e-4),
        ),
    ]


def _pyramids() -> list[Case]:
    def all_sizes(function: Callable[[Tensor], Tensor]) -> Callable[[Tensors], Tensors]:
        """`function` of crops k x k, 1 x k, k x 1 and k x (66 - k) for k = 1..65."""

        def f(leaves: Tensors) -> Tensors:
            image, out = leaves["image"], {}
            for k in SIZES:
                for height, width in {(k, k), (1, k), (k, 1), (k, 66 - k)}:
                    out[f"{height}x{width}"] = function(image[..., :height, :width])
            return out

        return f

    def case(
        name: str,
        truth: Callable[[Tensor], Tensor],
        in_torch: Callable[[Tensor], Tensor] | None,
        compiled: Callable[[Tensor], Tensor] | None = None,
    ) -> Case:
        functions = {"torch": in_torch, "numba": compiled}

        def compute(setting: Setting) -> Compute:
            function = functions[setting.backend]
            assert function is not None
            return all_sizes(function)

        return Case(
            group="losses",
            name=name,
            inputs=lambda: {"image": noise(65, 65, channels=1)},
            compute=compute,
            truth=lambda leaves: [all_sizes(truth)(leaves)],
            expected=Value(),
            settings=tuple(s for s in TORCH + COMPILED if functions[s.backend] is not None),
        )

    def thrice(x: Tensor) -> Tensor:
        return plain.reduce(plain.reduce(plain.reduce(x)))

    def there_and_back(x: Tensor) -> Tensor:
        return collapse(laplacian(x, 4))

    by_convolution = reduce_by_convolution
    return [
        case("collapse of a Laplacian pyramid, sizes 1..65", lambda x: 1 * x, None, there_and_back),
        case("REDUCE, sizes 1..65", plain.reduce, by_convolution, reduce),
        case("REDUCE three times, sizes 1..65", thrice, lambda x: by_convolution(x, 3), lambda x: reduce(x, 3)),
        case("low-pass, sizes 1..65", lambda x: plain.low_pass(x, 1), lambda x: low_pass(x, 1)),
        case("low-pass three times, sizes 1..65", lambda x: plain.low_pass(x, 3), lambda x: low_pass(x, 3)),
    ]
