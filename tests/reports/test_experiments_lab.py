"""Steps are done once: what is finished is found again, what was interrupted or changed is done anew."""

import io
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parent))

from fake_lab import SCENE, FakeTools, fake_lab

from freqgs_plugin.reports.experiments import runner
from freqgs_plugin.reports.experiments.lab import Missing
from freqgs_plugin.reports.experiments.options import ClodOptions, ExperimentError
from freqgs_plugin.reports.experiments.runner import run_clod
from freqgs_plugin.reports.experiments.store import Store, alone, key
from freqgs_plugin.reports.experiments.training import DEFAULT_SCALE, Trial

TRIAL = Trial(SCENE, 30, 42)


def quiet():
    return Console(width=200, record=True, file=io.StringIO())


# -- single steps -----------------------------------------------------------------------------------------------------


def test_a_step_is_found_by_its_settings_and_infinity_becomes_null(tmp_path):
    store = Store(tmp_path)
    assert store.read("curve", {"a": 1, "b": (2.0,)}) is None
    written = store.write("curve", {"a": 1, "b": (2.0,)}, {"psnr": float("inf"), "x": (1, 2)}, 1.25)
    assert written["result"] == {"psnr": None, "x": [1, 2]} and {"date", "commit", "seconds"} <= written.keys()
    assert store.read("curve", {"b": (2.0,), "a": 1}) == written, "order is no setting"
    assert store.read("curve", {"a": 2, "b": (2.0,)}) is None and store.read("sigma", {"a": 1, "b": (2.0,)}) is None
    assert [path.name for path in tmp_path.iterdir()] == [f"curve-{key({'a': 1, 'b': (2.0,)})}.json"]


def test_a_damaged_step_is_named(tmp_path):
    store = Store(tmp_path)
    store.write("curve", {}, 1, 0.0)
    path = store.path("curve", {})
    path.write_text(path.read_text()[:-20])
    with pytest.raises(ExperimentError, match=f"{path.name} is damaged .*remove it"):
        store.read("curve", {})


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"seconds": "x"}, "seconds is 'x'"),
        ({"date": 5}, "date is 5"),
        ({"digest": None}, "without digest"),
        ({"settings": {}}, "its settings are not those of its name"),
        (None, "maximum recursion depth"),
    ],
)
def test_a_record_of_other_types_is_named(tmp_path, change, why):
    store = Store(tmp_path)
    store.write("curve", {"a": 1}, {"psnr": 27.0}, 0.0)
    path = store.path("curve", {"a": 1})
    record = {**json.loads(path.read_text()), **(change or {})}
    text = json.dumps({name: value for name, value in record.items() if value is not None})
    path.write_text("[" * 100_000 if change is None else text)
    with pytest.raises(ExperimentError, match=f"is damaged .*{why}.*remove it"):
        store.read("curve", {"a": 1})


@pytest.mark.parametrize("error", [ValueError("it is truncated."), FileNotFoundError("there is none.")])
def test_a_run_that_cannot_be_loaded_is_named_with_its_step(tmp_path, error):
    lab, tools = fake_lab(tmp_path)
    training = Trial(SCENE, 30, 42).plain()
    lab.config_path(training)

    def fail(path):
        raise error

    lab = replace(lab, tools=replace(lab.tools, load=fail))
    (step,) = (tmp_path / "steps").glob("train-*.json")
    with pytest.raises(ExperimentError, match=f"cannot be loaded .* Remove .*{step.name}, and it is trained again"):
        lab.run(training)
    step.unlink()
    # as the real training does: whatever is left of an earlier try goes
    shutil.rmtree(tools.folder)
    lab.config_path(training)
    assert len(tools.trained) == 2


def test_an_edited_result_is_named(tmp_path):
    store = Store(tmp_path)
    store.write("curve", {}, {"psnr": 27.0}, 0.0)
    path = store.path("curve", {})
    path.write_text(path.read_text().replace("27.0", "28.0"))
    with pytest.raises(ExperimentError, match=r"its result was changed.*the step is done again"):
        store.read("curve", {})


def test_a_training_is_done_once(tmp_path):
    lab, tools = fake_lab(tmp_path)
    path = lab.config_path(TRIAL.clod())
    assert path.is_file() and lab.config_path(TRIAL.clod()) == path and len(tools.trained) == 1
    again, others = fake_lab(tmp_path)
    assert again.config_path(TRIAL.clod()) == path and others.trained == []
    assert "what nerfstudio says" in (tmp_path / "load.log").read_text()


def test_settings_that_equal_the_defaults_make_the_same_training(tmp_path):
    lab, tools = fake_lab(tmp_path)
    lab.config_path(TRIAL.clod())
    lab.config_path(TRIAL.clod(7, {"reg_weight": 1.0, "reg_gradient": "ste"}))
    assert len(tools.trained) == 1
    for other in (
        TRIAL.clod(3.0),
        TRIAL.clod(more={"reg_gradient": "soft"}),
        Trial(SCENE, 31, 42).clod(),
        Trial(SCENE, 30, 43).clod(),
        TRIAL.plain(),
        TRIAL.plain(max_gaussians=10),
    ):
        lab.config_path(other)
    assert len(tools.trained) == 7


