"""The gsplat backend: its call against the installed gsplat's signature, its errors, and on CUDA its pictures."""

import inspect
import sys
from types import ModuleType, SimpleNamespace

import gsplat
import pytest
import scenes
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from reference import composite_dense

from freqgs_plugin.rendering import gsplat_backend
from freqgs_plugin.rendering.base import NEAR_PLANE
from freqgs_plugin.rendering.gsplat_backend import GsplatRasterizer
from freqgs_plugin.rendering.torch_backend import TorchRasterizer

SIGNATURE = inspect.signature(gsplat.rasterization)
META_IN_SOURCE = inspect.getsource(gsplat.rasterization)


@pytest.fixture
def fake(monkeypatch):
    """Replaces gsplat.rasterization by one that checks its arguments like the real one, and keeps them in `calls`."""
    calls = []

    def rasterization(*args, **kwargs):
        bound = SIGNATURE.bind(*args, **kwargs)
        bound.apply_defaults()
        a = bound.arguments
        calls.append(a)
        n, d = a["colors"].shape
        assert a["means"].shape == (n, 3) and a["quats"].shape == (n, 4) and a["scales"].shape == (n, 3)
        assert a["opacities"].shape == (n,) and a["viewmats"].shape == (1, 4, 4) and a["Ks"].shape == (1, 3, 3)
        assert a["backgrounds"] is None or a["backgrounds"].shape == (1, d)
        channels = d + (a["render_mode"] == "RGB+ED")
        image = torch.arange(channels).float().expand(1, a["height"], a["width"], channels)
        meta = {
            "camera_ids": None, "gaussian_ids": None, "radii": rasterization.radii[:, :n],
            "means2d": torch.zeros(1, n, 2), "depths": torch.ones(1, n), "conics": torch.ones(1, n, 3),
            "opacities": a["opacities"][None], "tile_width": 1, "tile_height": 1, "tiles_per_gauss": None,
            "isect_ids": None, "flatten_ids": None, "isect_offsets": None, "width": a["width"],
            "height": a["height"], "tile_size": 16, "n_cameras": 1,
        }  # fmt: skip
        return image, torch.ones(1, a["height"], a["width"], 1), meta

    rasterization.radii = torch.arange(40, dtype=torch.int32)[None]
    rasterization.calls = calls
    monkeypatch.setattr(gsplat, "rasterization", rasterization)
    monkeypatch.setattr(gsplat_backend, "_missing", lambda device: None)
    return rasterization


@pytest.fixture
def kernels(monkeypatch):
    """Replaces the kernels by gsplat's own torch projection and dense compositing, in any dtype on the CPU."""

    def fully_fused_projection(means, covars, quats, scales, viewmats, Ks, width, height, **options):
        assert covars is None and options.pop("packed") is False
        covariances, _ = _quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        return _fully_fused_projection(means, covariances, viewmats, Ks, width, height, **options)

    def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, *, packed, n_cameras):
        assert (tile_width, tile_height) == (3, 2) and tile_size == 16 and not packed
        assert means2d.shape == (n_cameras, radii.shape[1], 2) and depths.shape == radii.shape
        return None, depths, radii  # stand for the sorted lists

    def rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, tile_size, offsets, order, *, backgrounds, packed, absgrad
    ):
        pictures = [
            composite_dense(means2d[k], offsets[k], conics[k], opacities[k], colors[k], order[k], (height, width),
                            None if backgrounds is None else backgrounds[k])
            for k in range(len(means2d))
        ]  # fmt: skip
        if absgrad and means2d.requires_grad:
            means2d.register_hook(lambda _: setattr(means2d, "absgrad", torch.stack([p.absgrad for p in pictures])))
        return torch.stack([p.features for p in pictures]), torch.stack([p.alpha for p in pictures])

    monkeypatch.setattr(gsplat, "fully_fused_projection", fully_fused_projection)
    monkeypatch.setattr(gsplat, "isect_tiles", isect_tiles)
    monkeypatch.setattr(gsplat, "isect_offset_encode", lambda entries, count, *tiles: entries)
    monkeypatch.setattr(gsplat, "rasterize_to_pixels", rasterize_to_pixels)
    monkeypatch.setattr(gsplat_backend, "_missing", lambda device: None)
    monkeypatch.setattr(gsplat_backend, "_gsplat", lambda like: gsplat)  # any dtype


def scene(**kwargs):
    return scenes.splats(dtype=torch.float32, **kwargs), scenes.camera(dtype=torch.float32)


def test_the_call_matches_gsplats_signature(fake):
    splats, camera = scene(d=3)
    rendering = GsplatRasterizer(absgrad=True)(splats, camera, background=torch.ones(3), blur=0.1, antialiased=True)
    (a,) = fake.calls
    assert a["sh_degree"] is None and a["packed"] is False and a["absgrad"] is True
    assert a["rasterize_mode"] == "antialiased" and a["render_mode"] == "RGB+ED"
    assert a["eps2d"] == 0.1 and a["near_plane"] == NEAR_PLANE
    assert a["colors"] is splats.features and a["opacities"] is splats.opacities
    assert rendering.features.shape == (29, 37, 3) and rendering.features[0, 0].tolist() == [0, 1, 2]
    assert rendering.depth.shape == (29, 37, 1) and rendering.depth[0, 0, 0] == 3 and not rendering.depth.requires_grad


