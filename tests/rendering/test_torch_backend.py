"""The reference rasterizer against plain autograd, closed forms and limits."""

import pytest
import scenes
import torch
from reference import render_dense

from freqgs_plugin.functional.projection import project
from freqgs_plugin.rendering import torch_compositing
from freqgs_plugin.rendering.base import ALPHA_MIN, Rasterizer
from freqgs_plugin.rendering.torch_backend import TorchRasterizer
from freqgs_plugin.rendering.torch_tiles import bin_splats
from freqgs_plugin.types import Splats

AWKWARD = scenes.awkward()


def noise(*shape, seed=7):
    return torch.randn(*shape, generator=scenes.generator(seed), dtype=torch.float64)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("d", [1, 3, 5])
@pytest.mark.parametrize("name", AWKWARD)
def test_equals_autograd_in_float64(name, d, antialiased, assert_close):
    splats, camera = AWKWARD[name]
    splats = scenes.replace(splats, features=noise(len(splats), d))
    background = noise(d, seed=8)
    ours, theirs = (scenes.leaves_of(splats, torch.float64) for _ in range(2))
    rendering = TorchRasterizer()(ours, camera, background=background, antialiased=antialiased)
    expected = render_dense(theirs, camera, background=background, antialiased=antialiased)
    for key in ("features", "alpha", "depth"):
        assert_close(getattr(rendering, key), getattr(expected, key).view(getattr(rendering, key).shape), message=key)
    rendering.info["means2d"].retain_grad()
    weights = noise(camera.height, camera.width, d), noise(camera.height, camera.width, 1, seed=9)
    for r in (rendering, expected):
        ((r.features * weights[0]).sum() + (r.alpha.view(weights[1].shape) * weights[1]).sum()).backward()
    if len(splats) == 0:
        return
    assert_close(rendering.info["means2d"].grad[0], expected.means2d_grad, message="means2d.grad")
    assert_close(rendering.info["means2d"].absgrad[0], expected.absgrad, message="means2d.absgrad")
    for key in scenes.LEAVES:
        # gsplat's float64 projection loses digits on needles and tiny quaternions; that is what we avoid
        loose = {"needles": 1e4, "zero_quaternion": 1e3}.get(name, 10.0)
        ours_grad, theirs_grad = getattr(ours, key).grad, getattr(theirs, key).grad
        if key == "quats" and name == "zero_quaternion":
            ours_grad, theirs_grad = ours_grad[2:], theirs_grad[2:]
        if antialiased and name == "needles" and key in ("quats", "scales"):
            assert torch.isfinite(ours_grad).all()
            continue
        assert_close(ours_grad, theirs_grad, loosen=loose, message=key)


def test_gradcheck():
    splats, camera = scenes.splats(5, d=2, size=(0.1, 0.3)), scenes.camera(9, 7, focal=9.0)
    leaves = scenes.leaves_of(splats, torch.float64)
    background = noise(2).requires_grad_()

    def render(*values):
        rendering = TorchRasterizer()(Splats(*values[:5]), camera, background=values[5], antialiased=True)
        return rendering.features, rendering.alpha

    inputs = (*(getattr(leaves, k) for k in scenes.LEAVES), background)
    assert torch.autograd.gradcheck(render, inputs, eps=1e-7, atol=1e-5)


def test_one_gaussian_has_its_closed_form(assert_close):
    camera = scenes.camera(15, 11, focal=20.0)
    splats = Splats(
        means=torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        scales=torch.full((1, 3), 0.3, dtype=torch.float64),
        opacities=torch.tensor([0.7], dtype=torch.float64),
        features=torch.tensor([[2.0, -1.0]], dtype=torch.float64),
    )
    camera.viewmat[:3, 3] = 0
    rendering = TorchRasterizer()(splats, camera)
    x, y = torch.arange(15) + 0.5 - 7.5, torch.arange(11) + 0.5 - 5.5
    sigma_x, sigma_y = (20.0 * 0.15) ** 2 + 0.3, (22.0 * 0.15) ** 2 + 0.3
    alpha = 0.7 * torch.exp(-0.5 * (x[None] ** 2 / sigma_x + y[:, None] ** 2 / sigma_y)).double()
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)[..., None]
    assert_close(rendering.alpha, alpha, loosen=1e4)
    assert_close(rendering.features, alpha * splats.features[0], loosen=1e4)
    assert_close(rendering.depth, 2.0 * (alpha > 0).double())


def test_order_of_the_rows_is_irrelevant(assert_close):
    splats, camera = AWKWARD["plain"]
    shuffled = torch.randperm(len(splats), generator=scenes.generator(2))
    other = Splats(**{k: getattr(splats, k)[shuffled] for k in scenes.LEAVES})
    a, b = (TorchRasterizer()(s, camera) for s in (splats, other))
    assert_close(a.features, b.features)
    assert torch.equal(a.info["radii"][0, shuffled], b.info["radii"][0])


