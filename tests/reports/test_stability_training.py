"""The training group of `freqgs stability`: what counts as right, and a real child process."""

import sys

import pytest
import torch

from freqgs_plugin.reports.stability import cases_training
from freqgs_plugin.reports.stability.case import Setting
from freqgs_plugin.reports.stability.cases_training import (
    EVENT,
    STEPS,
    WINDOW,
    RehearsalError,
    TrainingCase,
    recovery,
    run_training,
)
from freqgs_plugin.reports.stability.tables import cell

SETTING = Setting("numba", torch.float32)
GOOD = {
    "losses": [0.1] * STEPS, "rmse": 0.1, "flat_rmse": 0.25, "skipped": 0, "first": "", "error": "", "seconds": 2.0,
    "gaussians": 9,
}  # fmt: skip


def row(case=None, **changes):
    return (case or TrainingCase("x", {})).row(SETTING, {**GOOD, **changes})


def test_cases_cover_rates_events_and_autocast():
    names = [case.name for case in cases_training.cases()]
    assert len(set(names)) == len(names)
    for part in (
        "x0.1",
        "x1",
        "x10",
        "x1000",
        "optimizer restart",
        "opacity reset",
        "new level",
        "bfloat16",
        "float16",
    ):
        assert any(part in name for name in names), part


def test_a_run_must_end_better_than_flat_pictures():
    good = row()
    assert good.passed and good.finite and good.value_error == 0.1 and good.milliseconds == 2000
    assert good.note == "held-out RMSE 0.100, flat 0.250; guard: silent"
    assert cell(good) == "2.0 s, held-out RMSE 0.100, flat 0.250; guard: silent"
    assert not row(rmse=0.26).passed
    assert not row(losses=[0.1, float("nan")]).passed
    skipped = row(skipped=2, first="step 7: not finite: loss dft")
    assert not skipped.passed and skipped.note.endswith("guard: 2 skipped, step 7: not finite: loss dft")


def test_a_diverging_run_may_end_with_a_named_error_only():
    case = TrainingCase("x", {}, bounded=False)
    broken = {"rmse": None, "flat_rmse": None, "losses": [0.1]}
    named = row(case, error="NonFiniteError: 10 steps in a row\nand more", **broken)
    assert named.passed and named.outcome == "NonFiniteError: 10 steps in a row" and not named.finite
    assert row(case, error="ValueError: scales of 3 Gaussians", **broken).passed
    assert not row(case, error="RuntimeError: shapes differ", **broken).passed
    assert not row(error="NonFiniteError: 10 steps", **broken).passed
    assert row(case, rmse=0.5).passed, "worse than flat, but finite"


def test_recovery_is_counted_from_the_event():
    losses = [0.2] * EVENT + [0.6] * 30 + [0.21] * (STEPS - EVENT - 30)
    before, highest, steps = recovery(losses)
    assert (before, highest) == (pytest.approx(0.2), pytest.approx(0.6))
    assert 30 - WINDOW < steps <= 30
    assert recovery([0.2] * EVENT + [0.6] * (STEPS - EVENT))[2] is None
    case = TrainingCase("x", {}, event=True, returns=True)
    assert not row(case, losses=[0.2] * EVENT + [0.6] * (STEPS - EVENT)).passed
    good = row(case, losses=losses)
    assert good.passed and f"loss 0.200 before, 0.600 after, back after {steps} steps" in good.note


def test_a_child_that_fails_is_reported_with_its_last_words(monkeypatch):
    monkeypatch.setattr(cases_training, "_call", lambda *_: None)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(RehearsalError, match=r"freqgs_plugin.studio.rehearsal ended with exit status 1"):
        next(run_training([TrainingCase("x", {})], SETTING))


@pytest.mark.slow
def test_real_runs(monkeypatch):
    """Two runs of a few steps: one as usual, one whose learning rates leave the range of float32."""
    monkeypatch.setattr(cases_training, "STEPS", EVENT + 2 * WINDOW)
    monkeypatch.setattr(cases_training, "VIEWS", 9)
    model = {"steps_scale": 0.04, "num_levels": 1}
    usual = TrainingCase("usual", {"model": model, "restart_at": 5, "autocast": "bfloat16"}, bounded=False)
    wild = TrainingCase("wild", {"model": model, "rate": 1e6}, bounded=False)
    rows = list(run_training([usual, wild], SETTING))
    assert rows[0].passed and rows[0].finite and 0 < rows[0].value_error < 0.5 and "guard: silent" in rows[0].note
    assert (
        rows[1].passed and rows[1].outcome.startswith("ValueError: scales of") and "learning rates" in rows[1].outcome
    )
