"""Training that starts from an exported scene or from another run."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from running import advance, in_render_thread, save
from state import all_finite, consistent, parameters, same

from freqgs_plugin.functional.budget import in_view
from freqgs_plugin.io.init_source import TRANSFORMS, frame_of, read_frame, read_init_source
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.io.ply import SplatFileError, write_ply
from freqgs_plugin.studio import starting
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.starting import RunFacts, read_start, run_facts

RUN = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
data: &id001 !!python/object/apply:pathlib.PosixPath
- /
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  datamanager:
    data: *id001
  model: !!python/object:some.Model
    _target: !!python/name:no.such.module ''
    rasterize_mode: {mode}
{more}
method_name: something
"""


def test_a_runs_config_is_read_without_making_its_objects(tmp_path):
    (tmp_path / "nerfstudio_models").mkdir()
    checkpoint = tmp_path / "nerfstudio_models" / "step-1.ckpt"
    for mode, more, expected in (
        ("antialiased", "    signed_residuals: false", RunFacts(False, True)),
        ("classic", "    signed_residuals: true", RunFacts(True, False)),
        ("classic", "    other: 1", RunFacts(None, False)),
    ):
        (tmp_path / "config.yml").write_text(RUN.format(mode=mode, more=more))
        for path in (tmp_path, tmp_path / "config.yml", checkpoint.parent, checkpoint):
            assert run_facts(path) == expected
    assert run_facts(tmp_path / "far" / "away" / "from" / "it") == RunFacts()


@pytest.mark.slow
def test_a_damaged_config_is_named(tmp_path):
    for content in (b"pipeline: [1, 2", b"\xff\xfe\x00broken"):
        (tmp_path / "config.yml").write_bytes(content)
        with pytest.raises(SplatFileError, match=r"config.yml is damaged .*copy it again"):
            run_facts(tmp_path)


@pytest.mark.parametrize("dead_decay, then", [("keep", "they begin at 0.3"), ("prune", "they are pruned")])
def test_dead_decays_are_told(dead_decay, then):
    raw = SimpleNamespace(sh_degree=0, decay=torch.tensor([-1.0, 0.0, 2.0]))
    config = SimpleNamespace(
        sh_degree=3, use_decay=True, least_decay=0.3, dead_decay=dead_decay, rasterize_mode="antialiased"
    )
    source = SimpleNamespace(antialiased=None, gaussians=Three(**vars(raw)))
    (doubt,) = starting._doubts.__wrapped__(source, config)
    assert doubt.startswith("2 of its 3 decays are dead (0 or less)") and doubt.endswith(f"{then}.")


class Three(SimpleNamespace):
    """Something of three Gaussians."""

    def __len__(self):
        return 3


def test_a_real_run_of_several_levels_is_refused(trained):
    with pytest.raises(SplatFileError, match="whose colours above level 1 are signed residuals: w"):
        read_start(trained)


# -- starting clodsplat -----------------------------------------------------------------------------------------------


def save_with_frame(trainer):
    """A checkpoint, and what `Trainer.train` writes beside it."""
    save(trainer)
    outputs = trainer.pipeline.datamanager.train_dataparser_outputs
    outputs.save_dataparser_transform(trainer.base_dir / TRANSFORMS)


@pytest.fixture
def plain(make_trainer):
    """A short run of one level, saved: its trainer."""
    trainer = make_trainer(num_levels=1, rasterize_mode="classic", steps_scale=0.002, least_refine_interval=10)
    advance(trainer, 45)
    save_with_frame(trainer)
    return trainer


@pytest.fixture
def start(make_trainer):
    """`start(path, **settings)`: a trainer of clodsplat that begins there."""

    def make(path, edit=lambda config: None, **settings):
        def named(config):
            config.timestamp = "started"
            edit(config)

        return make_trainer(method="clodsplat", edit=named, steps_scale=0.01, init_from=path, **settings)

    return make


def run_folder(trainer):
    return trainer.base_dir


