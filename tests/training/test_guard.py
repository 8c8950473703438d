import pytest
import torch

from freqgs_plugin.training.guard import FiniteGuard, NonFiniteError

LEVEL = torch.tensor([1, 1, 2])


def params(**bad):
    values = {"means": torch.zeros(3, 3), "scales": torch.zeros(3, 3)}
    for value in values.values():
        value.requires_grad_().grad = torch.ones_like(value)
    for name, row in bad.items():
        values[name].grad[row, 0] = float("nan")
    return values


def test_finite_steps_pass_and_keep_their_gradients():
    guard, p = FiniteGuard(), params()
    guard.note_losses({"image_1": torch.tensor(1.0)})
    assert guard.check(p, LEVEL, 5)
    assert p["means"].grad is not None and guard.skipped == 0 and guard.first == ""


def test_a_bad_step_loses_all_gradients_and_is_described():
    guard, p = FiniteGuard(), params(scales=2)
    assert not guard.check(p, LEVEL, 7)
    assert all(v.grad is None for v in p.values())
    assert guard.first == "step 7: not finite: gradient of 'scales' at 1 of 3 Gaussians (1 of level 2)"


def test_a_bad_loss_is_named():
    guard = FiniteGuard()
    guard.note_losses({"image_1": torch.tensor(1.0), "dft": torch.tensor(float("inf"))})
    assert not guard.check(params(), LEVEL, 0)
    assert "loss dft" in guard.first


def test_first_event_is_kept_and_a_good_step_ends_a_row():
    guard = FiniteGuard(patience=2)
    assert not guard.check(params(means=0), LEVEL, 1)
    guard.check(params(), LEVEL, 2)
    assert not guard.check(params(scales=0), LEVEL, 3)
    assert guard.skipped == 2 and "step 1" in guard.first and "means" in guard.first


def test_patience_ends():
    guard = FiniteGuard(patience=3)
    for step in (1, 2):
        guard.check(params(means=1), LEVEL, step)
    with pytest.raises(NonFiniteError, match=r"3 steps in a row .*step 1: not finite: gradient of 'means'"):
        guard.check(params(means=1), LEVEL, 3)


def test_a_continued_run_remembers_its_first_event():
    guard, again, old = FiniteGuard(), FiniteGuard(), FiniteGuard()
    guard.check(params(means=0), LEVEL, 4)
    again.load_state(guard.state())
    again.check(params(scales=1), LEVEL, 9)
    assert (again.skipped, again.first_step, again.complete) == (2, 4, True) and again.first == guard.first
    old.load_state(None)
    assert (old.skipped, old.first_step, old.complete) == (0, None, False)
    # once lost, it stays lost
    again.load_state(old.state())
    assert not again.complete
