"""Small random scenes and cameras, float64 unless asked otherwise; the same numbers on every machine."""

import math

import torch

from freqgs_plugin.types import Camera, Splats

LEAVES = ("means", "quats", "scales", "opacities", "features")


def generator(seed):
    return torch.Generator().manual_seed(seed)


def camera(width=37, height=29, focal=40.0, centre=(0.0, 0.0), angles=(0.0, 0.0, 0.0), dtype=torch.float64):
    """A pinhole camera near the origin looking along +z; `centre` shifts the principal point, px; angles in radians."""
    ax, ay, az = angles
    rx = torch.tensor([[1, 0, 0], [0, math.cos(ax), -math.sin(ax)], [0, math.sin(ax), math.cos(ax)]])
    ry = torch.tensor([[math.cos(ay), 0, math.sin(ay)], [0, 1, 0], [-math.sin(ay), 0, math.cos(ay)]])
    rz = torch.tensor([[math.cos(az), -math.sin(az), 0], [math.sin(az), math.cos(az), 0], [0, 0, 1]])
    viewmat = torch.eye(4, dtype=dtype)
    viewmat[:3, :3] = (rx.double() @ ry.double() @ rz.double()).to(dtype)
    viewmat[:3, 3] = torch.tensor([0.1, -0.05, 0.2], dtype=dtype)
    fx, fy = focal, focal * 1.1
    K = torch.tensor([[fx, 0, width / 2 + centre[0]], [0, fy, height / 2 + centre[1]], [0, 0, 1]], dtype=dtype)
    return Camera(viewmat, K, width, height)


def splats(n=40, d=3, seed=0, size=(0.03, 0.4), dtype=torch.float64):
    """n Gaussians at depths 2 to 6 that fill the view of `camera()`, with signed features."""
    g = generator(seed)
    z = torch.rand(n, generator=g, dtype=torch.float64) * 4 + 2
    xy = (torch.rand(n, 2, generator=g, dtype=torch.float64) - 0.5) * z[:, None]
    low, high = (math.log(s) for s in size)
    return Splats(
        means=torch.cat([xy, z[:, None]], -1).to(dtype),
        quats=torch.randn(n, 4, generator=g, dtype=torch.float64).to(dtype),
        scales=torch.exp(torch.rand(n, 3, generator=g, dtype=torch.float64) * (high - low) + low).to(dtype),
        opacities=(torch.rand(n, generator=g, dtype=torch.float64) * 0.9 + 0.05).to(dtype),
        features=torch.randn(n, d, generator=g, dtype=torch.float64).to(dtype),
    )


def replace(scene, **changes):
    return Splats(**{**{k: getattr(scene, k) for k in LEAVES}, **changes})


def leaves_of(scene, dtype):
    """The same splats as fresh leaves that require gradients, in `dtype`."""
    return Splats(**{k: getattr(scene, k).detach().clone().to(dtype).requires_grad_() for k in LEAVES})


def cast(view, dtype):
    return Camera(view.viewmat.detach().clone().to(dtype), view.K.to(dtype), view.width, view.height)


def awkward():
    """Name -> (splats, camera): what rasterizers get wrong."""
    base = splats()
    behind = base.means.clone()
    behind[::3, 2] *= -1
    behind[1, 2] = -0.2 + 0.01  # camera z of 0.01: on the near plane
    tied = base.means.clone()
    tied[:, 2] = 3.0
    opaque = base.opacities.clone()
    opaque[::2], opaque[1::4] = 1.0, 0.0
    quats = base.quats.clone()
    quats[0], quats[1], quats[2] = 0.0, quats[1] * 1e-12, quats[2] * 1e6
    needles = base.scales.clone()
    needles[::2] = torch.tensor([1e-8, 1e-3, 2.0], dtype=base.scales.dtype)
    wide = splats(12, seed=9, size=(3.0, 9.0))
    dense = splats(400, seed=3, size=(0.1, 0.6))
    return {
        "plain": (base, camera()),
        "off_centre": (base, camera(31, 45, centre=(-9.3, 6.1))),
        "rotated": (base, camera(angles=(0.2, -0.3, 0.7))),
        "behind": (replace(base, means=behind), camera()),
        "equal_depths": (replace(base, means=tied), camera()),
        "opacity_0_and_1": (replace(base, opacities=opaque), camera()),
        "zero_quaternion": (replace(base, quats=quats), camera()),
        "needles": (replace(base, scales=needles), camera()),
        "finished_pixels": (replace(dense, opacities=dense.opacities.clamp_min(0.4)), camera()),
        "capped": (replace(wide, opacities=wide.opacities * 0 + 1.0), camera()),
        "outside": (replace(base, means=base.means * base.means.new_tensor([3.0, 3.0, 1.0])), camera()),
        "one_pixel": (base, camera(1, 1)),
        "one_row": (base, camera(50, 1)),
        "one_gaussian": (splats(1, seed=5), camera()),
        "empty": (splats(0), camera()),
    }
