"""The chooser: what it returns, what it refuses and how it says so, and rasterizers that others register."""

import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest
import scenes
import torch

from freqgs_plugin.functional import projection
from freqgs_plugin.rendering import base
from freqgs_plugin.rendering.base import Rasterizer, available_rasterizers, get_rasterizer


class Custom:
    name = "custom"

    def __init__(self, absgrad):
        self.absgrad = absgrad

    def __call__(self, splats, camera, *, background=None, blur=0.3, antialiased=False, depth=True):
        raise NotImplementedError


@pytest.mark.parametrize("absgrad", [True, False])
@pytest.mark.parametrize("device, name, chosen", [
    ("cpu", "torch", "torch"), ("cpu", "numba", "numba"), ("cpu", "auto", "numba"), ("cuda", "auto", "gsplat"),
    ("cuda:1", "gsplat", "gsplat"), ("cuda", "torch", "torch"), ("mps", "auto", "torch"), ("meta", "torch", "torch"),
])  # fmt: skip
def test_chosen(device, name, chosen, absgrad):
    rasterizer = get_rasterizer(name, device, absgrad=absgrad)
    assert rasterizer.name == chosen and rasterizer.absgrad is absgrad
    assert isinstance(rasterizer, Rasterizer)


@pytest.mark.parametrize("device, name, message", [
    ("cpu", "gsplat", "'gsplat' needs a CUDA device, but the tensors are on 'cpu'.*auto, torch, numba"),
    ("mps", "gsplat", "'gsplat' needs a CUDA device, but the tensors are on 'mps'.*auto, torch"),
    ("cuda", "numba", "'numba' runs on the CPU only, but the tensors are on 'cuda'.*auto, torch, gsplat"),
    ("cpu", "vulkan", "unknown rasterizer 'vulkan'.*auto, torch, numba, gsplat"),
])  # fmt: skip
def test_refused(device, name, message):
    with pytest.raises(ValueError, match=message):
        get_rasterizer(name, device)


def test_registered_by_entry_point(monkeypatch):
    entry = EntryPoint("custom", f"{__name__}:Custom", base.ENTRY_POINT_GROUP)
    asked = []

    def entry_points(group):
        asked.append(group)
        return [entry]

    monkeypatch.setattr(base, "entry_points", entry_points)
    monkeypatch.setitem(sys.modules, __name__, sys.modules[Custom.__module__])
    assert available_rasterizers() == ["torch", "numba", "gsplat", "custom"]
    rasterizer = get_rasterizer("custom", "cpu", absgrad=False)
    assert isinstance(rasterizer, Custom) and rasterizer.absgrad is False
    assert set(asked) == {"freqgs_plugin.rasterizers"}
    with pytest.raises(ValueError, match="auto, torch, numba, gsplat, custom"):
        get_rasterizer("other", "cpu")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", scenes.LEAVES)
@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_numbers_that_are_not_finite_are_named(backend, name, bad):
    splats, camera = scenes.splats(dtype=torch.float32), scenes.camera(dtype=torch.float32)
    values = getattr(splats, name).clone()
    values.view(40, -1)[[7, 9], -1] = bad
    with pytest.raises(
        ValueError, match=rf"{name} of 2 of 40 Gaussians are not finite \(first: row 7, .*{bad}.*Remove"
    ):
        get_rasterizer(backend, "cpu")(scenes.replace(splats, **{name: values}), camera)


def test_finite_numbers_whose_sum_overflows_pass():
    splats = scenes.replace(scenes.splats(dtype=torch.float32), features=torch.full((40, 3), 3e38))
    base.check_inputs(splats, scenes.camera())


