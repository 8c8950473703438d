"""What `freqgs experiment` hands to its experiments: scenes, ns-train's arguments, defaults of the methods."""

import json
from pathlib import Path

import pytest

from freqgs_plugin import cli
from freqgs_plugin.demo import experiments, training
from freqgs_plugin.reports.experiments import ablation
from freqgs_plugin.reports.experiments.options import ClodOptions, ExperimentError
from freqgs_plugin.reports.experiments.store import alone
from freqgs_plugin.reports.experiments.training import ABLATION_SCALE, DEFAULT_SCALE, ExperimentScene, Training, Trial
from freqgs_plugin.training.presets import CLODSPLAT_PAPER, LAPSPLAT_PAPER, PLAIN

DOCS = Path(__file__).parents[2] / "docs"


def test_defaults_have_every_option_that_is_set():
    clod, plain = experiments.method_defaults("clodsplat"), experiments.method_defaults("lapsplat")
    trial = Trial(ExperimentScene("room", Path("room"), ""), 30, 42)
    assert set(PLAIN) <= set(plain) and "max_gaussians" in plain and "FusedAdamConfig" in plain["optimizers"]
    for one in ablation.trainings(trial).values():
        assert set(one.options) <= set(clod)
        one.settings(clod)
    # w_s and L_reg as in the method, so that the ablation's row is a run of the curves
    default = ablation.trainings(trial)[ablation.name_of(True, "ste")]
    assert default.settings(clod) == trial.clod(ABLATION_SCALE).settings(clod)
    assert trial.clod(DEFAULT_SCALE).settings(clod) == Training(trial.scene, "clodsplat", 30, 42).settings(clod)


@pytest.mark.parametrize(
    ("method", "preset"),
    [("lapsplat-plain", PLAIN), ("lapsplat-paper", LAPSPLAT_PAPER), ("clodsplat-paper", CLODSPLAT_PAPER)],
)
def test_a_preset_is_a_method_that_differs_in_it_alone(method, preset):
    ours, base = experiments.method_defaults(method), experiments.method_defaults(method.split("-")[0])
    differs = {name for name in base if ours[name] != base[name]} - {"optimizers"}
    assert {name: ours[name] for name in preset} == {name: repr(value) for name, value in preset.items()}
    assert differs <= set(preset) and len(differs) > 2
    assert method in (DOCS / "methods.md").read_text(encoding="utf-8")


def test_arguments_name_method_options_and_seed(tmp_path, monkeypatch):
    (tmp_path / "room" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "room" / "sparse" / "0" / "cameras.bin").touch()
    scene = experiments.scene_of(tmp_path / "room")
    seen = []

    def train(run, log, on_step):
        assert not run.folder.exists(), "what an earlier try left is gone"
        seen.append(run.arguments())
        on_step(7, None)

    monkeypatch.setattr(training, "train", train)
    left = tmp_path / "runs" / "room" / "clodsplat" / "name" / "nerfstudio_models"
    left.mkdir(parents=True)
    (left / "step-000000010.ckpt").touch()
    steps = []
    run = Trial(scene, 30, 43).clod(3.0, {"reg_weight": 0.0})
    path = experiments.train_run(tmp_path / "runs", run, "name", steps.append)
    assert path == tmp_path / "runs" / "room" / "clodsplat" / "name" / "config.yml" and steps == [7]
    (arguments,) = seen
    text = " ".join(arguments)
    assert arguments[0] == "clodsplat" and "--pipeline.model.num-levels" not in text
    for part in (
        "--machine.seed 43",
        "--pipeline.model.seed 43",
        "--pipeline.model.largest-scale 3.0",
        "--pipeline.model.reg-weight 0.0",
        "--max-num-iterations 30",
        "colmap --colmap-path sparse/0 --eval-mode interval --eval-interval 8",
    ):
        assert part in text, part


def test_folders_that_are_no_scenes_are_refused(tmp_path, capsys):
    with pytest.raises(ExperimentError, match="neither a COLMAP model nor a transforms"):
        experiments.scene_of(tmp_path)
    with pytest.raises(SystemExit) as stop:
        cli.main(["experiment", "clod", "--scenes", str(tmp_path), "--no-demo", "--output-dir", str(tmp_path / "out")])
    assert stop.value.code == 1 and "neither a COLMAP" in capsys.readouterr().err
    (tmp_path / "transforms.json").touch()
    assert experiments.parser_of(tmp_path)[0] == "nerfstudio-data"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("claims", "--only", "A-z"), "--only A-z: choose among A-a"),
        (("claims", "--docs", "PAGE"), "no one place for the table 'claims-A demo'"),
        (
            ("clod", "--docs", "PAGE"),
            "is no page that this command wrote (it would begin with '# clodsplat, measured')",
        ),
    ],
)
def test_what_is_mistyped_is_told_before_a_scene_is_made(tmp_path, capsys, arguments, message):
    page = tmp_path / "page.md"
    page.write_text("# My notes\n")
    given = [str(page) if word == "PAGE" else word for word in arguments]
    with pytest.raises(SystemExit) as stop:
        cli.main(["experiment", *given, "--output-dir", str(tmp_path / "out")])
    assert stop.value.code == 1 and message in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["page.md"] and page.read_text() == "# My notes\n"


def test_a_demo_scene_is_not_made_where_another_start_works(tmp_path):
    with alone(tmp_path), pytest.raises(ExperimentError, match="another `freqgs experiment` works in"):
        experiments.demo_scene(ClodOptions(tmp_path, views=2, size=(24, 16), frames=10))
    assert not (tmp_path / "scenes").exists()


def test_the_demo_scene_is_made_once_and_zooms_tenfold(tmp_path):
    options = ClodOptions(tmp_path, views=2, size=(24, 16), frames=10)
    scene = experiments.demo_scene(options)
    image = next((scene.folder / "images").iterdir())
    before = image.stat().st_mtime_ns
    again = experiments.demo_scene(options)
    assert image.stat().st_mtime_ns == before and again.identity == scene.identity
    assert json.loads(scene.identity)["num_views"] == 2
    assert scene.dolly is not None and len(scene.dolly) == 11
    (scene.folder / "sparse" / "0" / "points3D.bin").unlink()
    experiments.demo_scene(options)
    assert image.stat().st_mtime_ns > before, "a scene left half-written is made again"


def test_the_command_is_listed_and_needs_a_name(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["experiment", "--help"])
    assert stop.value.code == 0 and "clod" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        cli.main(["experiment"])
    assert stop.value.code != 0
