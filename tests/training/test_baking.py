"""Plain Gaussians in place of signed ones."""

from dataclasses import replace

import pytest
import torch

from freqgs_plugin.functional.harmonics import level_colours_in_torch
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.training.baking import BakeOptions, bake, unsigned
from freqgs_plugin.types import Camera, Gaussians

BLACK = torch.zeros(3)


def camera(x=0.0):
    viewmat = torch.eye(4)
    viewmat[0, 3], viewmat[2, 3] = x, 4.0
    return Camera(viewmat, torch.tensor([[40.0, 0, 20], [0, 40.0, 16], [0, 0, 1]]), 40, 32)


CAMERAS = [camera(-0.3), camera(0.0), camera(0.4)]


def signed_scene(n=60, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(n, 3) * 0.6,
        quats=normal(n, 4),
        scales=(normal(n, 3) * 0.2 - 1.8).exp(),
        opacities=torch.rand(n, generator=generator) * 0.8 + 0.1,
        features_dc=normal(n, 3),
        features_rest=0.2 * normal(n, 3, 3),
        level=(torch.arange(n) % 3 + 1).int(),
        signed_residuals=True,
    )


def pictures(gaussians, antialiased=True):
    def draw(view):
        options = {"rasterizer": get_rasterizer("auto", "cpu"), "background": BLACK, "antialiased": antialiased}
        return render(gaussians, view, depth=False, **options).features.detach()

    return draw


def baked(scene, steps, antialiased=True, **more):
    rasterizer = get_rasterizer("auto", "cpu")
    options = BakeOptions(steps, small=0.3)
    return bake(
        unsigned(scene), pictures(scene), CAMERAS, rasterizer, BLACK, antialiased=antialiased, options=options, **more
    )


def test_colours_that_are_not_negative_stay(assert_close):
    scene = signed_scene()
    offsets = scene.means - camera().centre

    def colours(g):
        return level_colours_in_torch(g.features_dc, g.features_rest, offsets, g.level, g.signed_residuals)

    before, after = colours(scene), colours(unsigned(scene))
    assert (before < 0).any() and (before[scene.level > 1] > 0).any()
    assert_close(after, before.clamp_min(0))
    plain = replace(scene, signed_residuals=False)
    assert unsigned(plain) is plain


def test_it_comes_closer_and_repeats():
    scene = signed_scene()
    first, again = baked(scene, 60), baked(scene, 60)
    assert first.psnr > first.start_psnr + 2 and first.best_step > 0 and not first.interrupted
    assert not first.gaussians.signed_residuals and torch.equal(first.gaussians.level, scene.level)
    assert torch.equal(first.gaussians.features_dc, again.gaussians.features_dc)


def test_other_viewers():
    scene = signed_scene()
    found = baked(scene, 60, antialiased=False)
    shown = pictures(found.gaussians, antialiased=False)(camera(0.1))
    unbaked = pictures(unsigned(scene), antialiased=False)(camera(0.1))
    ours = pictures(scene)(camera(0.1)).clamp(0, 1)
    assert (shown.clamp(0, 1) - ours).square().mean() < 0.5 * (unbaked.clamp(0, 1) - ours).square().mean()


def test_an_interrupt_keeps_the_best_so_far():
    def stop(done, best):
        if done == 45:
            raise KeyboardInterrupt

    found = baked(signed_scene(), 60, on_step=stop)
    assert found.interrupted and found.steps == 45 and 0 < found.best_step <= 45
    assert found.psnr > found.start_psnr


def test_no_steps_give_the_start():
    scene = signed_scene()
    found = baked(scene, 0)
    assert (found.steps, found.best_step, found.psnr) == (0, 0, found.start_psnr)
    assert torch.equal(found.gaussians.features_dc, unsigned(scene).features_dc)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"opacities": torch.full((60,), float("nan"))}, "opacities of 60 of 60 Gaussians are not finite"),
        ({"signed_residuals": True}, "call `unsigned` first"),
    ],
)
def test_bad_gaussians(change, message):
    start = replace(unsigned(signed_scene()), **change)
    with pytest.raises(ValueError, match=message):
        bake(start, pictures(signed_scene()), CAMERAS, get_rasterizer("auto", "cpu"), BLACK, antialiased=True)


def test_no_cameras():
    with pytest.raises(ValueError, match="needs training views"):
        scene, rasterizer = signed_scene(), get_rasterizer("auto", "cpu")
        bake(unsigned(scene), pictures(scene), [], rasterizer, BLACK, antialiased=True)
