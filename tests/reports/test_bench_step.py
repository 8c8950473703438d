"""Shares of a training step: the arithmetic of nested timers, and a short real run."""

import json
import sys

import pytest

from freqgs_plugin import cli
from freqgs_plugin.demo.dataset import SceneOptions, write_scene
from freqgs_plugin.reports import child as child_module
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.step import (
    COMPOSITING,
    RASTERIZER,
    TICKS,
    outside,
    part_rows,
    run_profile,
    step_bench,
    step_table,
)
from freqgs_plugin.studio.step_profile import REST, WARM_UP, Recorder, Sections


class Clock:
    """A clock that stands still until it is told to go on."""

    now = 0.0

    def __call__(self):
        return self.now


STAGES = {
    "1": {"steps": 10, "seconds": 1.0, "parts": {"compositing": 0.25, "Adam": 0.75}, "gaussians": 100, "held_up": 0},
    "2": {
        "steps": 20,
        "seconds": 4.0,
        "parts": {"compositing": 1.0, "compositing, backward": 2.0, "Adam": 0.5, REST: 0.5},
        "gaussians": 300,
        "held_up": 2,
    },
}


def test_nested_sections_are_counted_once():
    clock = Clock()
    sections = Sections(clock)

    def work(seconds, inner=lambda: None):
        clock.now += seconds
        inner()

    inner = sections.timed(work, "inner")
    outer = sections.timed(work, "outer")
    outer(2.0, lambda: (inner(3.0, lambda: inner(1.0)), work(0.5)))
    assert sections.take() == {"inner": 4.0, "outer": 2.5}
    assert sections.take() == {}


def test_a_section_that_fails_is_counted_and_closed():
    clock = Clock()
    sections = Sections(clock)

    def fail():
        clock.now += 1.0
        raise ValueError

    for _ in range(2):
        with pytest.raises(ValueError), sections.section("outer"):
            sections.timed(fail, "failing")()
    assert sections.take() == {"failing": 2.0, "outer": 0.0}


def test_replaced_functions_stay_what_they_are():
    class Owner:
        scale = 3

        @staticmethod
        def plain(x):
            return 2 * x

        def method(self, x):
            return self.scale * x

    sections = Sections()
    sections.replace(Owner, "plain", "plain")
    sections.replace(Owner, "method", "method")
    assert Owner.plain(2) == Owner().plain(2) == 4 and Owner().method(2) == 6
    assert set(sections.seconds) == {"plain", "method"}


def test_steps_are_summed_by_stage_and_the_rest_is_nerfstudios():
    clock = Clock()
    sections = Sections(clock)
    recorder = Recorder(sections, clock)
    for step in range(WARM_UP + 6):
        # steps WARM_UP to WARM_UP + 2 are of stage 1
        recorder.begin(1 if step <= WARM_UP + 3 else 2, 100 + step)
        with sections.section("part"):
            clock.now += 1.0
        clock.now += 0.5
    one, two = recorder.stages()[1], recorder.stages()[2]
    assert one.steps == 3 and two.steps == 2, "the last step has no successor"
    assert one.seconds == pytest.approx(4.5) and one.parts == pytest.approx({"part": 3.0, REST: 1.5})
    assert two.parts == pytest.approx({"part": 2.0, REST: 1.0}) and two.gaussians == 100 + WARM_UP + 5


def test_a_step_in_which_the_process_stood_still_is_left_out():
    clock = Clock()
    sections = Sections(clock)
    recorder = Recorder(sections, clock)
    for step in range(WARM_UP + 10):
        recorder.begin(1, 5)
        with sections.section("part"):
            # densification is no such step
            clock.now += {WARM_UP + 3: 1000.0, WARM_UP + 5: 8.0}.get(step, 1.0)
    found = recorder.stages()[1]
    assert found.held_up == 1 and found.steps == 8 and found.seconds == pytest.approx(7 + 8)


