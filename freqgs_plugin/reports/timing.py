"""Warm timings of the public API, and the circumstances under which they were taken."""

import os
import platform
import subprocess
import time
from collections.abc import Callable
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
    if repeats < 1:
        raise ValueError(f"repeats is {repeats}; at least one run is needed")
    for _ in range(warmup):
        function()
    durations = []
    for _ in range(repeats):
        _wait()
        start = time.perf_counter()
        function()
        _wait()
        durations.append(1000 * (time.perf_counter() - start))
    low, median, high = np.quantile(durations, (0.25, 0.5, 0.75))
    return Timing(float(median), float(low), float(high), repeats)


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
