"""Geometry: sizes, shapes, rotations, places, cameras and counts at their extremes."""

import math
from functools import partial

import torch

from freqgs_plugin.reports.stability.case import Case, Nothing, Refused, Value
from freqgs_plugin.reports.stability.rendering import (
    ON_THRESHOLD,
    Scene,
    both_filters,
    camera,
    changed,
    rendering_case,
    single,
    splats,
    together,
)

case = partial(rendering_case, "geometry")


def cases() -> list[Case]:
    return [*_sizes(), *_anisotropy(), *_rotations(), *_places(), *_cameras(), *_counts(), *_not_numbers()]


def _scaled(size: float) -> Scene:
    return changed(splats(), scales=size), camera()


def _sizes() -> list[Case]:
    """Without antialiasing a Gaussian is never thinner than the blur; with it, a vanishing one vanishes."""
    out = []
    for size in (0.0, 1e-30, 1e-8):
        out += both_filters(f"scales {size:g}", partial(_scaled, size), "geometry", Value(), Nothing())
    for size in (1e3, 1e6, 1e20, 1e38):
        out += both_filters(f"scales {size:g}", partial(_scaled, size), "geometry", Value(gradient=1e-3))
    mixed = torch.tensor([1e-8, 1e6, 0.0]).double().repeat(8)[:, None].expand(24, 3)
    out += both_filters(
        "scales 1e-8, 1e6 and 0 side by side", lambda: (changed(splats(), scales=mixed), camera()), "geometry", Value()
    )
    flat = splats().scales.clone()
    flat[:, 0] = 0
    out += both_filters(
        "discs of no thickness", lambda: (changed(splats(), scales=flat), camera()), "geometry", Value()
    )
    out.append(case("no blur, scales 0", partial(_scaled, 0.0), Nothing(), blur=0.0))
    return out


def _needles(ratio: float, *, thin: bool) -> Scene:
    scales = splats().scales.clone()
    long, short = (1.0, 1.0 / ratio) if thin else (0.02 * ratio, 0.02)
    scales[:, 0], scales[:, 1], scales[:, 2] = long, short, short
    return changed(splats(), scales=scales), camera()


def _across(size: int, length: float, ratio: float) -> Scene:
    """Needles of `length` in all directions of the image plane of a large image."""
    gaussians = splats(seed=3)
    angle = torch.arange(24).double() * (math.pi / 24)
    zero = torch.zeros(24, dtype=torch.float64)
    quats = torch.stack([torch.cos(angle / 2), zero, zero, torch.sin(angle / 2)], -1)
    scales = torch.tensor([length, length / ratio, length / ratio]).double().expand(24, 3)
    return changed(gaussians, quats=quats, scales=scales), camera(size, size, focal=float(size))


def _anisotropy() -> list[Case]:
    out = [
        case(
            f"needles across 400x400, length {length:g}, anisotropy {ratio:g}",
            partial(_across, 400, length, ratio),
            Value(value=1e-4, gradient=1e-3),
            antialiased=False,
            shift=1e-3,
            large=length != 10.0,
        )
        for length, ratio in ((1.0, 1e3), (10.0, 1e3), (1e3, 1e8))
    ]
    for power in (2, 4, 6, 8):
        tolerance = Value(value=1e-4, gradient=1e-3, exact_gradient=1e-5)
        thin, long = (partial(_needles, 10.0**power, thin=thin) for thin in (True, False))
        vanishing = tolerance if power == 2 else Nothing()
        out += both_filters(f"anisotropy 1e{power}, long axis 1", thin, "geometry", tolerance, vanishing)
        out += both_filters(f"anisotropy 1e{power}, short axis 0.02", long, "geometry", tolerance)
    return out


def _turned(factor: float) -> Scene:
    return changed(splats(), quats=splats().quats * factor), camera()


def _rotations() -> list[Case]:
    zero = changed(splats(), quats=0.0)
    return [
        case("quaternions 0", lambda: (zero, camera())),
        *(case(f"quaternions times {f:g}", partial(_turned, f)) for f in (1e-36, 1e-30, 1e-12, 1e12, 1e30, 1e38)),
    ]


def _at(mean: tuple[float, float, float], scale: float) -> Scene:
    return single(mean=mean, scale=scale), camera()


def _far_scene() -> Scene:
    """A scene and its camera, together 1e6 units from the origin."""
    place = (1e6, -1e6, 5e5)
    moved = splats().means + torch.tensor(place).double()
    return changed(splats(), means=moved), camera(position=place, angles=(0.2, 0.4))


