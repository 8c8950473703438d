import copy

import pytest
import torch

from freqgs_plugin.studio.outputs import LazyOutputs


class Counter:
    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        assert not torch.is_grad_enabled()
        return torch.full((2,), float(self.calls))


@pytest.fixture
def later():
    return Counter()


@pytest.fixture
def outputs(later):
    return LazyOutputs({"rgb": torch.zeros(2)}, {"prefix_1": later})


def test_names_cost_nothing(outputs, later):
    assert list(outputs) == list(outputs.keys()) == ["rgb", "prefix_1"]
    assert "prefix_1" in outputs and "prefix_2" not in outputs and len(outputs) == 2
    assert later.calls == 0


def test_a_value_is_made_once(outputs, later):
    first = outputs["prefix_1"]
    assert outputs["prefix_1"] is first and outputs.get("prefix_1") is first
    assert later.calls == 1


@pytest.mark.parametrize(
    "read",
    [
        lambda o: dict(o.items()),
        lambda o: dict(zip(o.keys(), o.values(), strict=True)),
        lambda o: {name: o.get(name) for name in o},
        dict,
        lambda o: {**o},
        lambda o: {} | {name: o[name] for name in sorted(o)},
    ],
)
def test_every_way_to_read_makes_it(outputs, later, read):
    assert torch.equal(read(outputs)["prefix_1"], torch.ones(2))
    assert later.calls == 1


def test_what_is_set_replaces_what_would_be_made(outputs, later):
    outputs["prefix_1"] = 3
    assert outputs["prefix_1"] == 3 and later.calls == 0


def test_missing_names(outputs):
    assert outputs.get("nothing") is None and outputs.get("nothing", 5) == 5
    with pytest.raises(KeyError):
        outputs["nothing"]


def test_a_failure_is_not_kept_as_a_value(later):
    def fail():
        raise RuntimeError("no")

    outputs = LazyOutputs({}, {"broken": fail})
    with pytest.raises(RuntimeError):
        outputs["broken"]
    with pytest.raises(RuntimeError):
        outputs["broken"]


def test_a_copy_holds_values(outputs):
    assert torch.equal(copy.copy(outputs)["prefix_1"], torch.ones(2))
    assert torch.equal(outputs.copy()["prefix_1"], torch.ones(2))


def test_numbers_are_noted_when_a_value_is_made():
    notes = {}

    def note():
        notes["count"] = 3.0
        return torch.zeros(2)

    outputs = LazyOutputs({}, {"detail_2": note}, notes)
    assert outputs.notes == {}
    outputs["detail_2"]
    assert outputs.notes == {"count": 3.0} and list(outputs) == ["detail_2"]
    assert LazyOutputs({}, {}).notes == {}