def test_equal_depths_are_ordered_by_row():
    camera = scenes.camera(5, 5)
    one = scenes.splats(1, d=1)
    pair = Splats(**{k: getattr(one, k).repeat_interleave(2, 0) for k in scenes.LEAVES})
    pair = scenes.replace(
        pair, means=torch.tensor([[0.0, 0, 3]] * 2).double(), opacities=torch.tensor([1.0, 1.0]).double(),
        features=torch.tensor([[1.0], [100.0]]).double(), scales=torch.full((2, 3), 10.0).double(),
    )  # fmt: skip
    image = TorchRasterizer()(pair, camera).features
    # 0.999 of the first; the second would bring the transmittance to 1e-6, so it is not drawn
    torch.testing.assert_close(image, torch.full_like(image, 0.999), rtol=2e-3, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-30, 1e-8, 1e6, 1e20])
def test_extreme_scales_stay_finite(size, dtype):
    splats, camera = AWKWARD["behind"]
    leaves = scenes.leaves_of(scenes.replace(splats, scales=torch.full_like(splats.scales, size)), dtype)
    rendering = TorchRasterizer()(leaves, scenes.cast(camera, dtype), antialiased=True)
    assert torch.isfinite(rendering.features).all() and torch.isfinite(rendering.depth).all()
    rendering.features.square().sum().backward()
    for key in scenes.LEAVES:
        assert torch.isfinite(getattr(leaves, key).grad).all(), key


def test_no_pixel_of_a_footprint_is_missed():
    """Tiles are lists of exact ellipses: drawing everything in every tile gives the same image."""
    splats, camera = scenes.splats(300, seed=11, size=(0.01, 1.0)), scenes.camera(53, 47, angles=(0.1, 0.4, 0.2))
    image = TorchRasterizer()(splats, camera).features
    torch.testing.assert_close(image, render_dense(splats, camera).features, rtol=1e-9, atol=1e-11)


def test_tiles_hold_no_gaussian_that_misses_them():
    splats, camera = scenes.splats(200, seed=12), scenes.camera(64, 48)
    projected = project(splats.means, splats.quats, splats.scales, camera, 0.3)
    tiles = bin_splats(projected, splats.opacities, camera)
    tile = torch.repeat_interleave(torch.arange(tiles.counts.shape[0]), tiles.counts)
    offsets = (torch.arange(8) - 3.5).double()
    y, x = (c.reshape(-1) for c in torch.meshgrid(offsets, offsets, indexing="ij"))
    centres = tiles.centres(tile, projected.means2d)
    dx, dy = (centres[:, i, None] + p - projected.means2d[tiles.rows, i, None] for i, p in ((0, x), (1, y)))
    a, b, c = projected.conics[tiles.rows, :, None].unbind(1)
    alpha = splats.opacities[tiles.rows, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    assert (alpha.amax(1) >= ALPHA_MIN).double().mean() > 0.97


def test_absgrad_and_depth_are_optional():
    splats, camera = AWKWARD["plain"]
    leaves = scenes.leaves_of(splats, torch.float64)
    rasterizer = TorchRasterizer(absgrad=False)
    assert isinstance(rasterizer, Rasterizer) and rasterizer.name == "torch"
    rendering = rasterizer(leaves, camera, depth=False)
    rendering.info["means2d"].retain_grad()
    rendering.features.sum().backward()
    assert rendering.info["means2d"].grad.shape == (1, 40, 2)
    assert not hasattr(rendering.info["means2d"], "absgrad")
    assert not rendering.depth.any() and not rendering.depth.requires_grad


def test_groups_slabs_and_steps_do_not_change_the_picture(monkeypatch, assert_close):
    splats, camera = AWKWARD["finished_pixels"]
    results = []
    for group, step, slab in ((512, 8, 32), (3, 2, 4), (1, 1, 1)):
        for name, value in (("GROUP", group), ("STEP", step), ("SLAB", slab)):
            monkeypatch.setattr(torch_compositing, name, value)
        leaves = scenes.leaves_of(splats, torch.float64)
        rendering = TorchRasterizer()(leaves, camera)
        rendering.features.square().sum().backward()
        results.append((rendering.features, *(getattr(leaves, k).grad for k in scenes.LEAVES)))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert_close(a, b, loosen=10)


def test_the_view_matrix_gets_a_gradient():
    splats, camera = AWKWARD["plain"]
    camera = scenes.cast(camera, torch.float64)
    camera.viewmat.requires_grad_()
    TorchRasterizer()(splats, camera).features.square().sum().backward()
    assert camera.viewmat.grad[:3].abs().min() > 0
