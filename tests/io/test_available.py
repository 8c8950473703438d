"""The memory that is left is the least of what the machine and the control groups allow."""

import psutil
import pytest

from freqgs_plugin.io import available
from freqgs_plugin.io.available import available_memory, group_rooms


def group(folder, names, bound, used, cache):
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in zip(names, (bound, used), strict=True):
        (folder / name).write_text(f"{value}\n")
    (folder / "memory.stat").write_text(f"anon 5\ninactive_file {cache}\ntotal_inactive_file {cache}\n")


V2, V1 = ("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")


@pytest.mark.parametrize(
    ("lines", "rooms"),
    [
        ("0::/user/job\n", [700, 1_500]),
        ("0::/user/free\n", [1_500]),
        ("0::/a/host/name/that/is/not/here\n", []),
        ("5:cpu:/x\n4:memory,hugetlb:/old\n", [50]),
        ("5:cpu:/user/job\n", []),
    ],
)
def test_rooms_of_groups_and_of_those_above(tmp_path, lines, rooms):
    top = tmp_path / "cgroup"
    group(top / "user" / "job", V2, 1_000, 500, 200)
    group(top / "user" / "free", V2, "max", 500, 200)
    group(top / "user", V2, 2_000, 600, 100)
    group(top / "memory" / "old", V1, 100, 80, 30)
    (tmp_path / "own").write_text(lines)
    assert group_rooms(top, tmp_path / "own") == rooms


def test_a_group_at_its_bound_has_no_room_and_no_debt(tmp_path):
    group(tmp_path / "top", V2, 100, 150, 0)
    (tmp_path / "own").write_text("0::/\n")
    assert group_rooms(tmp_path / "top", tmp_path / "own") == [0]


def test_systems_without_groups(tmp_path):
    assert group_rooms(tmp_path, tmp_path / "missing") == []


def test_the_least_counts(monkeypatch):
    assert 0 < available_memory() <= psutil.virtual_memory().total
    monkeypatch.setattr(available, "group_rooms", lambda: [12, 5])
    assert available_memory() == 5
