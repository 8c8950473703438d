import io

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from freqgs_plugin.io.packed import constant_rows, needed_degree, pack, packing_order, unpack


def state_of(degrees, highest=3, seed=0):
    """A model's state of Gaussians that need these degrees, rows as they come."""
    generator = torch.Generator().manual_seed(seed)
    n = len(degrees)
    rest = torch.randn(n, (highest + 1) ** 2 - 1, 3, generator=generator)
    for row, degree in enumerate(degrees):
        rest[row, (degree + 1) ** 2 - 1 :] = 0
    state = {
        "level": torch.randint(1, 4, (n,), generator=generator).int(),
        "gauss_params.means": torch.randn(n, 3, generator=generator),
        "gauss_params.features_rest": rest,
        "gauss_params.opacities": torch.full((n, 1), 0.25),
        "_extra_state": {"step": 3},
    }
    order = packing_order(rest)
    return {name: value[order] if isinstance(value, torch.Tensor) else value for name, value in state.items()}


def size(state):
    file = io.BytesIO()
    torch.save(state, file)
    return len(file.getvalue())


def equal(a, b):
    return a.keys() == b.keys() and all(
        torch.equal(a[k], b[k]) and a[k].dtype == b[k].dtype if isinstance(a[k], torch.Tensor) else a[k] == b[k]
        for k in a
    )


@given(st.lists(st.integers(0, 3), min_size=0, max_size=12), st.integers(0, 99))
def test_what_is_packed_comes_back(degrees, seed):
    state = state_of(degrees, seed=seed)
    assert equal(unpack(pack(state)), state)
    named = {f"_model.{name}": value for name, value in pack(state).items()}
    assert equal({name.removeprefix("_model."): v for name, v in unpack(named, "_model.").items()}, state)


def test_it_comes_back_from_a_file_smaller():
    state = state_of([0] * 400 + [3] * 20)
    file = io.BytesIO()
    torch.save(pack(state), file)
    file.seek(0)
    assert equal(unpack(torch.load(file, weights_only=True)), state)
    assert size(pack(state)) < 0.2 * size(state)
    assert constant_rows(state) == ["opacities"]


def test_degree_0_has_nothing_to_pack():
    state = state_of([0, 0], highest=0)
    assert needed_degree(state["gauss_params.features_rest"]).tolist() == [0, 0]
    assert equal(unpack(pack(state)), state)


def test_another_order_is_refused():
    state = state_of([3, 1, 2])
    state["gauss_params.features_rest"] = state["gauss_params.features_rest"].flip(0)
    with pytest.raises(ValueError, match="packing_order"):
        pack(state)


@pytest.mark.parametrize(
    "spoil", [lambda p: p.pop("packed_rest.1"), lambda p: p.update({"packed_rest.2": torch.ones(1, 4, 3)})]
)
def test_damage_is_said(spoil):
    packed = pack(state_of([3, 2, 1]))
    spoil(packed)
    with pytest.raises(ValueError, match="The checkpoint is damaged"):
        unpack(packed)


def test_levels_beyond_a_byte_stay():
    state = state_of([1, 0])
    state["level"] = torch.tensor([1, 300], dtype=torch.int32)
    assert equal(unpack(pack(state)), state)
