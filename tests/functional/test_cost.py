import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from freqgs_plugin.functional.cost import (
    RenderTime,
    Sample,
    bytes_per_gaussian,
    calibrate,
    count_in_megabytes,
    fit_render_time,
)


class Machine:
    """A clock, and a renderer that takes `fixed + each * drawn + pixel * pixels` milliseconds on it."""

    def __init__(self, fixed=2.0, each=1e-3, pixel=0.0, bend=0.0):
        self.cost = fixed, each, pixel
        self.bend, self.now, self.calls = bend, 0.0, []

    def clock(self):
        return self.now

    def render(self, count, size):
        pixels = round(10_000 * size * size)
        fixed, each, pixel = self.cost
        self.calls.append((count, size))
        self.now += (fixed + each * count + self.bend * count**2 + pixel * pixels) / 1e3
        return count, pixels


@pytest.mark.parametrize("degree, floats", [(0, 14), (1, 23), (2, 38), (3, 59), (4, 86)])
def test_bytes_are_the_floats(degree, floats):
    assert bytes_per_gaussian("memory", degree) == 4 * floats
    assert bytes_per_gaussian("ply", degree) == 4 * (floats + 3)
    assert bytes_per_gaussian("ply", degree, decay=True) == 4 * (floats + 4)
    assert bytes_per_gaussian("splat", degree) == 32


def test_megabytes():
    assert count_in_megabytes(2.48, 248) == 10_000
    assert count_in_megabytes(248e-6, 248) == 1


@pytest.mark.parametrize("megabytes", [0, -1, math.nan, math.inf])
def test_megabytes_that_are_no_budget(megabytes):
    with pytest.raises(ValueError, match=r"the budget is .* MB; it must be a positive"):
        count_in_megabytes(megabytes, 248)


def test_too_few_bytes_name_the_least():
    with pytest.raises(ValueError, match=r"less than one Gaussian takes \(248 bytes\); give at least 0.000248 MB"):
        count_in_megabytes(1e-4, 248)


def test_unknown_storage_is_refused():
    with pytest.raises(ValueError, match="choose memory, ply or splat"):
        bytes_per_gaussian("spz", 3)  # pyright: ignore


def test_calibration_finds_the_costs():
    machine = Machine(fixed=2.0, each=1e-3)
    found = calibrate(machine.render, 10_000, clock=machine.clock)
    assert found.fixed == pytest.approx(2.0) and found.per_gaussian == pytest.approx(1e-3) and found.per_pixel == 0
    assert found.residual < 1e-9 and found.held_out_error < 1e-9
    assert {count for count, _ in machine.calls} == {625, 1250, 2500, 5000, 7500, 10_000}
    assert found.count(7.0, 10_000) == pytest.approx(5000, abs=1)


def test_calibration_with_pixels():
    machine = Machine(fixed=1.0, each=2e-3, pixel=3e-4)
    found = calibrate(machine.render, 4_000, sizes=(1.0, 0.5), clock=machine.clock)
    assert found.per_pixel == pytest.approx(3e-4) and found.fixed == pytest.approx(1.0)
    assert found.milliseconds(1000, 2500) == pytest.approx(1.0 + 2.0 + 0.75)


def test_held_out_pictures_tell_that_the_model_is_wrong():
    machine = Machine(fixed=0.1, each=0, bend=1e-6)
    found = calibrate(machine.render, 10_000, clock=machine.clock)
    assert found.held_out_error > 0.3
    # the figure is the largest of the held-out errors
    held = [s for s in found.samples if s.drawn in (1250, 7500)]
    errors = [abs(found.milliseconds(s.drawn, s.pixels) / s.milliseconds - 1) for s in held]
    assert found.held_out_error == pytest.approx(max(errors))


def test_one_slow_picture_in_five_does_not_count():
    machine = Machine()
    hiccups = iter([0, 0, 0, 500, 0, 0] * 6)

    def render(count, size):
        machine.now += next(hiccups) / 1e3
        return machine.render(count, size)

    assert calibrate(render, 10_000, clock=machine.clock).held_out_error < 1e-9


def test_no_cost_is_negative():
    times = (5.0, 4.5, 4.0)
    samples = [Sample(n, 10, t) for n, t in zip((100, 1000, 10_000), times, strict=True)]
    found = fit_render_time(samples)
    assert found.per_gaussian == 0
    assert math.isnan(found.held_out_error)
    # the constant of least squared relative errors
    assert found.fixed == pytest.approx(sum(1 / t for t in times) / sum(1 / t**2 for t in times), rel=1e-9)


@given(st.floats(2.1, 1e4))
def test_the_count_is_the_largest_that_fits(milliseconds):
    model = RenderTime(2.0, 1e-3, 1e-6, 0.0, 0.0, ())
    count = model.count(milliseconds, 10_000)
    assert model.milliseconds(count, 10_000) <= milliseconds + 1e-9
    assert model.milliseconds(count + 1, 10_000) > milliseconds - 1e-9


def test_time_under_the_fixed_cost_is_refused():
    model = RenderTime(2.0, 1e-3, 0.0, 0.0, 0.0, ())
    with pytest.raises(ValueError, match=r"takes 2 ms here with a single Gaussian, more than the budget of 1.5 ms"):
        model.count(1.5, 100)


@pytest.mark.parametrize("milliseconds", [0, -3, math.nan, math.inf])
def test_times_that_are_no_budget(milliseconds):
    with pytest.raises(ValueError, match=r"the budget is .* ms; it must be a positive"):
        RenderTime(2.0, 1e-3, 0.0, 0.0, 0.0, ()).count(milliseconds, 100)


def test_free_gaussians_fit_in_any_number():
    assert RenderTime(2.0, 0.0, 0.0, 0.0, 0.0, ()).count(3.0, 100) == 2**31 - 1


def test_a_renderer_that_ignores_the_count_is_refused():
    with pytest.raises(ValueError, match=r"\[7\] Gaussians tell no cost per Gaussian"):
        calibrate(lambda count, size: (7, 100), 1000, repeats=1)


def test_it_says_what_it_found():
    text = str(RenderTime(2.0, 1e-3, 1e-6, 0.012, 0.034, ()))
    assert text == (
        "2 ms + 1e+03 ms per million Gaussians + 1 ms per million pixels (fitted to 1%, off by up to 3% elsewhere)"
    )
