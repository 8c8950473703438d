import pytest

from freqgs_plugin.training.schedule import Schedule, scaled


def schedule(**changes):
    values = dict(
        num_levels=3, level_interval=250, refine_every=100, refine_start=50, refine_stop=3000, refine_pause=130,
        reset_every=300, reset_pause=60, reset_stop=2500, screen_size_stop=400, sh_interval=100,
    )  # fmt: skip
    return Schedule(**{**values, **changes})


def test_stages_begin_every_interval():
    s = schedule()
    assert [s.stage(step) for step in (0, 249, 250, 499, 500, 2999)] == [1, 1, 2, 2, 3, 3]
    assert [s.halvings(m) for m in (1, 2, 3)] == [2, 1, 0]
    assert schedule(multiresolution=False).halvings(1) == 0


def test_refinement_pauses_after_a_new_level_and_after_a_reset():
    s = schedule()
    steps = [step for step in range(0, 1200) if s.refines(step)]
    # 300: 50 steps after level 2 began and a reset; 600: reset; 900: reset
    assert steps == [100, 200, 400, 500 + 200, 800, 1000, 1100]


def test_resets_stop_before_the_end():
    s = schedule()
    assert [step for step in range(3001) if s.resets(step)] == [300, 600, 900, 1200, 1500, 1800, 2100, 2400]
    assert s.refines(2700) and s.refines(2900) and not s.refines(3000)


def test_sh_degree_grows_to_its_maximum():
    assert [schedule().sh_degree(step, 3) for step in (0, 99, 100, 250, 2000)] == [0, 0, 1, 2, 3]


@pytest.mark.parametrize(
    ("steps", "scale", "least", "expected"), [(2500, 0.1, 1, 250), (100, 0.1, 50, 50), (5, 0.01, 1, 1)]
)
def test_scaled(steps, scale, least, expected):
    assert scaled(steps, scale, least) == expected


def test_views_are_looked_at_on_resets_and_when_refinement_ends():
    assert [step for step in range(3500) if schedule().looks_at_views(step)] == [*range(300, 3000, 300), 3000]


def test_opacities_recover_after_each_reset():
    s = schedule(reset_stop=700)
    # step 300 itself trains before its reset, but is counted with it
    assert [step for step in range(3000) if s.recovers(step)] == [*range(300, 361), *range(600, 661)]
    assert not any(schedule(reset_stop=100).recovers(step) for step in range(3000))
