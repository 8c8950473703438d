"""Filters by name, and from a file of one's own."""

import pytest
import torch

from freqgs_plugin.apps.filters import xray
from freqgs_plugin.apps.own_filters import filter_file, filter_label, find_filter
from freqgs_plugin.types import Gaussians

OWN = """
from dataclasses import replace

def dim(gaussians):
    return replace(gaussians, opacities=gaussians.opacities * 0.5)

def broken(gaussians):
    return gaussians.colour

def nothing(gaussians):
    return None

number = 3
"""


@pytest.fixture
def gaussians():
    n = 6
    return Gaussians(
        torch.zeros(n, 3), torch.ones(n, 4), torch.ones(n, 3), torch.full((n,), 0.8), torch.zeros(n, 3),
        torch.zeros(n, 0, 3), torch.arange(n) % 3 + 1,
    )  # fmt: skip


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN)
    return path


def test_by_name_and_from_a_file(gaussians, file):
    assert torch.equal(find_filter("xray")(gaussians).features_dc, xray(gaussians).features_dc)
    assert torch.equal(find_filter(f"{file}:dim")(gaussians).opacities, torch.full((6,), 0.4))
    assert filter_file(f"{file}:dim") == file and filter_file("xray") is None
    assert filter_label(f"{file}:dim") == "dim" and filter_label("xray") == "xray"


def test_what_is_no_filter_is_said(gaussians, file, tmp_path):
    with pytest.raises(ValueError, match="filter is 'pencil'; choose xray, brush, sharp, or FILE"):
        find_filter("pencil")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        find_filter(f"{tmp_path}/nowhere.py:dim")
    for name in ("missing", "number"):
        with pytest.raises(ValueError, match=f"has no function '{name}'"):
            find_filter(f"{file}:{name}")
    with pytest.raises(ValueError, match=r"failed: AttributeError: .*colour"):
        find_filter(f"{file}:broken")(gaussians)
    with pytest.raises(ValueError, match="returned NoneType; it must return Gaussians"):
        find_filter(f"{file}:nothing")(gaussians)
    file.write_text("import nothing_of_this_name")
    with pytest.raises(ValueError, match="cannot be run: ModuleNotFoundError"):
        find_filter(f"{file}:dim")
