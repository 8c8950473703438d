import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from freqgs_plugin.functional.harmonics import num_coefficients
from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.init_source import find_checkpoint, frame_of, read_frame, read_init_source
from freqgs_plugin.io.parameters import RawGaussians
from freqgs_plugin.io.ply import SplatFileError, write_ply

GROUPS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")


def gaussians(n=15, degree=2, **more):
    g = torch.Generator().manual_seed(0)
    return RawGaussians(
        means=torch.randn(n, 3, generator=g),
        scales=torch.randn(n, 3, generator=g) - 3,
        quats=torch.randn(n, 4, generator=g),
        features_dc=torch.randn(n, 3, generator=g),
        features_rest=torch.randn(n, num_coefficients(degree) - 1, 3, generator=g),
        opacities=torch.randn(n, 1, generator=g),
        **more,
    )


def state(raw, prefix="_model.gauss_params."):
    tensors = {prefix + name: getattr(raw, name) for name in GROUPS}
    tensors["_model.camera_optimizer.pose_adjustment"] = torch.zeros(4, 6)
    if raw.level is not None:
        tensors["_model.level"] = raw.level
    if raw.decay is not None:
        tensors[prefix + "decay"] = raw.decay[:, None]
    return tensors


def save(folder, pipeline, step=29_999, **more):
    (folder / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
    path = folder / "nerfstudio_models" / f"step-{step:09d}.ckpt"
    torch.save({"step": step, "pipeline": pipeline, "optimizers": {}, **more}, path)
    (folder / "config.yml").write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig\nmethod_name: x\n")
    return path


def write_frame(folder, frame):
    matrix = torch.cat([frame.rotation, frame.translation[:, None]], 1)
    text = json.dumps({"transform": matrix.tolist(), "scale": frame.scale})
    (folder / "dataparser_transforms.json").write_text(text)


def frame(seed=1, scale=0.4):
    rotation = torch.from_numpy(Rotation.random(random_state=seed).as_matrix().copy())
    return Similarity(rotation, torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64), scale)


def same(a, b):
    for name in (*GROUPS, "level", "decay"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None) and (x is None or torch.equal(x, y)), name


def refused(match, path, **facts):
    with pytest.raises(SplatFileError, match=match):
        read_init_source(path, **facts)


# -- what is read -----------------------------------------------------------------------------------------------------


def test_a_run_by_its_folder_its_config_its_checkpoints_and_one_of_them(tmp_path):
    raw = gaussians()
    save(tmp_path, state(gaussians(3)), step=500)
    path = save(tmp_path, state(raw), step=12_000)
    for name in (tmp_path, tmp_path / "config.yml", tmp_path / "nerfstudio_models", path):
        source = read_init_source(name, antialiased=False)
        same(source.gaussians, raw)
        assert source.path == path and source.frame is None and source.antialiased is False
        assert source.summary == f"{path}: 15 Gaussians of step 12000; SH degree 2."


def test_the_latest_checkpoint_by_number_not_by_name(tmp_path):
    (tmp_path / "nerfstudio_models").mkdir()
    for name in ("step-9.ckpt", "step-10.ckpt", "step-x.ckpt", "step-000000008.ckpt"):
        (tmp_path / "nerfstudio_models" / name).touch()
    assert find_checkpoint(tmp_path).name == "step-10.ckpt"


