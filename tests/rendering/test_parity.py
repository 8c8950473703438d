"""Every CPU backend against the torch reference in float64: values, all gradients, densification statistics."""

import multiprocessing
import threading
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from gsplat.strategy import DefaultStrategy

from freqgs_plugin.rendering.base import ALPHA_MIN, PrefixRasterizer, get_rasterizer
from freqgs_plugin.rendering.torch_backend import TorchRasterizer

BACKENDS = ("torch", "numba")
AWKWARD = scenes.awkward()
GOLDEN = sorted((Path(__file__).parent.parent / "golden").glob("*.npz"))


@pytest.fixture(params=BACKENDS)
def rasterizer(request):
    """A CPU backend, which then renders float32."""
    return get_rasterizer(request.param, "cpu")


@pytest.fixture
def prefix_rasterizer():
    rasterizer = get_rasterizer("numba", "cpu")
    assert isinstance(rasterizer, PrefixRasterizer)
    return rasterizer


def noise(*shape, seed=7):
    return torch.randn(*shape, generator=scenes.generator(seed), dtype=torch.float64)


def with_features(splats, d):
    return scenes.replace(splats, features=noise(len(splats), d))


def forward_backward(rasterizer, splats, camera, dtype, background, antialiased):
    """Rendering, its splats and the background as leaves, after backward of a fixed random functional of it."""
    leaves, view = scenes.leaves_of(splats, dtype), scenes.cast(camera, dtype)
    behind = background.to(dtype).requires_grad_()
    rendering = rasterizer(leaves, view, background=behind, antialiased=antialiased)
    if len(splats):
        rendering.info["means2d"].retain_grad()
    d = splats.features.shape[1]
    weights = [noise(camera.height, camera.width, c, seed=s).to(dtype) for c, s in ((d, 11), (1, 12))]
    ((rendering.features * weights[0]).sum() + (rendering.alpha * weights[1]).sum()).backward()
    return rendering, leaves, behind


def relative(actual, expected):
    assert torch.isfinite(actual).all()
    return float((actual.double() - expected).norm() / expected.norm().clamp_min(1e-12))


def check_gradients(name, actual, expected, splats_a, splats_b):
    # relative to the whole gradient; needles and tiny quaternions are ill-conditioned in float32
    limit = {"needles": 2e-3, "zero_quaternion": 1e-4, "finished_pixels": 1e-3}.get(name, 2e-5)
    # absolute gradients do not add up over the groups of three that numba composites
    grouped = actual.features.shape[-1] > 3 and not hasattr(actual.info["means2d"], "absgrad")
    for key in ("grad",) if grouped else ("grad", "absgrad"):
        a, b = (getattr(r.info["means2d"], key) for r in (actual, expected))
        assert a.shape == b.shape == (1, len(splats_a), 2)
        assert relative(a, b) < limit, f"means2d.{key}"
    for key in scenes.LEAVES:
        a, b = getattr(splats_a, key).grad, getattr(splats_b, key).grad
        if key == "quats" and name == "zero_quaternion":
            # each row by its own size: the tiny one's gradient is 1e12 times larger
            assert torch.equal(a[0], torch.zeros(4)), "gradient of a zero quaternion"
            for row in range(1, len(a)):
                assert relative(a[row], b[row]) < 1e-3, f"quats[{row}]"
        else:
            assert relative(a, b) < limit, key


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", AWKWARD)
def test_equals_the_reference(rasterizer, name, antialiased, assert_close):
    splats, camera = AWKWARD[name]
    background = noise(3, seed=8)
    arguments = (splats, camera)
    actual, ours, behind = forward_backward(rasterizer, *arguments, torch.float32, background.clone(), antialiased)
    expected, theirs, exact = forward_backward(
        TorchRasterizer(), *arguments, torch.float64, background.clone(), antialiased
    )
    loosen = {"needles": 100, "finished_pixels": 20}.get(name, 2)
    for key in ("features", "alpha", "depth"):
        assert_close(getattr(actual, key), getattr(expected, key), loosen=loosen, message=key)
    assert torch.equal(actual.info["radii"], expected.info["radii"])
    seen = (expected.info["radii"][0] > 0) & (expected.info["opacities"][0] >= ALPHA_MIN)
    for key in ("means2d", "depths", "opacities"):
        assert_close(actual.info[key][0][seen], expected.info[key][0][seen], loosen=loosen, message=key)
    assert_close(behind.grad, exact.grad, loosen=20, message="background")
    if len(splats):
        check_gradients(name, actual, expected, ours, theirs)


@pytest.mark.parametrize("d", [1, 2, 4, 5, 7])
def test_any_number_of_features(rasterizer, d, assert_close):
    splats, camera = with_features(AWKWARD["rotated"][0], d), AWKWARD["rotated"][1]
    background = noise(d, seed=8)
    actual, ours, _ = forward_backward(rasterizer, splats, camera, torch.float32, background.clone(), True)
    expected, theirs, _ = forward_backward(TorchRasterizer(), splats, camera, torch.float64, background.clone(), True)
    assert actual.features.shape[-1] == d
    assert_close(actual.features, expected.features, loosen=2)
    check_gradients("rotated", actual, expected, ours, theirs)


