"""Warm timings of the public API, and the circumstances under which they were taken."""

import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

PACKAGES = ("freqgs-plugin", "nerfstudio", "torch", "gsplat", "numba", "numpy", "kornia")


@dataclass(frozen=True)
class Timing:
    """Repeated runs of the same work, after warming up."""

    median_ms: float
    low_ms: float
    """first quartile"""
    high_ms: float
    """third quartile"""
    repeats: int


def measure(function: Callable[[], object], repeats: int = 9, warmup: int = 2) -> Timing:
    """Time `function`; on CUDA until the device has finished.

    Raises:
        ValueError: fewer than one repeat.
    """
    return interleaved({"": function}, repeats, warmup)[""]


def interleaved(
    candidates: Mapping[str, Callable[[], object]],
    rounds: int,
    warmup: int = 1,
    on_round: Callable[[], object] = lambda: None,
) -> dict[str, Timing]:
    """Time several functions against each other: every round runs each of them once, every second round backwards.

    What slows the machine down for a while then slows all of them. `on_round` is called after each round.

    Raises:
        ValueError: fewer than one round.
    """
    if rounds < 1:
        raise ValueError(f"repeats is {rounds}; at least one run is needed")
    for function in candidates.values():
        for _ in range(warmup):
            function()
    durations: dict[str, list[float]] = {name: [] for name in candidates}
    for number in range(rounds):
        names = list(candidates)
        for name in names if number % 2 == 0 else reversed(names):
            durations[name].append(_milliseconds(candidates[name]))
        on_round()
    return {name: timing_of(times) for name, times in durations.items()}


def timing_of(milliseconds: Sequence[float]) -> Timing:
    """Median and quartiles of at least one duration, ms."""
    low, median, high = np.quantile(milliseconds, (0.25, 0.5, 0.75))
    return Timing(float(median), float(low), float(high), len(milliseconds))


def _milliseconds(function: Callable[[], object]) -> float:
    _wait()
    start = time.perf_counter()
    function()
    _wait()
    return 1000 * (time.perf_counter() - start)


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def environment() -> dict[str, Any]:
    """Date (UTC), hardware, versions and commit, for a report's JSON."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "hardware": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else None,
        },
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "commit": commit(),
    }


def commit() -> str | None:
    """The commit of this package's checkout, with a `+` where files differ from it; None outside of a checkout."""
    folder = Path(__file__).parent
    try:
        tracked = _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
        if not tracked:
            return None
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
        return _git(folder, "rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    result = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10)
    return result.stdout.strip()


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