def test_splatfactos_optimizers_and_schedulers_with_numpy_scalars(tmp_path):
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.engine.optimizers import Optimizers

    raw = gaussians()
    parameters = {name: torch.nn.Parameter(getattr(raw, name).clone()) for name in GROUPS}
    table = method_configs["splatfacto"].optimizers
    optimizers = Optimizers({name: table[name] for name in GROUPS}, {n: [p] for n, p in parameters.items()})
    for parameter in parameters.values():
        parameter.grad = torch.ones_like(parameter)
    optimizers.optimizer_step_all()
    optimizers.scheduler_step_all(0)
    rate = optimizers.schedulers["means"].state_dict()["_last_lr"][0]
    assert isinstance(rate, np.generic), "nerfstudio's rates are numpy scalars"
    path = save(
        tmp_path,
        state(raw),
        optimizers={k: o.state_dict() for k, o in optimizers.optimizers.items()},
        schedulers={k: s.state_dict() for k, s in optimizers.schedulers.items()},
    )
    with pytest.raises(Exception, match="Weights only load failed"):
        torch.load(path, weights_only=True)
    same(read_init_source(tmp_path).gaussians, raw)
    # allowed for that one load only
    with pytest.raises(Exception, match="Weights only load failed"):
        torch.load(path, weights_only=True)


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.int32, np.bool_])
def test_numpy_scalars_of_either_numpy(tmp_path, kind):
    raw = gaussians()
    path = save(tmp_path, state(raw), schedulers={"means": kind(1)})
    same(read_init_source(tmp_path).gaussians, raw)
    # numpy 2 names the same function by another module
    content = path.read_bytes()
    old, new = b"cnumpy.core.multiarray\n", b"cnumpy._core.multiarray\n"
    assert old in content
    rewrite_archive(path, old, new)
    same(read_init_source(tmp_path).gaussians, raw)


def rewrite_archive(path, old, new):
    """Replace bytes in the pickle of a checkpoint."""
    import zipfile

    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    # stored by torch itself, so that tensors stay aligned
    writer = torch._C.PyTorchFileWriter(str(path))
    for name, content in members.items():
        inner = name.split("/", 1)[1]
        content = content.replace(old, new) if inner == "data.pkl" else content
        if inner not in ("version", "byteorder") and not inner.startswith("."):
            writer.write_record(inner, content, len(content))
    writer.write_end_of_file()


@pytest.mark.parametrize(
    "prefix", ["_model.gauss_params.", "_model.module.gauss_params.", "module._model.gauss_params."]
)
def test_names_of_distributed_training(tmp_path, prefix):
    raw = gaussians()
    save(tmp_path, state(raw, prefix))
    same(read_init_source(tmp_path).gaussians, raw)


def test_names_of_old_splatfacto(tmp_path):
    raw = gaussians()
    save(tmp_path, state(raw, "_model."))
    same(read_init_source(tmp_path).gaussians, raw)


def test_trainable_and_half_precision_tensors_become_plain_float32(tmp_path):
    raw = gaussians()
    tensors = {k: torch.nn.Parameter(v.half()) for k, v in state(raw).items()}
    save(tmp_path, tensors)
    read = read_init_source(tmp_path).gaussians
    assert read.means.dtype == torch.float32 and not read.means.requires_grad
    assert torch.equal(read.means, raw.means.half().float()) and not torch.equal(read.means, raw.means)


def test_decay_and_unsigned_levels_come_along(tmp_path):
    raw = gaussians(level=torch.arange(15, dtype=torch.int32) % 3 + 1, decay=torch.linspace(-1, 9, 15))
    save(tmp_path, state(raw))
    source = read_init_source(tmp_path, signed_residuals=False)
    same(source.gaussians, raw)
    assert "; with levels; with decay." in source.summary


def test_a_ply(tmp_path):
    raw = gaussians(decay=torch.ones(15))
    write_ply(tmp_path / "a.PLY", raw, antialiased=True)
    source = read_init_source(tmp_path / "a.PLY")
    same(source.gaussians, raw)
    assert source.antialiased is True and source.frame is None and "15 Gaussians" in source.summary


# -- frames -----------------------------------------------------------------------------------------------------------


def test_in_the_same_frame_nothing_changes_by_a_bit(tmp_path):
    raw = gaussians()
    save(tmp_path, state(raw))
    write_frame(tmp_path, frame())
    same(read_init_source(tmp_path).in_frame(read_frame(tmp_path / "dataparser_transforms.json"), "dataset"), raw)