@pytest.mark.parametrize("blur", [0.05, 1.0])
def test_blur(rasterizer, blur, assert_close):
    splats, camera = AWKWARD["plain"]
    a, b = (
        r(scenes.leaves_of(splats, dtype), scenes.cast(camera, dtype), blur=blur)
        for r, dtype in ((rasterizer, torch.float32), (TorchRasterizer(), torch.float64))
    )
    assert_close(a.features, b.features, loosen=5)


def test_gradient_of_the_view_matrix(rasterizer):
    splats, camera = AWKWARD["rotated"]
    gradients = []
    for r, dtype in ((rasterizer, torch.float32), (TorchRasterizer(), torch.float64)):
        view = scenes.cast(camera, dtype)
        view.viewmat.requires_grad_()
        r(scenes.leaves_of(splats, dtype), view).features.square().sum().backward()
        gradients.append(view.viewmat.grad[:3])
    assert relative(*gradients) < 1e-4


def test_depth_is_optional_and_has_no_gradient(rasterizer):
    splats, camera = AWKWARD["plain"]
    leaves, view = scenes.leaves_of(splats, torch.float32), scenes.cast(camera, torch.float32)
    assert not rasterizer(leaves, view).depth.requires_grad
    assert not rasterizer(leaves, view, depth=False).depth.any()


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", ["plain", "finished_pixels", "equal_depths", "behind"])
def test_a_prefix_is_a_render_of_its_rows(prefix_rasterizer, name, antialiased, assert_close):
    splats, camera = AWKWARD[name]
    splats, camera = scenes.leaves_of(splats, torch.float32), scenes.cast(camera, torch.float32)
    level = torch.randint(1, 4, (len(splats),), generator=scenes.generator(3))
    background = torch.tensor([0.3, -0.2, 0.9])
    renderings = prefix_rasterizer.prefixes(
        splats, level, 4, camera, background=background, antialiased=antialiased, statistics="full"
    )
    weights = [noise(camera.height, camera.width, 3, seed=k).float() for k in range(4)]
    assert len(renderings) == 4
    sum((r.features * w).sum() for r, w in zip(renderings, weights, strict=True)).backward()
    others = scenes.leaves_of(splats, torch.float32)
    total = 0.0
    for k, rendering in enumerate(renderings, start=1):
        rows = level <= k
        part = type(splats)(**{key: getattr(others, key)[rows] for key in scenes.LEAVES})
        alone = prefix_rasterizer(part, camera, background=background, antialiased=antialiased)
        assert_close(rendering.features.detach(), alone.features.detach(), message=f"prefix {k}")
        assert_close(rendering.alpha.detach(), alone.alpha.detach(), message=f"prefix {k}")
        total = total + (alone.features * weights[k - 1]).sum()
    total.backward()
    for key in scenes.LEAVES:
        assert relative(getattr(splats, key).grad, getattr(others, key).grad.double()) < 1e-4, key


@pytest.mark.parametrize("statistics", ["own", "full"])
def test_statistics_of_prefixes(prefix_rasterizer, statistics):
    """`full`: of the render of all levels; `own`: for a Gaussian of level k, of the render of prefix k."""
    splats, camera = AWKWARD["plain"]
    level = torch.randint(1, 4, (len(splats),), generator=scenes.generator(3))
    leaves, view = scenes.leaves_of(splats, torch.float32), scenes.cast(camera, torch.float32)
    renderings = prefix_rasterizer.prefixes(leaves, level, 3, view, statistics=statistics)
    info = renderings[-1].info
    info["means2d"].retain_grad()
    weights = [noise(camera.height, camera.width, 3, seed=k) for k in range(3)]
    sum((r.features * w.float()).sum() for r, w in zip(renderings, weights, strict=True)).backward()
    expected = {"grad": torch.zeros(len(splats), 2).double(), "absgrad": torch.zeros(len(splats), 2).double()}
    for k in (1, 2, 3) if statistics == "own" else (3,):
        rows = torch.nonzero(level <= k).squeeze(1)
        part = scenes.leaves_of(
            type(splats)(**{key: getattr(splats, key)[rows] for key in scenes.LEAVES}), torch.float64
        )
        alone = TorchRasterizer()(part, camera)
        alone.info["means2d"].retain_grad()
        (alone.features * weights[k - 1]).sum().backward()
        mine = level[rows] == k if statistics == "own" else level[rows] <= k
        for key, value in expected.items():
            value[rows[mine]] = getattr(alone.info["means2d"], key)[0][mine]
    for key, value in expected.items():
        assert relative(getattr(info["means2d"], key)[0], value) < 1e-4, key