def test_an_option_that_came_later_trains_anew_only_where_it_acts(tmp_path):
    _, tools = fake_lab(tmp_path)
    defaults, training = dict(tools.defaults("lapsplat")), TRIAL.plain()
    before = training.settings(defaults)
    assert training.settings({**defaults, "least_level_gain": "0.0"}) == before
    assert training.settings({**defaults, "least_level_gain": "0.5"}) != before


def test_what_only_shows_does_not_train_anew(tmp_path):
    _, tools = fake_lab(tmp_path)
    defaults, training = dict(tools.defaults("clodsplat")), TRIAL.clod()
    found = [training.settings({**defaults, "detail_scales": scales}) for scales in ("(1.0,)", "(1.0, 2.0)")]
    assert found[0] == found[1]


def test_a_default_that_changed_trains_anew(tmp_path):
    lab, _ = fake_lab(tmp_path)
    lab.config_path(TRIAL.clod())
    changed, tools = fake_lab(tmp_path, changed={"reg_weight": 0.5})
    changed.config_path(TRIAL.clod())
    assert len(tools.trained) == 1
    with pytest.raises(AssertionError, match="no options"):
        changed.config_path(TRIAL.clod(more={"misspelt": 1}))


def test_an_interrupted_training_is_done_again(tmp_path):
    lab, _ = fake_lab(tmp_path, stop_at=0)
    with pytest.raises(KeyboardInterrupt):
        lab.config_path(TRIAL.clod())
    lab, tools = fake_lab(tmp_path)
    lab.config_path(TRIAL.clod())
    assert len(tools.trained) == 1


def test_a_run_whose_folder_is_gone_is_trained_again_only_where_it_is_needed(tmp_path):
    lab, _ = fake_lab(tmp_path)
    assert lab.step("curve", [TRIAL.clod()], {}, lambda: len(lab.run(TRIAL.clod()).gaussians)) == 60
    lab.config_path(TRIAL.clod()).unlink()
    again, tools = fake_lab(tmp_path)
    assert again.step("curve", [TRIAL.clod()], {}, lambda: 1 / 0) == 60 and tools.trained == []


def test_a_failing_step_leaves_nothing_and_a_finished_one_is_not_repeated(tmp_path):
    lab, _ = fake_lab(tmp_path)
    with pytest.raises(ZeroDivisionError):
        lab.step("curve", [TRIAL.clod()], {"n": 1}, lambda: 1 / 0)
    assert lab.step("curve", [TRIAL.clod()], {"n": 1}, lambda: 5) == 5
    assert lab.step("curve", [TRIAL.clod()], {"n": 1}, lambda: 1 / 0) == 5
    assert lab.step("curve", [TRIAL.clod()], {"n": 2}, lambda: 6) == 6
    assert len(lab.used) == 2


def test_only_finished_does_nothing(tmp_path):
    lab, tools = fake_lab(tmp_path)
    lab.only_finished = True
    with pytest.raises(Missing):
        lab.step("curve", [TRIAL.clod()], {}, lambda: 1)
    with pytest.raises(Missing):
        lab.config_path(TRIAL.clod())
    assert tools.trained == []


def test_two_loaded_runs_are_kept(tmp_path):
    lab, tools = fake_lab(tmp_path)
    trainings = [TRIAL.clod(s) for s in (1.0, 3.0, 5.0)]
    for training in (trainings[0], trainings[0], trainings[1], trainings[0], trainings[2], trainings[0], trainings[1]):
        lab.run(training)
    assert len(tools.loaded) == 4, "the second one was dropped for the third, and read again"


@pytest.fixture(autouse=True)
def blank_pictures(monkeypatch):
    """Drawing them takes seconds each time; test_experiments.py draws them once."""
    monkeypatch.setattr(runner, "png", lambda figure: b"PNG" if figure.axes else b"")


# -- the whole experiment ---------------------------------------------------------------------------------------------


def options_in(tmp_path, **more):
    return ClodOptions(tmp_path / "out", **{"steps": 30, "frames": 4, "s_max": (1.0, DEFAULT_SCALE), **more})


def run(options, **more):
    tools, console = FakeTools(options.output_dir / "runs", **more), quiet()
    shown = run_clod(options, [SCENE], tools.tools(), console)
    return shown, tools, console.export_text()


