"""Training time and events from logs as nerfstudio writes them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from freqgs_plugin.reports.report.health import _events
from freqgs_plugin.reports.report.training_log import read_log, training_seconds, understand, without_pauses
from freqgs_plugin.training.guard import FiniteGuard

TIME, ALL = "Train Iter (time)", "Eval Images Metrics Dict (all images)/"


def averaged(durations, window, first=0):
    """What nerfstudio logs of steps that took so long: float32 means over the last `window`."""
    return {
        first + i: float(np.float32(np.mean(durations[max(i - window + 1, 0) : i + 1]))) for i in range(len(durations))
    }


@given(st.lists(st.floats(0.001, 3.0), min_size=1, max_size=120), st.integers(1, 25))
def test_seconds_are_the_sums_of_the_steps_own(durations, window):
    found, problem = training_seconds([averaged(durations, window)], window)
    assert problem == "" and list(found) == list(range(len(durations)))
    np.testing.assert_allclose(list(found.values()), np.cumsum(durations), rtol=1e-5)


@given(st.integers(1, 60), st.integers(1, 60), st.integers(1, 70), st.integers(1, 25))
def test_a_continued_run_counts_what_it_kept(first, second, begin, window):
    begin = min(begin, first)
    a, b = [0.5] * first, [0.25] * second
    found, problem = training_seconds([averaged(a, window), averaged(b, window, begin)], window)
    assert problem == "" and max(found) == begin + second - 1
    assert found[begin + second - 1] == pytest.approx(0.5 * begin + 0.25 * second)


def test_a_log_that_begins_in_the_middle_or_has_gaps_tells_no_time():
    found, problem = training_seconds([averaged([1.0] * 5, 20, first=3)], 20)
    assert found == {} and "continued at step 3 from a run whose log is elsewhere" in problem
    found, problem = training_seconds([{0: 1.0, 2: 1.0}], 20)
    assert found == {} and "steps missing" in problem
    assert training_seconds([{}], 20)[1] == "has a log without times of steps"


def test_a_stopped_process_is_no_training():
    durations = [0.1] * 50
    durations[20] = 300.0
    # a slow step is one, as long as it is one
    durations[30] = 5.0
    total, _ = training_seconds([averaged(durations, 20)], 20)
    kept, (stopped, seconds) = without_pauses(total)
    assert stopped == 1 and seconds == pytest.approx(299.9, rel=1e-3)
    assert kept[49] == pytest.approx(0.1 * 49 + 5.0, rel=1e-3)
    assert without_pauses({}) == ({}, (0, 0.0))


def test_evaluations_stand_at_the_training_time_of_their_step():
    part = {TIME: averaged([0.1] * 10, 4), ALL + "psnr": {4: 20.0, 9: 25.0}, ALL + "ssim": {4: 0.5, 9: 0.75}}
    log = understand([part], 4)
    assert [(e.step, e.psnr, e.ssim) for e in log.evaluations] == [(4, 20.0, 0.5), (9, 25.0, 0.75)]
    assert [e.seconds for e in log.evaluations] == pytest.approx([0.5, 1.0])
    assert log.missing == "" and log.seconds == pytest.approx(1.0) and log.last_step == 9
    # evaluated at 9, and done again from 6 on
    again = understand([part, {TIME: averaged([0.1] * 2, 4, 6), ALL + "psnr": {7: 24.0}, ALL + "ssim": {7: 0.7}}], 4)
    assert [(e.step, e.psnr) for e in again.evaluations] == [(4, 20.0), (7, 24.0)]


def test_without_evaluations_it_is_said_what_would_make_them(tmp_path):
    remedy = "--vis tensorboard --steps-per-eval-all-images"
    missing = understand([{TIME: averaged([0.1] * 3, 4)}], 4).missing
    assert missing.startswith("was not evaluated") and remedy in missing
    missing = read_log(tmp_path, 20).missing
    assert missing.startswith("has no tensorboard log") and remedy in missing
    (tmp_path / "events.out.tfevents.0").mkdir()
    assert read_log(tmp_path, 20).missing == missing
    (tmp_path / "events.out.tfevents.1").write_bytes(bytes(range(256)) * 8)
    damaged = read_log(tmp_path, 20).missing
    assert "nothing can be read" in damaged and remedy in damaged


def test_what_was_not_finite_is_told_with_its_first_step():
    skipped = "Train Metrics Dict/skipped_steps"
    log = understand([{"Train Loss": {0: 1.0, 10: math.nan, 20: math.inf}, skipped: {0: 0.0, 10: 2.0, 20: 3.0}}], 20)
    assert log.non_finite == {"Train Loss": 10} and (log.skipped, log.first_skipped) == (3, 10)
    old, new = FiniteGuard(), FiniteGuard()
    old.load_state(None)
    found = _events(old, log)
    assert (found["skipped_steps"], found["first_step"], found["exact"]) == (3, 10, False)
    new.check({"means": torch.ones(2, 3, requires_grad=True)}, torch.ones(2), 6)
    new.note_losses({"dft": torch.tensor(math.nan)})
    new.check({"means": torch.ones(2, 3, requires_grad=True)}, torch.ones(2), 7)
    found = _events(new, log)
    assert (found["skipped_steps"], found["first_step"], found["exact"]) == (1, 7, True) and "loss dft" in found["what"]
    assert _events(old, understand([{TIME: {0: 1.0}}], 20))["skipped_steps"] is None


def test_a_log_that_was_cut_off_is_read_up_to_there(tmp_path):
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(tmp_path)) as writer:
        for step, mean in averaged([0.1] * 30, 20).items():
            writer.add_scalar(TIME, mean, step)
            if step % 10 == 9:
                writer.add_scalar(ALL + "psnr", 20 + step, step)
                writer.add_scalar(ALL + "ssim", 0.5, step)
    (path,) = tmp_path.glob("events*")
    assert [e.step for e in read_log(tmp_path, 20).evaluations] == [9, 19, 29]
    path.write_bytes(path.read_bytes()[:-60])
    log = read_log(tmp_path, 20)
    assert [e.step for e in log.evaluations] == [9, 19] and log.evaluations[1].seconds == pytest.approx(2.0, rel=1e-4)