def _places() -> list[Case]:
    near = (0.0, 0.0, 0.01)
    behind = splats().means.clone()
    behind[:, 2] *= -1
    outside = [splats().means + torch.tensor(shift).double() for shift in ((60.0, 0, 0), (-60.0, 0, 0), (0, 60.0, 0))]
    tied = splats().means.clone()
    tied[:, 2] = 3.0
    pixel = torch.tensor([0.02, 0.03, 3.0]).double() + 1e-3 * splats(200).means * torch.tensor([1.0, 1.0, 0.0])
    return [
        case("on the near plane", partial(_at, near, 0.001), shift=ON_THRESHOLD),
        case("just in front of the near plane, small", partial(_at, (0.001, 0.002, 0.0101), 0.001)),
        case("just in front of the near plane, large", partial(_at, (0.001, 0.002, 0.0101), 10.0)),
        case("just in front of the near plane, aside", partial(_at, (0.02, 0.01, 0.0101), 0.02)),
        case("just behind the near plane", partial(_at, (0.0, 0.0, 0.00999), 1.0), Nothing()),
        case("at the camera's centre", partial(_at, (0.0, 0.0, 0.0), 1.0), Nothing()),
        case("in the camera's plane", partial(_at, (1.0, 2.0, 0.0), 1.0), Nothing()),
        case("all behind the camera", lambda: (changed(splats(), means=behind), camera()), Nothing()),
        case("1e6 units ahead, a dot", partial(_at, (1e3, -2e3, 1e6), 1e3), antialiased=False),
        case("1e6 units ahead, large", partial(_at, (1e4, -2e4, 1e6), 1e5)),
        case("1e6 units aside", partial(_at, (1e6, 0.0, 2.0), 0.1), Nothing()),
        case("1e6 units aside, as large", partial(_at, (1e6, 0.0, 2.0), 1e6)),
        case("1e38 units ahead, as large", partial(_at, (0.0, 0.0, 1e38), 1e38)),
        case("1e38 units aside", partial(_at, (1e38, -1e38, 2.0), 0.1), Nothing()),
        case("1e6 units behind, as large", partial(_at, (0.0, 0.0, -1e6), 1e6), Nothing()),
        case("scene and camera 1e6 units from the origin", _far_scene, Value(gradient=1e-3)),
        *(
            case(f"all outside, {where}", lambda means=means: (changed(splats(), means=means), camera()), Nothing())
            for where, means in zip(("right", "left", "below"), outside, strict=True)
        ),
        case(
            "all in one pixel",
            lambda: (changed(splats(200, size=(1e-3, 5e-3)), means=pixel), camera()),
            antialiased=False,
        ),
        case("equal depths", lambda: (changed(splats(), means=tied), camera())),
        case("the same Gaussian 24 times", lambda: (together(*[single()] * 24), camera())),
    ]


def _cameras() -> list[Case]:
    out = []
    for focal in (4.0, 0.4):
        degrees = 2 * math.degrees(math.atan(37 / 2 / focal))
        out.append(
            case(f"field of view {degrees:.0f} degrees", lambda f=focal: (splats(size=(0.5, 4.0)), camera(focal=f)))
        )
    out.append(case("focal length 1e5 px", lambda: (splats(size=(1e-5, 1e-3)), camera(focal=1e5)), Nothing()))
    out.append(case("focal length 1e5 px, in view", lambda: (_tiny_ahead(), camera(focal=1e5))))
    for shift in (100.0, 1e4):
        out.append(
            case(f"principal point {shift:g} px outside", lambda s=shift: (_towards(s), camera(shift=(s, -s / 2))))
        )
    for width, height in ((1, 1), (1, 64), (64, 1), (4096, 4), (4, 4096), (17, 16)):
        out.append(
            case(f"image {width}x{height}", lambda w=width, h=height: (splats(), camera(w, h, focal=float(max(w, h)))))
        )
    return out


def _tiny_ahead():
    gaussians = splats(size=(1e-5, 1e-3))
    return changed(gaussians, means=gaussians.means * torch.tensor([3e-4, 3e-4, 1.0]))


def _towards(shift: float):
    """Gaussians that a camera with its principal point outside of the image sees."""
    gaussians = splats()
    offset = torch.tensor([-shift / 40, shift / 2 / 44]).double() * gaussians.means[:, 2:]
    return changed(gaussians, means=torch.cat([gaussians.means[:, :2] + offset, gaussians.means[:, 2:]], -1))


def _counts() -> list[Case]:
    def million() -> Scene:
        return splats(1_000_000, size=(0.005, 0.02)), camera(320, 240, focal=320.0)

    return [
        case("no Gaussians", lambda: (splats(0), camera()), Nothing()),
        case("one Gaussian", lambda: (single(), camera())),
        case(
            "more than 2^31 entries of tiles",
            lambda: (changed(splats(8300), scales=1e6), camera(8192, 8192, focal=8192.0)),
            Refused(ValueError, r"8,300 Gaussians meet [\d,]+ tiles of the 8192x8192 image, more than 2,147,483,647"),
            large=True,
        ),
        case("a million Gaussians", million, Value(value=1e-2, gradient=1e-2), large=True, by_hand=False),
    ]


def _not_numbers() -> list[Case]:
    out = []
    for name in ("means", "quats", "scales", "opacities", "features"):
        for bad in (math.nan, math.inf):
            values = getattr(splats(), name).clone()
            values.view(24, -1)[3, 0] = bad
            message = rf"{name} of 1 of 24 Gaussians .* row 3.*{bad}"
            out.append(
                case(
                    f"{name} with {bad}",
                    lambda name=name, values=values: (changed(splats(), **{name: values}), camera()),
                    Refused(ValueError, message),
                )
            )
    return out