def test_a_run_is_moved_from_its_frame_to_the_scenes(tmp_path):
    raw = gaussians(degree=3)
    save(tmp_path, state(raw))
    write_frame(tmp_path, frame(1))
    scene = frame(2, scale=3.0)
    moved = read_init_source(tmp_path).in_frame(scene, "scene")
    in_dataset = frame(1).inverse().points(raw.means.double())
    torch.testing.assert_close(moved.means.double(), scene.points(in_dataset), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(moved.scales, raw.scales + np.log(3.0 / 0.4).astype(np.float32), atol=1e-6, rtol=1e-6)
    same(replace(moved, **dict.fromkeys(("level", "decay"))), raw.moved(scene.after(frame(1).inverse())))
    assert not torch.allclose(moved.features_rest, raw.features_rest)


def test_a_plys_frame_is_declared(tmp_path):
    raw = gaussians()
    write_ply(tmp_path / "a.ply", raw)
    source = read_init_source(tmp_path / "a.ply")
    same(source.in_frame(frame(), "scene"), raw)
    same(source.in_frame(frame(), "dataset"), raw.moved(frame()))
    with pytest.raises(ValueError, match="declared as 'world'; choose scene or dataset"):
        source.in_frame(frame(), "world")


def test_a_moved_scene_looks_the_same():
    from freqgs_plugin.rendering.base import get_rasterizer
    from freqgs_plugin.rendering.render import render
    from freqgs_plugin.types import Camera, Gaussians

    raw, move = gaussians(60, degree=3), frame(scale=2.5)
    raw = replace(raw, means=raw.means * 0.5 + torch.tensor([0.0, 0, 4]), opacities=raw.opacities + 2)

    def picture(raw, viewmat):
        scene = Gaussians(
            raw.means,
            raw.quats,
            raw.scales.exp(),
            raw.opacities.sigmoid()[:, 0],
            raw.features_dc,
            raw.features_rest,
            torch.ones(len(raw), dtype=torch.int32),
        )
        K = torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]])
        return render(scene, Camera(viewmat, K, 80, 60), rasterizer=get_rasterizer("torch", "cpu")).features

    before = picture(raw, torch.eye(4))
    # the same camera in the other frame: x' = s (R x + t), and depth times s
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = move.rotation.T, -move.scale * (move.rotation.T @ move.translation)
    after = picture(raw.moved(move), viewmat.float())
    assert before.std() > 0.1
    torch.testing.assert_close(after, before, atol=2e-3, rtol=0)


def test_frames_are_nerfstudios():
    three = torch.tensor([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]])
    four = torch.cat([three, torch.tensor([[0.0, 0, 0, 1]])])
    for matrix in (three, four, three.tolist()):
        point = frame_of(matrix, 2).points(torch.tensor([[1.0, 2, 3]], dtype=torch.float64))
        assert point.tolist() == [[6.0, 14.0, 20.0]]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"scale": 1}',
        '{"transform": [[1, 2]], "scale": 1}',
        '{"transform": [[1,0,0,0],[0,1,0,0],[0,0,-1,0]], "scale": 1}',
        '{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": 0}',
        '{"transform": [[1,0,0],[0,1,0,0]], "scale": 1}',
    ],
)
def test_transforms_that_are_none(tmp_path, text):
    save(tmp_path, state(gaussians()))
    (tmp_path / "dataparser_transforms.json").write_text(text)
    refused(r"dataparser_transforms.json is no dataparser transform of nerfstudio .*init-from-frame", tmp_path)


# -- what is refused --------------------------------------------------------------------------------------------------


def test_nothing_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"does not exist; name a 3DGS PLY, a run's folder"):
        read_init_source(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match=r"holds no nerfstudio_models/step-\*.ckpt"):
        read_init_source(tmp_path)
    (tmp_path / "a.splat").touch()
    refused("is neither a PLY nor part of a run", tmp_path / "a.splat")


