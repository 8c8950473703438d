"""Laws that every picture obeys, for both CPU backends, and inputs at the ends of float32's range."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import scenes
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render_prefixes
from freqgs_plugin.rendering.torch_backend import TorchRasterizer
from freqgs_plugin.types import Camera, Gaussians, Rendering, Splats

BACKENDS = (("torch", torch.float32), ("torch", torch.float64), ("numba", torch.float32))
few = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


class Drawer:
    """A backend in a dtype."""

    def __init__(self, name, dtype):
        self.rasterizer, self.dtype = get_rasterizer(name, "cpu"), dtype
        self.loosen = 10 if dtype == torch.float64 else 2

    def __call__(self, splats, camera, background=None, antialiased=True):
        """Rendering and leaves, after backward of a fixed random functional of features and alpha."""
        leaves = scenes.leaves_of(splats, self.dtype)
        rendering = self.rasterizer(
            leaves, scenes.cast(camera, self.dtype), background=background, antialiased=antialiased
        )
        if len(splats):
            weights = noise(*rendering.features.shape).to(self.dtype)
            (rendering.features * weights).sum().add(rendering.alpha.sum()).backward()
        return rendering, leaves


@pytest.fixture(params=BACKENDS, ids=lambda p: f"{p[0]}-{p[1]}".replace("torch.", ""))
def draw(request):
    return Drawer(*request.param)


@pytest.fixture(params=("torch", "numba"))
def rasterizer(request):
    return get_rasterizer(request.param, "cpu")


def noise(*shape, seed=7):
    return torch.randn(*shape, generator=scenes.generator(seed), dtype=torch.float64)


@st.composite
def views(draw, smallest=0):
    """Random Gaussians at different depths, and a camera that sees most of them."""
    n, seed = draw(st.integers(smallest, 60)), draw(st.integers(0, 10**6))
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    angles = draw(st.tuples(*[st.floats(-0.5, 0.5)] * 3))
    return scenes.splats(n, seed=seed), scenes.camera(width, height, angles=angles)


def rows(splats, index):
    return Splats(**{key: getattr(splats, key)[index] for key in scenes.LEAVES})


def same(check, a, b, loosen):
    for key in ("features", "alpha", "depth"):
        check(getattr(a, key).detach(), getattr(b, key).detach(), loosen=loosen, message=key)


@given(view=views(), seed=st.integers(0, 10**6))
@few
def test_order_of_the_rows_is_irrelevant(draw, assert_close, view, seed):
    splats, camera = view
    order = torch.randperm(len(splats), generator=scenes.generator(seed))
    (a, ours), (b, theirs) = draw(splats, camera), draw(rows(splats, order), camera)
    same(assert_close, a, b, draw.loosen)
    assert torch.equal(a.info["radii"][0][order], b.info["radii"][0])
    for key in scenes.LEAVES if len(splats) else ():
        assert_close(getattr(ours, key).grad[order], getattr(theirs, key).grad, loosen=1e3, message=key)


@given(view=views())
@few
def test_q_and_minus_q_are_one_rotation(draw, assert_close, view):
    splats, camera = view
    (a, ours), (b, theirs) = draw(splats, camera), draw(scenes.replace(splats, quats=-splats.quats), camera)
    same(assert_close, a, b, draw.loosen)
    if len(splats):
        assert_close(ours.quats.grad, -theirs.quats.grad, loosen=1e3)


@given(view=views(), where=st.floats(0, 1))
@few
def test_a_transparent_gaussian_changes_nothing_and_learns_nothing(draw, view, where):
    splats, camera = view
    at = round(where * len(splats))
    hidden = scenes.replace(scenes.splats(1, seed=5, size=(1.0, 2.0)), opacities=torch.zeros(1).double())
    both = Splats(**{
        key: torch.cat([getattr(splats, key)[:at], getattr(hidden, key), getattr(splats, key)[at:]])
        for key in scenes.LEAVES
    })  # fmt: skip
    (a, ours), (b, theirs) = draw(splats, camera), draw(both, camera)
    for key in ("features", "alpha", "depth"):
        assert torch.equal(getattr(a, key), getattr(b, key)), key
    others = torch.arange(len(both)) != at
    for key in scenes.LEAVES:
        gradient = getattr(theirs, key).grad
        assert not gradient[at].any(), key
        assert not len(splats) or torch.equal(gradient[others], getattr(ours, key).grad), key


@given(view=views(smallest=1), a=st.floats(-3, 3), b=st.floats(-3, 3))
@few
def test_a_picture_is_linear_in_features(draw, assert_close, view, a, b):
    splats, camera = view
    other = noise(len(splats), 3)
    first, second, both = (
        draw(scenes.replace(splats, features=f), camera)[0]
        for f in (splats.features, other, a * splats.features + b * other)
    )
    mixed = a * first.features.detach() + b * second.features.detach()
    assert_close(both.features.detach(), mixed, loosen=10 * draw.loosen)
    assert torch.equal(both.alpha, first.alpha)


@given(view=views(), background=st.tuples(*[st.floats(-2, 2)] * 3))
@few
def test_the_background_shows_where_alpha_is_missing(draw, assert_close, view, background):
    splats, camera = view
    behind = torch.tensor(background, dtype=draw.dtype)
    a, b = draw(splats, camera)[0], draw(splats, camera, background=behind)[0]
    assert_close((a.features + (1 - a.alpha) * behind).detach(), b.features.detach(), loosen=10 * draw.loosen)


@given(seed=st.integers(0, 10**6), x=st.integers(20, 76), y=st.integers(20, 60))
@few
def test_crops_of_a_camera_are_crops_of_its_picture(draw, assert_close, seed, x, y):
    """For Gaussians that end within 3 standard deviations and within the margin in which the Jacobian is not held."""
    splats = scenes.splats(80, seed=seed, size=(0.005, 0.02))
    splats = scenes.replace(splats, opacities=splats.opacities.clamp_max(0.3))
    camera = scenes.camera(96, 80, focal=60.0)
    whole = draw(splats, camera)[0]
    assert whole.alpha.max() > 0.02, "something shows (of 4,000 seeds the faintest: 0.042)"
    for left, right in ((0, x), (x, 96)):
        for top, bottom in ((0, y), (y, 80)):
            K = camera.K.clone()
            K[0, 2] -= left
            K[1, 2] -= top
            part = draw(splats, Camera(camera.viewmat, K, right - left, bottom - top))[0]
            crop = [getattr(whole, key)[top:bottom, left:right] for key in ("features", "alpha", "depth")]
            same(assert_close, part, Rendering(*crop), 10 * draw.loosen)


@given(view=views(), factor=st.floats(0.5, 100))
@few
def test_the_unit_of_length_is_irrelevant(draw, assert_close, view, factor):
    splats, camera = view
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] *= factor
    larger = scenes.replace(splats, means=splats.means * factor, scales=splats.scales * factor)
    a, b = draw(splats, camera)[0], draw(larger, Camera(viewmat, camera.K, camera.width, camera.height))[0]
    for key, unit in (("features", 1.0), ("alpha", 1.0), ("depth", factor)):
        assert_close(getattr(a, key).detach() * unit, getattr(b, key).detach(), loosen=50 * unit, message=key)


@given(view=views(), levels=st.integers(1, 4), statistics=st.sampled_from(["own", "full"]), seed=st.integers(0, 99))
@settings(few, max_examples=8)
def test_prefixes_are_separate_renders(rasterizer, assert_close, view, levels, statistics, seed):
    splats, camera = view
    splats, camera = scenes.leaves_of(splats, torch.float32), scenes.cast(camera, torch.float32)
    level = torch.randint(1, levels + 1, (len(splats),), generator=scenes.generator(seed))
    sh = noise(len(splats), 4, 3).float()
    gaussians = Gaussians(splats.means, splats.quats, splats.scales, splats.opacities, sh[:, 0], sh[:, 1:], level)
    prefixes = render_prefixes(gaussians, camera, levels, rasterizer=rasterizer, statistics=statistics)
    assert len(prefixes) == levels
    for k, prefix in enumerate(prefixes, start=1):
        alone = render_prefixes(gaussians.select(level <= k), camera, 1, rasterizer=rasterizer)[0]
        assert_close(prefix.features.detach(), alone.features.detach(), message=f"prefix {k}")
        assert_close(prefix.alpha.detach(), alone.alpha.detach(), message=f"prefix {k}")


@pytest.mark.parametrize("length", [1e-38, 1e-30, 1e-21])
def test_a_quaternion_without_a_direction_is_the_identity(draw, length):
    """Below 1e-20 the gradient, which grows with the inverse length, would leave float32's range."""
    splats, camera = scenes.splats(), scenes.camera()
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(len(splats), 4)
    expected, _ = draw(scenes.replace(splats, quats=upright), camera)
    actual, leaves = draw(scenes.replace(splats, quats=splats.quats * length), camera)
    assert torch.equal(actual.features, expected.features)
    assert torch.equal(leaves.quats.grad, torch.zeros_like(leaves.quats))