def raw_of(model):
    return RawGaussians(**{name: model.gauss_params[name].detach().clone() for name in GROUPS})


def scene_frame(trainer):
    outputs = trainer.pipeline.datamanager.train_dataparser_outputs
    return frame_of(outputs.dataparser_transform, outputs.dataparser_scale)


def logged_psnr(said):
    (line,) = [line for line in said if line.startswith("The start shows training views at")]
    return float(line.split()[-2])


@pytest.mark.slow
def test_a_run_is_taken_over_bit_by_bit(plain, start, said):
    source = plain.pipeline.model
    trainer = start(run_folder(plain))
    model = trainer.pipeline.model
    ours, theirs = parameters(model), parameters(source)
    assert torch.equal(ours.pop("decay"), torch.full((source.num_points, 1), 5.0)) and same(ours, theirs)
    assert f"{source.num_points:,} Gaussians of step 44; SH degree 3; with levels." in " ".join(said)
    assert any("trained with rasterize-mode classic; here it is antialiased" in line for line in said)
    consistent(trainer)
    # the same pictures, where the mode is the same
    model.config.rasterize_mode = "classic"
    camera, _ = trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]
    for m in (model, source):
        m.eval()
        m._sh_degree = 3
    with torch.no_grad():
        assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], source.get_outputs_for_camera(camera)["rgb"])


@pytest.mark.slow
def test_it_decays_at_once_and_is_not_densified(plain, start):
    trainer = start(run_folder(plain))
    model, n = trainer.pipeline.model, plain.pipeline.model.num_points
    before = parameters(model)
    # step 0 is one at full detail
    _, losses, metrics = advance(trainer, 2)
    assert "count" in losses and metrics["scale"] > 1 and model._sh_degree == 3
    for _ in range(40):
        advance(trainer, 1)
        assert not model.schedule.refines(model.step) and not model.schedule.resets(model.step)
    # only a dead decay is removed
    assert model.num_points == n and all_finite(model)
    after = parameters(model)
    assert all(not torch.equal(after[name], before[name]) for name in before)
    consistent(trainer)


@pytest.mark.slow
def test_refinement_is_an_option(plain, start):
    schedule = start(run_folder(plain), init_refine=True).pipeline.model.schedule
    assert any(schedule.refines(step) for step in range(300)) and any(schedule.resets(step) for step in range(300))


@pytest.mark.slow
def test_a_started_run_resumes_as_one(plain, start, make_trainer):
    trainer = start(run_folder(plain))
    advance(trainer, 12)
    folder = save(trainer)
    expected = parameters(trainer.pipeline.model)
    # without init_from: the checkpoint says it
    resumed = make_trainer(load_dir=folder, method="clodsplat", steps_scale=0.01)
    model = resumed.pipeline.model
    assert same(parameters(model), expected) and model._started and model.schedule.refine_stop == -1
    advance(resumed, 3)
    assert model._sh_degree == 3 and model._decays and model.num_points == len(expected["means"])
    consistent(resumed)


