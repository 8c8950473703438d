import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from freqgs_plugin.training.detail import DetailSampling, count_loss, target_share


def sampling(**changes):
    return DetailSampling(**{**dict(start=10, largest=5.0, seed=3), **changes})


class TestScales:
    def test_uniform_from_1_to_the_largest(self):
        scales = np.array([sampling().scale(step) for step in range(10, 4010)])
        assert scales.min() >= 1 and scales.max() <= 5
        shares = np.histogram(scales, bins=8, range=(1, 5))[0] / 4000
        assert np.abs(shares - 1 / 8).max() < 0.02
        # one step says nothing about the next
        assert abs(np.corrcoef(scales[:-1], scales[1:])[0, 1]) < 0.05

    def test_step_and_seed_decide(self):
        assert sampling().scale(77) == sampling().scale(77)
        assert sampling().scale(77) != sampling().scale(78)
        assert sampling().scale(77) != sampling(seed=4).scale(77)

    def test_1_before_the_start_and_while_held(self):
        assert [sampling().active(step) for step in (9, 10)] == [False, True]
        assert [sampling().scale(step) for step in range(10)] == [1.0] * 10
        assert sampling().scale(50, held=True) == 1.0

    def test_full_detail_every_so_many_steps(self):
        scales = [sampling(full_detail_every=4).scale(step) for step in range(12, 20)]
        assert [scale == 1 for scale in scales] == [True, False, False, False] * 2

    def test_largest_of_1_is_always_1(self):
        assert {sampling(largest=1.0).scale(step) for step in range(100)} == {1.0}

    @pytest.mark.parametrize(("scale", "expected"), [(1.0, 0.81), (3.0, 0.49), (5.0, 0.25)])
    def test_weight(self, scale, expected):
        """Eq. 5."""
        assert sampling().loss_weight(scale) == pytest.approx(expected)


def margins(n=40, dtype=torch.float64):
    return torch.linspace(-3, 4, n, dtype=dtype)


class TestCountLoss:
    def test_the_papers_formula(self):
        """Eq. 3 and 4: at scale 4 one in eight may be drawn."""
        assert target_share(4) == 0.125
        margin = torch.tensor([1.0, 1.0, -1.0, -1.0])
        assert float(count_loss(margin, 4.0, 5.0, "none")) == pytest.approx(9 * (0.5 - 0.125) ** 2)

    @pytest.mark.parametrize("temperature", [0.5, 3.0])
    def test_counts_exactly(self, temperature):
        margin = margins()
        expected = float(count_loss(margin, 3.0, 5.0, "none", temperature)) / 4**2
        assert float(count_loss(margin, 3.0, 5.0, "ste", temperature)) == pytest.approx(expected)
        assert float(count_loss(margin, 3.0, 5.0, "soft", temperature)) != pytest.approx(expected, rel=1e-3)

    @settings(deadline=None)
    @given(st.floats(1, 5), st.floats(1, 5))
    def test_no_penalty_for_few(self, a, b):
        low, high = sorted((a, b))
        few = torch.full((1000,), -1.0)
        few[: int(1000 * target_share(high))] = 1.0
        assert float(count_loss(few, low, 5.0)) == 0.0

    def test_gradients(self):
        """soft has that of its value; ste has the same, up to the share that it counts, for what is drawn alone."""
        margin = margins().requires_grad_()
        torch.autograd.gradcheck(lambda m: count_loss(m, 3.0, 5.0, "soft"), (margin,))
        assert not count_loss(margin, 3.0, 5.0, "none").requires_grad
        grads, excess = {}, {}
        for kind in ("soft", "ste"):
            value = count_loss(margin, 3.0, 5.0, kind)
            (grads[kind],) = torch.autograd.grad(value, margin)
            excess[kind] = float(value.detach()) ** 0.5
        drawn = margin > 0
        assert bool((grads["ste"][drawn] > 0).all()) and bool((grads["ste"][~drawn] == 0).all())
        torch.testing.assert_close(grads["ste"][drawn] / excess["ste"], grads["soft"][drawn] / excess["soft"])

    def test_descending_draws_fewer(self):
        margin = margins().requires_grad_()
        optimizer = torch.optim.Adam([margin], lr=0.1)
        first = None
        for _ in range(200):
            optimizer.zero_grad()
            count_loss(margin, 3.0, 5.0).backward()
            optimizer.step()
            share = float((margin > 0).float().mean())
            first = share if first is None else first
        assert first > 0.5 and share <= target_share(3.0)

    def test_a_wider_sigmoid_reaches_the_opaque(self):
        opaque = torch.full((10,), 5.0, requires_grad=True)
        grads = [torch.autograd.grad(count_loss(opaque, 3.0, 5.0, "ste", t), opaque)[0][0] for t in (0.5, 2.0)]
        assert grads[1] > 100 * grads[0] > 0

    @pytest.mark.parametrize("kind", ["none", "ste", "soft"])
    def test_nothing_to_say(self, kind):
        for margin, scale, largest in ((margins(), 1.0, 5.0), (margins(), 1.0, 1.0), (margins(0), 3.0, 5.0)):
            margin.requires_grad_()
            loss = count_loss(margin, scale, largest, kind)
            assert float(loss.detach()) == 0.0
            (grad,) = torch.autograd.grad(loss, margin)
            assert bool((grad == 0).all())

    @pytest.mark.parametrize("kind", ["ste", "soft"])
    def test_extreme_margins_are_finite(self, kind):
        margin = torch.tensor([-1e4, -1e30, 1e30, 0.0, 5.0]).requires_grad_()
        loss = count_loss(margin, 5.0, 5.0, kind)
        (grad,) = torch.autograd.grad(loss, margin)
        assert bool(loss.isfinite()) and bool(grad.isfinite().all())
