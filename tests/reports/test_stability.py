"""Every quick case of `freqgs stability` in every backend and dtype, and the command around them."""

import functools
import io
import json
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from freqgs_plugin.reports.stability import runner
from freqgs_plugin.reports.stability.case import Case, Nothing, Refused, Row, Setting, Value
from freqgs_plugin.reports.stability.measure import measure, truths
from freqgs_plugin.reports.stability.suite import GROUPS, cases_of
from freqgs_plugin.reports.stability.tables import cell

CASES = [case for group in GROUPS for case in cases_of(group, quick=True)]


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """The tensors are tiny: a second thread only waits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@functools.lru_cache(maxsize=1)
def answers(name):
    case = next(case for case in CASES if case.id == name)
    return [] if isinstance(case.expected, Refused) else truths(case)


def test_names_are_unique():
    names = [case.id for case in CASES]
    assert len(set(names)) == len(names) > 100


@pytest.mark.parametrize(
    "case, setting",
    [pytest.param(c, s, id=f"{c.id}-{s.backend}-{s.precision}") for c in CASES for s in c.settings],
)
def test_outcome_is_the_expected_one(case, setting):
    right = answers(case.id)
    row = measure(case, setting, right, repeats=0)
    assert row.passed, row
    if right and "alpha" in right[0].outputs:
        # what is a value shows something, what is zero nothing
        assert any(bool(answer.outputs["alpha"].any()) for answer in right) == isinstance(case.expected, Value)


def doubled(right=2.0, slope=2.0, expected=Value(), error=None):  # noqa: B008
    """A case: y = 2 x, computed as right * x with the gradient `slope`."""

    def compute(setting):
        def f(leaves):
            if error is not None:
                raise error
            x = leaves["x"]
            return {"y": right * x.detach() + slope * (x - x.detach())}

        return f

    return Case(
        group="geometry",
        name="doubled",
        inputs=lambda: {"x": torch.tensor([3.0, -1.0]).double()},
        compute=compute,
        truth=lambda leaves: [{"y": 2 * leaves["x"]}],
        expected=expected,
        settings=(Setting("torch", torch.float32), Setting("torch", torch.float64)),
    )


SINGLE = Setting("torch", torch.float32)


def test_errors_of_value_and_gradient_are_measured():
    row = measure(doubled(), SINGLE)
    assert row.passed and row.value_error == 0 and row.gradient_error < 1e-7 and row.milliseconds > 0
    row = measure(doubled(right=2.2), SINGLE)
    assert not row.passed and row.value_error == pytest.approx(0.1) and row.gradient_error < 1e-7
    row = measure(doubled(slope=2.02), SINGLE)
    assert not row.passed and row.value_error < 1e-6 and row.gradient_error == pytest.approx(0.01, rel=1e-4)


def test_tolerances_depend_on_the_dtype():
    case = doubled(right=2 * (1 + 1e-7))
    assert [measure(case, setting).passed for setting in case.settings] == [True, False]


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_what_is_not_finite_fails(number):
    for case in (doubled(right=number), doubled(slope=number)):
        row = measure(case, SINGLE)
        assert not row.passed and not row.finite and row.outcome == "not finite" and row.value_error is None


def test_zero_is_exact():
    zero = replace(doubled(right=0.0, slope=0.0, expected=Nothing()), truth=lambda leaves: [{"y": 0 * leaves["x"]}])
    assert measure(zero, SINGLE).passed and measure(zero, SINGLE).outcome == "zero"
    almost = replace(zero, compute=doubled(right=0.0, slope=1e-30).compute)
    assert not measure(almost, SINGLE).passed


def test_errors_are_compared_by_type_and_message():
    error = ValueError("x is 3; it must be 4.")
    case = doubled(error=error, expected=Refused(ValueError, "x is 3.*must be"))
    row = measure(case, SINGLE)
    assert row.passed and row.outcome == "ValueError: x is 3; it must be 4." and row.milliseconds is None
    for other in (Refused(TypeError, "x is 3"), Refused(ValueError, "y is 3"), Value()):
        assert not measure(replace(case, expected=other), SINGLE).passed
    assert not measure(doubled(expected=Refused(ValueError, "x is 3")), SINGLE).passed, "no error at all"


def test_on_a_threshold_either_side_is_right():
    both = lambda leaves: [{"y": 2 * leaves["x"]}, {"y": 0 * leaves["x"]}]  # noqa: E731
    for right in (2.0, 0.0):
        assert measure(replace(doubled(right=right, slope=right), truth=both), SINGLE).passed
    assert not measure(replace(doubled(right=1.0, slope=2.0), truth=both), SINGLE).passed


@pytest.fixture
def few(monkeypatch):
    """Two groups of one or two cases."""
    table = {"geometry": [doubled()], "compositing": [replace(doubled(), group="compositing", name="one")]}
    monkeypatch.setattr(runner, "GROUPS", tuple(table))
    monkeypatch.setattr(runner, "cases_of", lambda group, quick: table[group])
    return table


def console():
    return Console(file=io.StringIO(), width=160, record=True)


def test_command_writes_json_and_page(few, tmp_path):
    said = console()
    runner.run_stability(tmp_path, None, True, said)
    groups = json.loads((tmp_path / runner.JSON).read_text())["groups"]
    assert list(groups) == ["geometry", "compositing"]
    record = groups["geometry"]
    assert {"date", "hardware", "versions", "commit", "seconds", "quick"} <= record.keys()
    assert [row["dtype"] for row in record["rows"]] == ["float32", "float64"]
    assert Row(**record["rows"][0]).passed
    page = (tmp_path / runner.PAGE).read_text()
    assert "## Geometry" in page and "| doubled | value | 0e+00, " in page and "none of them" in page
    assert "doubled" in said.export_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == [runner.JSON, runner.PAGE]


@pytest.mark.parametrize("content", ["{", "{}", "[]", '{"groups": 3}'])
def test_a_damaged_file_is_named_before_the_work(few, tmp_path, monkeypatch, content):
    (tmp_path / runner.JSON).write_text(content)
    monkeypatch.setattr(runner, "cases_of", lambda *_: 1 / 0)
    with pytest.raises(runner.StabilityError, match=f"{runner.JSON} is damaged .*move it away"):
        runner.run_stability(tmp_path, None, True, console())
    assert (tmp_path / runner.JSON).read_text() == content


def test_one_group_leaves_the_others_as_they_are(few, tmp_path):
    runner.run_stability(tmp_path, None, True, console())
    before = json.loads((tmp_path / runner.JSON).read_text())["groups"]
    few["compositing"].append(replace(doubled(), group="compositing", name="two"))
    runner.run_stability(tmp_path, "compositing", True, console())
    after = json.loads((tmp_path / runner.JSON).read_text())["groups"]
    assert after["geometry"] == before["geometry"]
    assert len(after["compositing"]["rows"]) == 4


def test_an_unexpected_outcome_is_an_error_after_the_report_is_written(few, tmp_path):
    few["geometry"].append(replace(doubled(right=float("nan")), name="broken"))
    with pytest.raises(runner.StabilityError, match=r"2 outcomes .* geometry: broken \(torch float32: not finite\)"):
        runner.run_stability(tmp_path, None, True, console())
    assert "| broken | value | **wrong**: not finite, " in (tmp_path / runner.PAGE).read_text()


def test_an_interrupt_leaves_whole_groups_and_the_rows_so_far(few, tmp_path):
    few["compositing"].append(replace(few["compositing"][0], name="endless", truth=None))

    def interrupt(setting):
        raise KeyboardInterrupt

    few["compositing"][1] = replace(few["compositing"][1], compute=interrupt)
    said = console()
    with pytest.raises(KeyboardInterrupt):
        runner.run_stability(tmp_path, None, True, said)
    text = said.export_text()
    assert "Stopped in group compositing" in text
    commands = [line.split("--only ")[1] for line in text.splitlines() if line.startswith("  freqgs stability")]
    assert commands == [f"{name} --quick" for name in runner.GROUPS[1:]], "all that is not finished, as it was begun"
    assert list(json.loads((tmp_path / runner.JSON).read_text())["groups"]) == ["geometry"]
    rows = [json.loads(line) for line in (tmp_path / runner.ROWS).read_text().splitlines()]
    assert [row["case"] for row in rows] == ["doubled", "doubled", "one", "one"]
    assert not list(tmp_path.glob("*.part"))


def test_cells_name_what_went_wrong():
    row = replace(measure(doubled(), SINGLE), gradient_error=0.0)
    assert cell(replace(row, milliseconds=2.04)) == "0e+00, 0e+00, 2.0 ms"
    assert cell(replace(row, milliseconds=2040.0)) == "0e+00, 0e+00, 2.0 s"
    assert cell(replace(row, outcome="zero", milliseconds=1.0)) == "zero, 1.0 ms"
    refused = measure(doubled(error=ValueError("a | b"), expected=Refused(ValueError, "a")), SINGLE)
    assert cell(refused) == "ValueError"
    assert cell(replace(refused, passed=False)) == "**wrong**: ValueError: a / b"


def test_a_group_that_quick_leaves_out_is_said_and_stays(few, tmp_path):
    runner.run_stability(tmp_path, None, False, console())
    before = json.loads((tmp_path / runner.JSON).read_text())["groups"]
    few["compositing"].clear()
    said = console()
    runner.run_stability(tmp_path, "compositing", True, said)
    assert "Left out, as all of it takes long: compositing" in said.export_text()
    assert json.loads((tmp_path / runner.JSON).read_text())["groups"] == before