def test_without_depth_and_antialiasing(fake):
    splats, camera = scene(d=5)
    rendering = GsplatRasterizer(absgrad=False)(splats, camera, depth=False)
    (a,) = fake.calls
    assert a["render_mode"] == "RGB" and a["rasterize_mode"] == "classic" and a["absgrad"] is False
    assert a["backgrounds"] is None
    assert rendering.features.shape == (29, 37, 5) and not rendering.depth.any()


def test_every_info_key_is_one_that_gsplat_sets(fake):
    rendering = GsplatRasterizer()(*scene())
    for key in rendering.info:
        assert f'"{key}": ' in META_IN_SOURCE, key
    assert set(rendering.info) == {*gsplat_backend._INFO_KEYS, "radii"}


def test_radii_of_gsplat_1_5_become_one_per_gaussian(fake):
    fake.radii = torch.stack([torch.arange(40), torch.arange(40).flip(0)], -1).int()[None]
    radii = GsplatRasterizer()(*scene()).info["radii"]
    assert radii.shape == (1, 40) and radii.dtype == torch.int32
    assert radii[0, 0] == 39 and radii[0, 20] == 20


def test_an_empty_scene_is_its_background(fake):
    splats, camera = scene(n=0)
    rendering = GsplatRasterizer()(splats, camera, background=torch.tensor([1.0, 2.0, 3.0]))
    assert not fake.calls
    assert rendering.features[3, 5].tolist() == [1, 2, 3] and not rendering.alpha.any()
    assert rendering.info["means2d"].shape == (1, 0, 2) and rendering.info["radii"].shape == (1, 0)


def test_float64_is_refused(fake):
    with pytest.raises(TypeError, match=r"float32 tensors, got torch.float64.*'torch'"):
        GsplatRasterizer()(scenes.splats(), scenes.camera())


def test_cpu_tensors_are_refused_with_what_would_work():
    with pytest.raises(RuntimeError, match=r"tensors are on 'cpu'.*'torch', or 'numba' on the CPU"):
        GsplatRasterizer()(*scene())


def test_missing_kernels_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=None))
    reason = gsplat_backend._missing(torch.device("cuda"))
    assert "kernels are not compiled" in reason and "nvcc" in reason


def test_kernels_that_do_not_compile_are_named(monkeypatch):
    class Broken(ModuleType):
        def __getattr__(self, name):
            raise IndexError("list index out of range")

    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", Broken("gsplat.cuda._backend"))
    reason = gsplat_backend._missing(torch.device("cuda"))
    assert "cannot be compiled (IndexError: list index out of range)" in reason


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert "install gsplat==1.4.0" in gsplat_backend._missing(torch.device("cuda"))