@pytest.mark.parametrize("absgrad", [False, True])
def test_gsplats_strategy_runs_on_the_cpu(rasterizer, absgrad):
    generator = scenes.generator(5)
    start = scenes.leaves_of(scenes.splats(60, seed=5), torch.float32)
    view = scenes.cast(scenes.camera(), torch.float32)
    target = torch.rand(view.height, view.width, 3, generator=generator)
    params = torch.nn.ParameterDict({
        "means": start.means.detach(), "quats": start.quats.detach(), "scales": start.scales.detach().log(),
        "opacities": start.opacities.detach().logit(), "features": start.features.detach(),
    })  # fmt: skip
    optimizers = {k: torch.optim.Adam([p], lr=1e-3) for k, p in params.items()}
    strategy = DefaultStrategy(
        refine_start_iter=1, refine_every=4, reset_every=9, grow_grad2d=1e-6, absgrad=absgrad, prune_opa=0.06
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    counts = []
    torch.manual_seed(0)
    for step in range(10):
        splats = type(start)(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["features"]
        )
        rendering = rasterizer(splats, view)
        strategy.step_pre_backward(params, optimizers, state, step, rendering.info)
        (rendering.features - target).square().mean().backward()
        strategy.step_post_backward(params, optimizers, state, step, rendering.info, packed=False)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        counts.append(len(params["means"]))
        if step == 2:
            assert (state["grad2d"] > 0).sum() > 20 and state["count"].max() == 3
    assert counts[4] > 60 and counts[8] > counts[4]
    assert all(len(p) == counts[-1] and torch.isfinite(p).all() for p in params.values())


def _bits(rasterizer, seed):
    return _bits_of(rasterizer, scenes.splats(300, seed=seed, size=(0.05, 0.4)))


def _bits_of(rasterizer, splats):
    splats = scenes.leaves_of(splats, torch.float32)
    rendering = rasterizer(splats, scenes.cast(scenes.camera(64, 48), torch.float32))
    rendering.features.square().sum().backward()
    return b"".join(
        t.detach().numpy().tobytes() for t in (rendering.features, *(getattr(splats, k).grad for k in scenes.LEAVES))
    )


def test_four_threads_at_once_give_the_same_bits():
    rasterizer = get_rasterizer("numba", "cpu")
    expected = [_bits(rasterizer, seed) for seed in range(4)]
    results = [[] for _ in range(4)]
    barrier = threading.Barrier(4)

    def work(seed):
        barrier.wait()
        results[seed] += [_bits(rasterizer, seed) for _ in range(5)]

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert results == [[bits] * 5 for bits in expected]


def _child(rasterizer, splats, queue):
    queue.put(_bits_of(rasterizer, splats))


def test_a_forked_child_gives_the_same_bits():
    rasterizer = get_rasterizer("numba", "cpu")
    # made here: with OpenMP's threads in the parent, torch.exp never returns in a forked child
    splats = scenes.splats(300, seed=1, size=(0.05, 0.4))
    expected = _bits_of(rasterizer, splats)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_child, args=(rasterizer, splats, queue))
    child.start()
    try:
        assert queue.get(timeout=60) == expected
    finally:
        child.kill()
        child.join()


def test_golden_images_are_gsplats():
    assert len(GOLDEN) >= 4
    for path in GOLDEN:
        assert str(np.load(path)["rasterizer"]).startswith("gsplat, float32 on cuda"), path


@pytest.mark.parametrize("path", GOLDEN, ids=lambda p: p.stem)
def test_equals_the_recorded_images(rasterizer, path, assert_close):
    recorded = np.load(path)
    splats = type(AWKWARD["plain"][0])(**{k: torch.from_numpy(recorded[k]) for k in scenes.LEAVES})
    view = scenes.camera(dtype=torch.float32)
    view = type(view)(
        torch.from_numpy(recorded["viewmat"]), torch.from_numpy(recorded["K"]),
        int(recorded["width"]), int(recorded["height"]),
    )  # fmt: skip
    rendering = rasterizer(
        splats, view, background=torch.from_numpy(recorded["background"]), antialiased=bool(recorded["antialiased"])
    )
    assert_close(rendering.features, torch.from_numpy(recorded["image"]))
    assert_close(rendering.alpha, torch.from_numpy(recorded["alpha"]))
    assert_close(rendering.depth, torch.from_numpy(recorded["depth"]))


def test_gradient_of_the_background_is_the_light_left_over():
    splats, camera = scenes.splats(dtype=torch.float32), scenes.camera(dtype=torch.float32)
    background = torch.tensor([0.2, 0.4, 0.9], requires_grad=True)
    rendering = get_rasterizer("numba", "cpu")(splats, camera, background=background)
    rendering.features[..., 1].sum().backward()
    assert background.grad is not None
    assert 0.01 < (1 - rendering.alpha).mean().item() < 0.99
    left = (1 - rendering.alpha).sum().item()
    torch.testing.assert_close(background.grad, torch.tensor([0.0, left, 0.0]), rtol=1e-4, atol=1e-4)


def test_a_background_of_another_width_is_refused():
    splats, camera = scenes.splats(dtype=torch.float32), scenes.camera(dtype=torch.float32)
    with pytest.raises(RuntimeError, match="expand"):
        get_rasterizer("numba", "cpu")(splats, camera, background=torch.ones(4))