@pytest.mark.parametrize("size", [1e6, 1e12, 1e20, 1e38])
def test_gaussians_wider_than_any_image_cover_it(draw, size, assert_close):
    splats = scenes.replace(scenes.splats(), scales=torch.full((40, 3), size).double())
    actual, leaves = draw(splats, scenes.camera())
    expected = TorchRasterizer()(splats, scenes.camera())
    assert expected.alpha.min() > 0.99
    assert_close(actual.features.detach(), expected.features.detach())
    assert all(torch.isfinite(getattr(leaves, key).grad).all() for key in scenes.LEAVES)


BITS = """
import hashlib, sys
import numba, torch
import scenes
from freqgs_plugin.functional.image_loss import image_distance
from freqgs_plugin.functional.pyramid import low_pass, reduce
from freqgs_plugin.functional.spectrum import magnitude_distance
from freqgs_plugin.rendering.base import get_rasterizer
rasterizer = get_rasterizer(sys.argv[1], "cpu")
splats, camera = scenes.splats(1500, seed=3, size=(0.02, 0.2)), scenes.camera(200, 150, focal=180.0)
target = torch.rand(1, 3, 150, 200, generator=scenes.generator(2))
for threads in (1, 2, 3, 4, 1):
    torch.set_num_threads(threads)
    numba.set_num_threads(threads)
    leaves = scenes.leaves_of(splats, torch.float32)
    rendering = rasterizer(leaves, scenes.cast(camera, torch.float32), antialiased=True)
    image = rendering.features.permute(2, 0, 1)[None]
    losses = image_distance(image, target), image_distance(reduce(image), reduce(target))
    losses = (*losses, magnitude_distance(image, low_pass(target, 2)))
    sum(losses).backward()
    tensors = (rendering.features, rendering.alpha, rendering.depth, *losses)
    tensors = (*tensors, *(getattr(leaves, k).grad for k in scenes.LEAVES))
    print(*(hashlib.md5(t.detach().numpy().tobytes()).hexdigest() for t in tensors))
"""


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_any_number_of_threads_gives_the_same_bits(backend):
    """Pictures, losses and all gradients, in a process that may have four threads."""
    folder = Path(scenes.__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", BITS, backend],
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "PYTHONPATH": str(folder), "NUMBA_NUM_THREADS": "4"},
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 5 and len(lines[0].split()) == 11
    assert len(set(lines)) == 1
