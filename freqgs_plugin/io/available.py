"""How much memory this process may still take: a container's bound counts as well as the machine's."""

from pathlib import Path

import psutil

# folder below the control groups' own, bound, use, and what of the use is only cache
_VERSIONS = {
    2: ("", "memory.max", "memory.current", "inactive_file"),
    1: ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def available_memory() -> int:
    """Bytes that the system can give without swapping, or that the control groups (containers) still allow, if less."""
    return min([psutil.virtual_memory().available, *group_rooms()])


def group_rooms(groups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> list[int]:
    """Bytes that each bounded control group of this process still allows; none where there are none.

    Args:
        groups: where the groups are mounted.
        own: the file that names this process's groups.
    """
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return []
    rooms = []
    for number, kinds, name in (line.split(":", 2) for line in lines):
        if number == "0" or "memory" in kinds.split(","):
            below, *files = _VERSIONS[2 if number == "0" else 1]
            top = groups / below
            folder = top / name.lstrip("/")
            # in a container the name may be the host's, of which only the top is there
            for group in [folder, *(p for p in folder.parents if p == top or top in p.parents)]:
                room = _room(group, *files)
                if room is not None:
                    rooms.append(room)
    return rooms


def _room(group: Path, bound: str, use: str, cache: str) -> int | None:
    """None: no such group, or one without a bound."""
    try:
        most, used = (group / bound).read_text().strip(), int((group / use).read_text())
        counts = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except OSError:
        return None
    return None if most == "max" else max(int(most) - used + int(counts.get(cache, 0)), 0)
