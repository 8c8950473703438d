import pytest
import torch

from freqgs_plugin.training import densify
from freqgs_plugin.training.densify import LevelStrategy, add_level
from freqgs_plugin.training.schedule import Schedule

SCHEDULE = Schedule(
    num_levels=3, level_interval=100, refine_every=10, refine_start=0, refine_stop=1000, refine_pause=5,
    reset_every=50, reset_pause=0, reset_stop=900, screen_size_stop=0, sh_interval=100,
)  # fmt: skip


def scene(level, opacity=0.5):
    n = len(level)
    generator = torch.Generator().manual_seed(0)
    params = torch.nn.ParameterDict(
        {
            # the index of a Gaussian is its first coordinate: it shows who came from whom
            "means": torch.cat([torch.arange(n)[:, None].float(), torch.rand(n, 2, generator=generator)], 1),
            "scales": torch.full((n, 3), 1e-3).log(),
            "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
            "opacities": torch.full((n, 1), opacity).logit(),
        }
    )
    optimizers = {name: torch.optim.Adam([p], lr=1e-3) for name, p in params.items()}
    sum((p**2).sum() for p in params.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad()
    state = {"scene_scale": 1.0, "grad2d": None, "count": None, "radii": None, "level": torch.tensor(level)}
    return params, optimizers, state


def info(grads, width=100, height=50):
    grads = torch.tensor(grads)[None]
    means2d = torch.zeros_like(grads)
    means2d.absgrad = grads
    return {
        "means2d": means2d,
        "radii": torch.ones(grads.shape[:2], dtype=torch.int32),
        "width": width,
        "height": height,
    }


def strategy(**changes):
    return LevelStrategy(**{**dict(absgrad=True, grow_grad2d=0.5, prune_opa=0.1, lower_prune_opa=0.1), **changes})


def parents(params):
    return params["means"][:, 0].round().int().tolist()


def test_statistics_are_gsplats():
    """In units of half the image, averaged over the steps that saw the Gaussian."""
    state = scene([1, 1])[2]
    s = strategy()
    s.observe(state, info([[0.01, 0.0], [0.0, 0.02]]), None)
    seen_once = info([[0.03, 0.0], [0.0, 0.0]])
    seen_once["radii"][0, 1] = 0
    s.observe(state, seen_once, None)
    torch.testing.assert_close(state["grad2d"] / state["count"], torch.tensor([0.02 * 50, 0.02 * 25]))


@pytest.mark.parametrize("weighted", [False, True])
def test_compiled_statistics_are_those_in_torch(weighted, assert_close):
    generator = torch.Generator().manual_seed(3)
    grads, weight = torch.randn(700, 2, generator=generator), torch.rand(700, generator=generator) + 0.1
    radii = torch.randint(-1, 40, (700,), generator=generator, dtype=torch.int32).clamp_min(0)
    state = {"grad2d": None, "count": None, "radii": None}
    expected = [torch.zeros(700, dtype=torch.float64) for _ in range(3)]
    for scale in (1.0, 0.3):
        seen = info([[0.0, 0.0]])
        seen["means2d"].absgrad, seen["radii"] = (scale * grads)[None], (scale * radii).int()[None]
        strategy().observe(state, seen, weight if weighted else None)
        double = weight.double() if weighted else None
        densify._observe_in_torch((scale * grads).double(), double, (scale * radii).int(), 100, 50, *expected)
    for name, value in zip(("grad2d", "count", "radii"), expected, strict=True):
        assert_close(state[name], value, message=name)


def test_loss_weights_are_taken_out():
    state = scene([1, 2])[2]
    strategy().observe(state, info([[0.001, 0.0], [0.01, 0.0]]), torch.tensor([0.1, 1.0]))
    torch.testing.assert_close(state["grad2d"], torch.tensor([0.5, 0.5]))


def test_children_inherit_their_level():
    params, optimizers, state = scene([1, 2, 3])
    s = strategy()
    s.observe(state, info([[0.1, 0.0], [0.0, 0.0], [0.1, 0.0]]), None)
    done = s.step(params, optimizers, state, 210, SCHEDULE)
    assert done["duplicated"] == 2
    assert dict(zip(parents(params), state["level"].tolist(), strict=True)) == {0: 1, 1: 2, 2: 3}
    assert sorted(state["level"].tolist()) == [1, 1, 2, 3, 3]
    for name, p in params.items():
        assert optimizers[name].param_groups[0]["params"] == [p] and len(p) == 5


def test_large_ones_are_split():
    params, optimizers, state = scene([1, 2])
    with torch.no_grad():
        params["scales"][1] = 0.0
    s = strategy(prune_scale3d=10.0)
    s.observe(state, info([[0.0, 0.0], [0.1, 0.0]]), None)
    done = s.step(params, optimizers, state, 110, SCHEDULE)
    assert done["split"] == 1 and sorted(state["level"].tolist()) == [1, 2, 2]


def test_only_the_newest_level_grows():
    params, optimizers, state = scene([1, 2, 3])
    s = strategy(growth="newest")
    s.observe(state, info([[0.1, 0.0]] * 3), None)
    assert s.step(params, optimizers, state, 210, SCHEDULE)["duplicated"] == 1
    assert sorted(state["level"].tolist()) == [1, 2, 3, 3]


def test_prune_thresholds_by_level_and_no_level_dies_out():
    params, optimizers, state = scene([1, 1, 2, 2, 2])
    with torch.no_grad():
        params["opacities"][:] = torch.tensor([0.05, 0.001, 0.05, 0.06, 0.5])[:, None].logit()
    s = strategy(lower_prune_opa=0.01)
    s.observe(state, info([[0.0, 0.0]] * 5), None)
    assert s.step(params, optimizers, state, 110, SCHEDULE)["pruned"] == 3
    assert parents(params) == [0, 4]
    with torch.no_grad():
        params["opacities"][:] = -10.0
    s.step(params, optimizers, state, 120, SCHEDULE)
    assert state["level"].tolist() == [1, 2]


@pytest.mark.parametrize(
    "opacities, left",
    [
        # half of the highest is 0.45: 0.22 holds
        ([0.05, 0.12, 0.21, 0.23, 0.9], [3, 4]),
        # half of the highest is 0.15
        ([0.05, 0.12, 0.16, 0.21, 0.3], [2, 3, 4]),
        # as after a reset: half of the highest is under what the newest level needs
        ([0.05, 0.12, 0.16, 0.17, 0.19], [1, 2, 3, 4]),
    ],
)
def test_lower_levels_stay_where_all_of_them_are_faint(opacities, left):
    params, optimizers, state = scene([1] * 5 + [2])
    with torch.no_grad():
        params["opacities"][:] = torch.tensor([*opacities, 0.99])[:, None].logit()
    s = strategy(lower_prune_opa=0.22)
    s.observe(state, info([[0.0, 0.0]] * 6), None)
    s.step(params, optimizers, state, 110, SCHEDULE)
    assert parents(params) == [*left, 5]


def test_reset_clamps_opacities_and_forgets_their_momentum():
    params, optimizers, state = scene([1, 2], opacity=0.9)
    s = strategy(reset_levels="newest")
    assert s.step(params, optimizers, state, 150, SCHEDULE) == {"reset": 1}
    opacity = torch.sigmoid(params["opacities"][:, 0]).detach()
    assert opacity[0] > 0.85 and float(opacity[1]) == pytest.approx(0.2)
    momentum = optimizers["opacities"].state[params["opacities"]]["exp_avg"][:, 0]
    assert momentum[0] != 0 and momentum[1] == 0


def test_bound_on_gaussians():
    params, optimizers, state = scene([1, 1])
    s = strategy(max_gaussians=2)
    s.observe(state, info([[0.1, 0.0]] * 2), None)
    assert s.step(params, optimizers, state, 10, SCHEDULE)["duplicated"] == 0


def test_adding_a_level_duplicates_everything_and_restarts_optimizers():
    params, optimizers, state = scene([1, 1, 2])
    strategy().observe(state, info([[0.1, 0.0]] * 3), None)
    assert add_level(params, optimizers, state, 3) == 3
    assert state["level"].tolist() == [1, 1, 2, 3, 3, 3] and state["grad2d"] is None
    for name, p in params.items():
        torch.testing.assert_close(p[:3], p[3:])
        assert not optimizers[name].state[p]


def test_a_new_level_may_start_faint():
    params, optimizers, state = scene([1, 1])
    add_level(params, optimizers, state, 2, opacity=0.1)
    torch.testing.assert_close(
        torch.sigmoid(params["opacities"][:, 0]), torch.tensor([0.5, 0.5, 0.1, 0.1]), atol=0.01, rtol=0
    )


def test_level_prune_and_reset_on_one_step():
    """Step 100 adds a level, refines and resets."""
    params, optimizers, state = scene([1, 1, 1])
    schedule = Schedule(**{**SCHEDULE.__dict__, "refine_pause": 0})
    s = strategy()
    add_level(params, optimizers, state, 2)
    s.observe(state, info([[0.1, 0.0]] * 6), None)
    with torch.no_grad():
        params["opacities"][4] = -10.0
    done = s.step(params, optimizers, state, 100, schedule)
    assert done == {"duplicated": 6, "split": 0, "pruned": 2, "reset": 10}
    assert sorted(state["level"].tolist()) == [1] * 6 + [2] * 4
    assert all(len(p) == 10 for p in params.values())


def test_what_views_hardly_show_is_dropped():
    params, optimizers, state = scene([1, 1, 2, 2, 2])
    # pixels in each of two views: little in all; much in one view; the same above level 1; in both; none
    weights = [torch.tensor([0.3, 9.0, 9.0, 5.0, 0.0]), torch.tensor([0.3, 0.0, 0.1, 5.0, 0.0])]
    assert strategy().drop_unneeded(params, optimizers, state, weights, 1.0, 2) == 3
    assert parents(params) == [1, 3] and state["level"].tolist() == [1, 2]


def test_dropping_never_empties_a_level():
    params, optimizers, state = scene([1, 1, 1, 2, 2])
    weights = [torch.tensor([5.0, 5.0, 0.0, 0.0, 0.2])] * 2
    assert strategy().drop_unneeded(params, optimizers, state, weights, 1.0, 2) == 2
    assert parents(params) == [0, 1, 4] and state["level"].tolist() == [1, 1, 2]


def test_views_that_show_next_to_nothing_drop_nothing():
    params, optimizers, state = scene([1] * 20)
    weights = [torch.tensor([5.0] + [0.0] * 19)] * 2
    assert strategy().drop_unneeded(params, optimizers, state, weights, 1.0, 2) == 0
    assert len(params["means"]) == 20


def test_a_single_view_is_enough_where_there_is_only_one():
    params, optimizers, state = scene([1, 2])
    assert strategy().drop_unneeded(params, optimizers, state, [torch.tensor([5.0, 5.0])], 1.0, 2) == 0