@pytest.mark.parametrize("statistics", ["own", "full"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_prefixes_in_one_batch_equal_separate_pictures(kernels, assert_close, antialiased, statistics):
    prefixes_equal_separate_pictures(scenes.leaves_of(scenes.splats(n=30), torch.float64), scenes.camera(),
                                     TorchRasterizer(), assert_close, antialiased, statistics)  # fmt: skip


def prefixes_equal_separate_pictures(splats, camera, each, assert_close, antialiased, statistics):
    """The batch of `GsplatRasterizer` against a call of `each` per prefix: pictures, gradients, statistics."""
    level = torch.arange(len(splats), device=splats.means.device) % 3 + 1
    background = splats.means.new_tensor([0.1, 0.5, 0.9])
    batch = GsplatRasterizer(absgrad=True).prefixes(
        splats, level, 3, camera, background=background, antialiased=antialiased, statistics=statistics
    )
    torch.stack([(k + 1) * r.features.square().sum() + r.alpha.sum() for k, r in enumerate(batch)]).sum().backward()
    gradients = {name: getattr(splats, name).grad.clone() for name in scenes.LEAVES}
    info = batch[-1].info
    assert info["radii"].shape == (1, len(splats)) and info["means2d"].shape == (1, len(splats), 2)
    assert info["opacities"].shape == info["depths"].shape == (1, len(splats))
    for name in scenes.LEAVES:
        getattr(splats, name).grad = None
    expected, absolute = torch.zeros_like(info["means2d"]), torch.zeros_like(info["means2d"])
    for k in range(1, 4):
        rows = torch.where(level <= k)[0]
        alone = each(splats.select(rows), camera, background=background, antialiased=antialiased)
        alone.info["means2d"].retain_grad()
        (k * alone.features.square().sum() + alone.alpha.sum()).backward()
        assert_close(batch[k - 1].features, alone.features)
        assert_close(batch[k - 1].alpha, alone.alpha)
        counts = level[rows] == k if statistics == "own" else torch.full_like(rows, k == 3, dtype=torch.bool)
        expected[0, rows[counts]] = alone.info["means2d"].grad[0, counts]
        absolute[0, rows[counts]] = alone.info["means2d"].absgrad[0, counts]
    assert expected.abs().max() > 0 and absolute.sum() > 1.1 * expected.abs().sum()
    assert_close(info["means2d"].grad, expected)
    assert_close(info["means2d"].absgrad, absolute)
    for name in scenes.LEAVES:
        assert_close(gradients[name], getattr(splats, name).grad)


def test_prefixes_without_gradients_and_without_gaussians(kernels):
    splats, camera = scenes.splats(n=4), scenes.camera()
    level = torch.tensor([1, 1, 2, 2])
    renderings = GsplatRasterizer().prefixes(splats, level, 2, camera)
    assert not renderings[-1].info["means2d"].requires_grad
    none = GsplatRasterizer().prefixes(splats.select(level > 2), level[:0], 2, camera)
    assert len(none) == 2 and not none[0].alpha.any()
    with pytest.raises(ValueError, match=r"levels run from 1 to 2, outside of 1..1"):
        GsplatRasterizer().prefixes(splats, level, 1, camera)


def test_shapes_are_brought_into_the_kernels_range(fake):
    splats, camera = scene()
    splats = scenes.replace(splats, quats=torch.zeros_like(splats.quats), scales=torch.full_like(splats.scales, 1e38))
    GsplatRasterizer()(splats, camera)
    splats = scenes.replace(splats, quats=splats.quats + torch.tensor([0, 3e-15, 0, -4e-15]))
    GsplatRasterizer()(splats, camera)
    first, second = fake.calls
    assert (first["quats"] == torch.tensor([1.0, 0, 0, 0])).all()
    assert (second["quats"] == torch.tensor([0, 0.75, 0, -1])).all()
    assert first["scales"].max() <= 1e8 * 7 / 40 and first["scales"].min() > 0


def test_a_scene_far_from_the_origin_is_moved_to_the_camera(fake):
    splats, camera = scenes.splats(dtype=torch.float32), scenes.camera(angles=(0.3, -0.8, 0.5), dtype=torch.float32)
    splats = scenes.replace(splats, means=splats.means + torch.tensor([1e6, -2e6, 5e5]))
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ torch.tensor([1e6, -2e6, 5e5])
    GsplatRasterizer()(splats, type(camera)(viewmat, camera.K, camera.width, camera.height))
    (call,) = fake.calls
    assert not call["viewmats"][0, :3, 3].any()
    expected = splats.means.double() @ viewmat[:3, :3].double().T + viewmat[:3, 3].double()
    seen = call["means"].double() @ call["viewmats"][0, :3, :3].double().T
    assert expected.abs().max() < 30 and (seen - expected).abs().max() < 1e-5


@pytest.mark.cuda
@pytest.mark.parametrize("statistics", ["own", "full"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_prefixes_in_one_batch_equal_separate_pictures_on_cuda(antialiased, statistics):
    def close(actual, expected):
        assert (actual - expected).abs().max() < 1e-4 * expected.abs().max().clamp_min(1)

    base = scenes.splats(n=200, dtype=torch.float32)
    splats = type(base)(**{k: getattr(base, k).detach().cuda().requires_grad_() for k in scenes.LEAVES})
    view = scenes.camera(dtype=torch.float32)
    view = type(view)(view.viewmat.cuda(), view.K.cuda(), view.width, view.height)
    prefixes_equal_separate_pictures(splats, view, GsplatRasterizer(), close, antialiased, statistics)


@pytest.mark.cuda
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", ["plain", "off_centre", "rotated", "behind", "finished_pixels", "empty"])
def test_equals_the_reference_on_cuda(name, antialiased, assert_close):
    splats, camera = scenes.awkward()[name]
    background = torch.tensor([0.1, 0.2, 0.3])
    reference = scenes.leaves_of(splats, torch.float64)
    expected = TorchRasterizer()(reference, camera, background=background.double(), antialiased=antialiased)
    ours = type(splats)(**{
        k: getattr(splats, k).detach().float().cuda().requires_grad_() for k in scenes.LEAVES
    })  # fmt: skip
    view = type(camera)(camera.viewmat.float().cuda(), camera.K.float().cuda(), camera.width, camera.height)
    actual = GsplatRasterizer()(ours, view, background=background.cuda(), antialiased=antialiased)
    for key in ("features", "alpha"):
        # gsplat lists tiles by a box of 3 standard deviations, not by the ellipse where alpha >= 1/255
        assert (getattr(actual, key).cpu() - getattr(expected, key)).abs().max() < 0.02, key
    if len(splats) == 0:
        return
    for r in (actual, expected):
        r.info["means2d"].retain_grad()
        r.features.square().sum().backward()
    for key in ("grad", "absgrad"):
        a, b = (getattr(r.info["means2d"], key).cpu().double() for r in (actual, expected))
        assert (a - b).norm() < 0.02 * b.norm(), key
    for key in scenes.LEAVES:
        a, b = getattr(ours, key).grad.cpu().double(), getattr(reference, key).grad
        assert (a - b).norm() < 0.02 * b.norm(), key
