"""A run without training: random Gaussians in levels, drawn by the torch rasterizer."""

from types import SimpleNamespace

import torch

from freqgs_plugin.demo.scene import look_at
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.types import Gaussians


def fake_run(levels=3, n=60, signed=True):
    g = torch.Generator().manual_seed(0)
    means, quats = torch.rand(n, 3, generator=g) - 0.5, torch.randn(n, 4, generator=g)
    scales, opacities = torch.rand(n, 3, generator=g) * 0.1 + 0.02, torch.rand(n, generator=g) * 0.8 + 0.1
    sh = torch.randn(n, 4, 3, generator=g) * 0.5
    gaussians = Gaussians(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        features_dc=sh[:, 0],
        features_rest=sh[:, 1:],
        level=torch.arange(n) % levels + 1,
        signed_residuals=signed,
    )
    return SimpleNamespace(
        gaussians=gaussians,
        background=torch.full((3,), 0.2),
        rasterizer=get_rasterizer("torch", "cpu"),
        num_levels=levels,
        antialiased=True,
    )


def fake_views(count=2, width=40, height=30):
    target = torch.zeros(3).numpy().astype(float)
    views = []
    for i in range(count):
        camera = look_at(torch.tensor([2.0, 0.3 * i, 0.4]).numpy().astype(float), target, width, height)
        image = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(i))
        views.append(SimpleNamespace(name=f"view_{i}.png", camera=camera, image=image))
    return views