def test_truncated_checkpoints(tmp_path):
    path = save(tmp_path, state(gaussians()))
    content = path.read_bytes()
    for keep in (0, 50, len(content) // 2, len(content) - 20):
        path.write_bytes(content[:keep])
        refused("cannot be read .*it is truncated, or no checkpoint", tmp_path)
    path.write_bytes(b"not a checkpoint at all" * 100)
    refused("cannot be read", tmp_path)


class Surprise:
    """What runs when it is unpickled."""

    def __reduce__(self):
        return (print, ("code ran",))


def test_code_in_a_checkpoint_is_not_run(tmp_path, capsys):
    save(tmp_path, state(gaussians()), schedulers=Surprise())
    refused("holds objects of .*print beside tensors and numbers.*ns-export gaussian-splat", tmp_path)
    assert "code ran" not in capsys.readouterr().out


def test_other_methods(tmp_path):
    save(tmp_path / "nerf", {"_model.field.mlp": torch.zeros(3)})
    refused(
        "holds no Gaussians: it lacks means, scales.*has _model.field.mlp.*Name a run of splatfacto", tmp_path / "nerf"
    )
    tensors = state(gaussians())
    tensors["_model.gauss_params.appearance"] = torch.zeros(15, 8)
    save(tmp_path / "splat", tensors)
    refused("is of another method: its Gaussians have appearance too", tmp_path / "splat")
    torch.save({"weights": 1}, tmp_path / "step-1.ckpt")
    refused("holds no 'pipeline'", tmp_path / "step-1.ckpt")


@pytest.mark.parametrize(
    "name, shape", [("scales", (15, 2)), ("opacities", (15,)), ("features_rest", (15, 7, 3)), ("quats", (14, 4))]
)
def test_other_shapes(tmp_path, name, shape):
    tensors = state(gaussians())
    tensors[f"_model.gauss_params.{name}"] = torch.ones(shape)
    save(tmp_path, tensors)
    refused(f"{name} has shape .* in place of", tmp_path)


def test_contents_that_are_no_tensors(tmp_path):
    pipeline = state(gaussians())
    refused("level is no tensor but 'x'", save(tmp_path / "a", {**pipeline, "_model.level": "x"}))
    path = save(tmp_path / "b", pipeline)
    torch.save({"step": "many", "pipeline": pipeline}, path)
    refused("its step is 'many'", path)
    assert len(read_init_source(save(tmp_path / "c", {**pipeline, 7: torch.zeros(1)})).gaussians) == 15


def test_no_gaussians(tmp_path):
    save(tmp_path, {k: v[:0] for k, v in state(gaussians()).items()})
    refused("holds no Gaussians; name another checkpoint", tmp_path)


@pytest.mark.parametrize("name", [*GROUPS, "decay"])
@pytest.mark.parametrize("value", [float("nan"), -float("inf")])
def test_values_that_are_not_finite(tmp_path, name, value):
    tensors = state(gaussians(decay=torch.ones(15)))
    key = f"_model.gauss_params.{name}"
    tensors[key] = tensors[key].clone()
    tensors[key][[2, 9]] = value
    save(tmp_path, tensors)
    refused(f"{name} of 2 of 15 Gaussians is NaN or infinite. Name an earlier checkpoint", tmp_path)


def test_quaternions_and_levels_of_zero(tmp_path):
    raw = gaussians()
    raw.quats[3] = 0
    save(tmp_path, state(raw))
    refused("a quaternion is zero", tmp_path)
    save(tmp_path, state(gaussians(level=torch.zeros(15, dtype=torch.int32))))
    refused("levels begin with 1, but one is 0", tmp_path)
    short = state(gaussians())
    short["_model.level"] = torch.ones(7, dtype=torch.int32)
    save(tmp_path, short)
    refused("level has 7 values for 15 Gaussians", tmp_path)


@pytest.mark.parametrize("signed", [True, None])
def test_signed_residuals(tmp_path, signed):
    level = torch.arange(15, dtype=torch.int32) % 3 + 1
    save(tmp_path, state(gaussians(level=level)))
    refused("has 3 levels, .*signed residuals.*signed-residuals False", tmp_path, signed_residuals=signed)
    # one level has none
    raw = gaussians(level=torch.ones(15, dtype=torch.int32))
    save(tmp_path, state(raw))
    same(read_init_source(tmp_path, signed_residuals=signed).gaussians, raw)


# -- parameters -------------------------------------------------------------------------------------------------------


def test_another_degree_cuts_off_or_adds_zeros():
    raw = gaussians(degree=2)
    more, less = raw.with_degree(4), raw.with_degree(1)
    assert more.sh_degree == 4 and torch.equal(more.features_rest[:, :8], raw.features_rest)
    assert (more.features_rest[:, 8:] == 0).all()
    assert less.sh_degree == 1 and torch.equal(less.features_rest, raw.features_rest[:, :3])
    same(raw.with_degree(2), raw)
    assert raw.with_degree(0).features_rest.shape == (15, 0, 3)