def test_everything_is_measured_once_and_written(tmp_path):
    options = options_in(tmp_path, docs=tmp_path / "docs" / "clodsplat.md")
    shown, tools, text = run(options)
    # s_max 1 and the default, plain, its coarse sibling, 8 cells of the ablation (s_max 5) and one without decay
    assert len(tools.trained) == 2 + 2 + 8 + 1
    assert [each.part.name for each in shown] == ["curve", "budget", "pops", "ablation", "sigma"]
    out = options.output_dir
    report = json.loads((out / "clod.json").read_text())
    assert report["options"]["steps"] == 30 and report["seeds"] == [42] and len(report["goals"]) == 5 + 6 + 3
    assert str(tmp_path) not in (out / "clod.json").read_text() + (out / "clod.md").read_text()
    page, copy = (out / "clod.md").read_text(), options.docs.read_text()
    assert "goals are reached" in page and "**not reached**" in page and "goals are reached" in text
    pictures = sorted(path.name for path in out.glob("*.png"))
    assert len(pictures) == 6 and all(f"]({name})" in page and f"](images/{name})" in copy for name in pictures)
    assert sorted(path.name for path in (options.docs.parent / "images").iterdir()) == pictures
    assert not list(tmp_path.rglob("*.part"))

    again, idle, _ = run(options)
    assert idle.trained == [] and idle.loaded == []
    assert [each.results for each in again] == [each.results for each in shown]


def test_a_stopped_experiment_goes_on(tmp_path):
    options = options_in(tmp_path, only=("curve",))
    with pytest.raises(KeyboardInterrupt):
        run(options, stop_at=2)
    assert not (options.output_dir / "clod.json").exists()
    _, tools, _ = run(options)
    assert [training.method for training in tools.trained] == ["lapsplat"], "only the third was missing"


def test_the_message_of_a_stop_says_how_to_go_on(tmp_path):
    options, console = options_in(tmp_path, only=("sigma",)), quiet()
    with pytest.raises(KeyboardInterrupt):
        run_clod(options, [SCENE], FakeTools(options.output_dir / "runs", stop_at=0).tools(), console)
    assert "the same command goes on from there" in console.export_text()


def test_sections_that_are_finished_stay_on_the_page(tmp_path):
    run(options_in(tmp_path, only=("sigma",)))
    shown, tools, _ = run(options_in(tmp_path, only=("budget",)))
    assert [each.part.name for each in shown] == ["budget", "sigma"]
    assert [training.method for training in tools.trained] == ["lapsplat"], "the default is trained already"
    other, _, _ = run(options_in(tmp_path, only=("sigma",), steps=31))
    assert [each.part.name for each in other] == ["sigma"], "other settings, another page"


def test_seeds_are_trained_separately_and_shown_with_their_spread(tmp_path):
    options = options_in(tmp_path, only=("sigma",), seeds=2)
    (shown,), tools, _ = run(options)
    assert [training.seed for training in tools.trained] == [42, 42, 43, 43] and len(shown.results["room"]) == 2
    assert "±" in (options.output_dir / "clod.md").read_text()


def test_sections_keep_the_seeds_that_are_finished(tmp_path):
    run(options_in(tmp_path, only=("sigma", "ablation")))
    options = options_in(tmp_path, only=("sigma",), seeds=2)
    shown, _, _ = run(options)
    assert {each.part.name: list(each.results["room"]) for each in shown} == {"ablation": [42], "sigma": [42, 43]}
    page = (options.output_dir / "clod.md").read_text()
    before, after = page.split("\n## What is learned")
    assert before.count("Of seed 42 alone.") == 1 and "alone" not in after and "±" in after
    sections = json.loads((options.output_dir / "clod.json").read_text())["sections"]
    assert list(sections["sigma"]["room"]) == ["42", "43"] and list(sections["ablation"]["room"]) == ["42"]


def test_a_page_of_what_is_there_trains_nothing(tmp_path):
    options = options_in(tmp_path, only=("sigma",))
    run(options)
    (options.output_dir / "clod.md").unlink()
    shown, tools, _ = run(options_in(tmp_path, seeds=2, page_only=True))
    assert tools.trained == [] and [each.part.name for each in shown] == ["sigma"]
    page = (options.output_dir / "clod.md").read_text()
    assert "Of seed 42 alone." in page and "--page-only" not in page
    with pytest.raises(ExperimentError, match="holds no finished section"):
        run(options_in(tmp_path, steps=77, page_only=True))


def test_two_at_once_are_refused(tmp_path):
    options = options_in(tmp_path, only=("sigma",))
    options.output_dir.mkdir()
    with alone(options.output_dir), pytest.raises(ExperimentError, match=r"another .* works in .*another --output-dir"):
        run(options)
    run(options)
    run(options_in(tmp_path, page_only=True))


@pytest.mark.parametrize(
    "content", ["null", "[]", '{"settings": {}}', '{"settings": {}, "result": null}', '{"settings": {}, "result": 1}']
)
def test_steps_that_hold_no_result_are_named(tmp_path, content):
    store = Store(tmp_path)
    store.path("curve", {}).write_text(content)
    with pytest.raises(ExperimentError, match=r"is damaged .*remove it"):
        store.read("curve", {})


def test_a_child_ends_with_its_parent(tmp_path):
    """SIGTERM, as from `timeout` or a batch system."""
    code = (
        "import sys\nfrom freqgs_plugin.reports.child import child\n"
        "sleep = 'import time, os; print(os.getpid(), flush=True); time.sleep(60)'\n"
        "with child([sys.executable, '-c', sleep]) as process:\n"
        "    print(process.stdout.readline(), flush=True)\n    process.stdout.readline()\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.terminate()
    assert parent.wait(30) == 143
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