@pytest.mark.slow
def test_a_clodsplat_run_keeps_its_decays(plain, start, said):
    first = start(run_folder(plain))
    advance(first, 5)
    save_with_frame(first)
    learned = first.pipeline.model.gauss_params["decay"].detach().clone()
    assert not torch.equal(learned, torch.full_like(learned, 5.0))
    again = start(run_folder(first), edit=lambda config: setattr(config, "timestamp", "again"))
    assert torch.equal(again.pipeline.model.gauss_params["decay"], learned)

    def without(config):
        config.timestamp = "without"
        del config.optimizers["decay"]

    bare = start(run_folder(first), edit=without, use_decay=False)
    assert set(bare.pipeline.model.gauss_params) == set(GROUPS)
    assert any("Its decays are left out, because use-decay is off" in line for line in said)


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["scene", "dataset"])
def test_a_ply_in_either_frame(trained, start, said, tmp_path, frame):
    everything = read_init_source(trained, signed_residuals=False).gaussians
    assert everything.level is not None
    base = everything.level == 1
    raw = RawGaussians(**{name: getattr(everything, name)[base] for name in GROUPS})
    scene = read_frame(trained.parent / TRANSFORMS)
    assert not scene.is_identity()
    write_ply(tmp_path / "a.ply", raw if frame == "scene" else raw.moved(scene.inverse()), antialiased=True)
    trainer = start(tmp_path / "a.ply", init_from_frame=frame)
    for name in GROUPS:
        torch.testing.assert_close(parameters(trainer.pipeline.model)[name], getattr(raw, name), atol=2e-5, rtol=2e-5)
    assert not any("instead of" in line or "rasterize-mode" in line for line in said)
    right = logged_psnr(said)
    said.clear()
    other = {"scene": "dataset", "dataset": "scene"}[frame]
    start(tmp_path / "a.ply", init_from_frame=other, edit=lambda config: setattr(config, "timestamp", "wrong"))
    # how good the frame's own picture is depends on the tiny run; that its parameters are the run's is shown above
    assert logged_psnr(said) < right - 3
    assert any(
        f"Taken to be in the frame '{frame}' instead of '{other}'" in line and f"init-from-frame {frame}`" in line
        for line in said
    )


@pytest.mark.slow
def test_a_run_in_another_frame_is_moved(plain, start, tmp_path):
    raw = raw_of(plain.pipeline.model)

    def unscaled(config):
        config.pipeline.datamanager.dataparser.scale_factor = 0.5
        config.pipeline.datamanager.dataparser.orientation_method = "none"

    trainer = start(run_folder(plain), edit=unscaled)
    move = scene_frame(trainer).after(scene_frame(plain).inverse())
    assert abs(move.scale - 1) > 0.1
    for name in GROUPS:
        expected = getattr(raw.moved(move), name)
        torch.testing.assert_close(parameters(trainer.pipeline.model)[name], expected, atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_another_scene_is_doubted(plain, start, said, tmp_path):
    raw = raw_of(plain.pipeline.model)
    write_ply(tmp_path / "a.ply", replace(raw, means=raw.means + 3.0, features_dc=-raw.features_dc))
    start(tmp_path / "a.ply")
    assert any("That is hardly the same scene" in line for line in said)


@pytest.mark.slow
def test_another_degree_is_cut_off(plain, start, said):
    model = start(run_folder(plain), sh_degree=1).pipeline.model
    assert model.features_rest.shape[1] == 3 and model._sh_degree == 1
    assert "Its harmonics of degree 3 are cut off at sh-degree 1." in " ".join(said)


@pytest.mark.slow
def test_what_cannot_be_started_from(start, trained, tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist; name a 3DGS PLY"):
        start(tmp_path / "none.ply" / "deeper")
    with pytest.raises(SplatFileError, match="has 3 levels"):
        start(trained)


@pytest.mark.slow
def test_the_viewers_budget_with_decays_and_before(plain, start):
    trainer = start(run_folder(plain))
    model = trainer.pipeline.model
    camera, _ = trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]
    model.eval()

    def drawn():
        picture = in_render_thread(lambda: model.get_outputs_for_camera(camera)["rgb"])
        return int(model.controls.drawn.value.split(" / ")[0].replace(",", "")), picture

    model.controls.mode.value = "budget"
    with torch.no_grad():
        seen = int(in_view(model.gaussians(), to_camera(camera)).sum())
        for decays in (False, True):
            model._decays, model.controls.budget.value = decays, 0.0
            everything, full = drawn()
            model.controls.budget.value = 1e6
            assert drawn()[0] <= seen
            torch.testing.assert_close(drawn()[1], full)
            model.controls.budget.value = 0.03
            assert drawn()[0] == 30 and not torch.equal(drawn()[1], full)
        # what the slider leaves is within the budget already
        model.controls.budget.value, model.controls.slider.value = 1e6, 10.0
        assert drawn()[0] < everything