def test_rows_add_up_to_the_whole_and_the_largest_comes_first():
    rows = part_rows(STAGES)
    assert [row["part"] for row in rows] == ["compositing, backward", "compositing", "Adam", REST]
    assert sum(row["share"] for row in rows) == pytest.approx(1)
    assert sum(row["last_share"] for row in rows) == pytest.approx(1)
    adam = next(row for row in rows if row["part"] == "Adam")
    assert adam["milliseconds"] == pytest.approx({"1": 75.0, "2": 25.0}) and adam["share"] == pytest.approx(0.25)
    assert outside(list(STAGES.values()), COMPOSITING) == pytest.approx(0.35)


def test_the_rasterizer_is_more_than_its_two_kernels():
    stages = [
        {"seconds": 10.0, "parts": {"compositing": 4.0, "binning": 1.0, "projection, backward": 2.0, "Adam": 3.0}}
    ]
    assert outside(stages, COMPOSITING) == pytest.approx(0.6) and outside(stages, RASTERIZER) == pytest.approx(0.3)


def test_table_ends_with_the_whole_step_and_names_what_is_outside_of_compositing():
    table = step_table(part_rows(STAGES), STAGES, 40)
    assert table.cells()[-1] == ["a whole step", "100", "200", "100.0 %", "100.0 %"]
    for what in ("Outside of the rasterizer (", "outside of its two compositing kernels alone: "):
        said = table.note.partition(what)[2]
        assert "35.0 % of the whole run, 25.0 % of its last stage" in said
    assert table.note.endswith("2 steps in which the system stopped the process are not counted.")
    assert "stage 2: 20 steps, 300 Gaussians" in table.note


@pytest.mark.parametrize("steps, folder, message", [(1200, "nowhere", "is no folder"), (99, ".", "at least 100")])
def test_impossible_runs_are_refused(tmp_path, steps, folder, message):
    with pytest.raises(BenchError, match=message):
        step_bench(BenchOptions(), tmp_path / folder, steps)


def test_a_failing_run_tells_the_end_of_its_output(tmp_path, monkeypatch):
    real = child_module.subprocess.Popen
    code = "print('step: 3'); print('the reason'); raise SystemExit(5)"
    monkeypatch.setattr(child_module.subprocess, "Popen", lambda command, **o: real([sys.executable, "-c", code], **o))
    with pytest.raises(BenchError, match=r"(?s)exit status 5.*the reason") as raised:
        run_profile(tmp_path, 100, 1, lambda what: None)
    assert "step: 3" not in str(raised.value)


def test_progress_comes_from_the_steps(tmp_path, monkeypatch):
    real = child_module.subprocess.Popen
    code = "import sys\nfor i in range(200): print('step: %d' % i)\nopen(sys.argv[-1], 'w').write('{}')"
    monkeypatch.setattr(
        child_module.subprocess, "Popen", lambda command, **o: real([sys.executable, "-c", code, *command[-2:]], **o)
    )
    ticks = []
    assert run_profile(tmp_path, 200, 1, ticks.append) == {}
    assert len(ticks) == TICKS and ticks[-1] == "step 199 of 200"


@pytest.mark.slow
def test_step_from_the_command_line(tmp_path):
    write_scene(tmp_path / "scene", SceneOptions(num_views=9, width=80, height=64, num_points=300, samples=1))
    options = ["--steps", "150", "--output-dir", str(tmp_path / "out")]
    cli.main(["bench", "step", "--data", str(tmp_path / "scene"), *options])
    rows = json.loads((tmp_path / "out" / "step.json").read_text())["tables"]["step"]["rows"]
    parts = {row["part"]: row for row in rows}
    expected = {"projection", "binning", "compositing", "projection, backward", "compositing, backward", "Adam"}
    expected |= {"loss: L1 and SSIM", "loss: frequency term", "loss: REDUCE", "harmonics and colours", REST}
    expected |= {"densification and stages", "nerfstudio: next image", "metrics", "a whole step"}
    assert expected <= set(parts)
    shares = [row["share"] for name, row in parts.items() if name != "a whole step"]
    assert sum(shares) == pytest.approx(1) and min(shares) >= 0
    assert set(parts["a whole step"]["milliseconds"]) == {"1", "2", "3"}
    assert parts["loss: frequency term"]["milliseconds"]["1"] == 0, "one level has no frequency term"