@pytest.mark.parametrize(
    "name, shape, message",
    [
        ("opacities", lambda x: x[:5], r"opacities have the shape \[5\]; with 40 means it must be \[40\]"),
        ("opacities", lambda x: x[:1], r"opacities have the shape \[1\]"),
        ("opacities", lambda x: x[:, None], r"opacities have the shape \[40, 1\]"),
        ("quats", lambda x: x[:, :3], r"quats have the shape \[40, 3\]; with 40 means it must be \[40, 4\]"),
        ("scales", lambda x: x[:, :1], r"scales have the shape \[40, 1\]"),
        ("means", lambda x: x[:, :2], r"means have the shape \[40, 2\]"),
        ("features", lambda x: x[:7], r"features have the shape \[7, 3\]; with 40 means it must be \[40, d\]"),
        ("features", lambda x: x[:, 0], r"features have the shape \[40\]"),
    ],
)
def test_shapes_that_do_not_fit_are_named(name, shape, message):
    splats, camera = scenes.splats(dtype=torch.float32), scenes.camera(dtype=torch.float32)
    fields = {leaf: getattr(splats, leaf) for leaf in scenes.LEAVES}
    # as a user's program would: without the checks that only tests run with
    wrong = SimpleNamespace(**{**fields, name: shape(fields[name])})
    with pytest.raises(ValueError, match=message):
        base._check_shapes.__wrapped__(wrong, camera)


@pytest.mark.parametrize("change, error, message", [
    ({"viewmat": torch.eye(3)}, ValueError, r"viewmat has the shape \[3, 3\], not \[4, 4\]"),
    ({"K": torch.eye(4)}, ValueError, r"K has the shape \[4, 4\], not \[3, 3\]"),
    ({"width": 4.5}, TypeError, "width is 4.5; it must be a whole number"),
])  # fmt: skip
def test_cameras_of_other_shapes_are_named(change, error, message):
    camera = scenes.camera()
    fields = {name: getattr(camera, name) for name in ("viewmat", "K", "width", "height")}
    with pytest.raises(error, match=message):
        base._check_shapes.__wrapped__(scenes.splats(), SimpleNamespace(**{**fields, **change}))


@pytest.mark.parametrize("change, message", [
    ({"width": 0}, "camera is 0x29 px; both sides"),
    ({"K": torch.diag(torch.tensor([0.0, 1.0, 1.0]))}, "focal lengths are 0 and 1 px; both must be > 0"),
    ({"K": torch.diag(torch.tensor([-2.0, 1.0, 1.0]))}, "focal lengths are -2 and 1 px"),
    ({"K": torch.full((3, 3), float("nan"))}, "the camera's K is not finite"),
    ({"viewmat": torch.full((4, 4), float("inf"))}, "the camera's viewmat is not finite"),
    ({"viewmat": torch.zeros(4, 4)}, "the camera's viewmat has no inverse"),
])  # fmt: skip
@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_impossible_cameras_are_refused(backend, change, message):
    splats, camera = scenes.splats(dtype=torch.float32), scenes.camera(dtype=torch.float32)
    with pytest.raises(ValueError, match=message):
        get_rasterizer(backend, "cpu")(splats, replace(camera, **change))


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_lists_that_would_not_fit_into_memory_are_refused(backend, monkeypatch):
    monkeypatch.setattr(base, "MAX_ENTRIES", 40)
    splats, camera = scenes.splats(dtype=torch.float32), scenes.camera(dtype=torch.float32)
    with pytest.raises(
        ValueError, match=r"\d+ Gaussians meet \d+ tiles of the 37x29 image, more than 40. Render a smaller"
    ):
        get_rasterizer(backend, "cpu")(splats, camera)


@pytest.mark.parametrize("name", ["quats", "scales", "opacities", "features"])
def test_tensors_of_several_dtypes_are_refused(name):
    splats = scenes.splats(dtype=torch.float32)
    splats = scenes.replace(splats, **{name: getattr(splats, name).bfloat16()})
    with pytest.raises(TypeError, match=f"{name} are torch.bfloat16 but means are torch.float32; give all one dtype"):
        get_rasterizer("torch", "cpu")(splats, scenes.camera(dtype=torch.float32))


def test_the_projections_constants_are_the_seams():
    assert projection.NEAR_PLANE == base.NEAR_PLANE
    assert projection.FOV_MARGIN == base.FOV_MARGIN
    assert projection.RADIUS_SIGMAS == base.RADIUS_SIGMAS


def test_backends_load_on_first_use_only():
    code = (
        "import sys, freqgs_plugin.rendering.base, freqgs_plugin.rendering.gsplat_backend\n"
        "assert not {'gsplat', 'numba', 'nerfstudio'} & set(sys.modules), 'loaded too early'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
