import pytest

from freqgs_plugin.apps.amount import Amount, parse_amount
from freqgs_plugin.functional.cost import RenderTime, bytes_per_gaussian


@pytest.mark.parametrize(
    ("text", "value", "unit"),
    [
        ("20000", 20_000, "Gaussians"), ("20k", 20_000, "Gaussians"), ("1.5M", 1_500_000, "Gaussians"),
        ("5MB", 5, "MB"), ("0.5 gb", 500, "MB"), ("16ms", 16, "ms"), ("0.25s", 250, "ms"), (".5mb", 0.5, "MB"),
        ("10_000", 10_000, "Gaussians"),
    ],
)  # fmt: skip
def test_forms(text, value, unit):
    assert parse_amount(text) == Amount(value, unit)


@pytest.mark.parametrize("text", ["", "many", "-3", "5 apples", "1e5", "nan", "inf", "20%", "3,000", "k"])
def test_other_forms_are_named(text):
    with pytest.raises(ValueError, match="give Gaussians"):
        parse_amount(text)


@pytest.mark.parametrize("text", ["0", "0.5", "0ms", "0MB"])
def test_nothing_is_no_budget(text):
    with pytest.raises(ValueError, match="at least one"):
        parse_amount(text)


def test_counts():
    time = RenderTime(2.0, 1e-3, 1e-6, 0.0, 0.0, ())

    def never():
        raise AssertionError("measured")

    assert parse_amount("1234").count(3, False, 100, never) == 1234
    assert parse_amount("1MB").count(2, True, 100, never) == 1_000_000 // bytes_per_gaussian("memory", 2, True)
    count = parse_amount("12ms").count(3, False, 1_000_000, lambda: time)
    assert time.milliseconds(count, 1_000_000) == pytest.approx(12, abs=2e-3)
    with pytest.raises(ValueError, match="more than the budget"):
        parse_amount("1ms").count(3, False, 100, lambda: time)
