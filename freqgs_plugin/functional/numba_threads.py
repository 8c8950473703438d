"""Compiled kernels and the threads that they run on. Take `njit` and `prange` from here: importing this chooses both.

Viewer and training are two threads that render at the same time. numba's `workqueue` layer aborts the process then, and
`omp` (GNU OpenMP) kills a child that is forked after first use; `tbb` allows both. The `tbb` wheel puts its library
where the dynamic linker does not look, so numba alone would not find it: it is loaded by path here.
"""

import ctypes
import inspect
import os
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, files
from typing import Any

import numba
from numba import prange
from numba.core import event
from rich.console import Console

__all__ = ["check_layer", "njit", "prange"]

_LIBRARIES = ("libtbb.so.12", "libtbb.12.dylib", "tbb12.dll")


def njit(**options: Any) -> Callable[[Any], Any]:
    """numba's `njit`, without the wrapper that the tests' run-time type checker puts round every function."""
    return lambda function: numba.njit(**options)(inspect.unwrap(function))


class _Announcement(event.Listener):
    """Says once per process that kernels are being compiled: the first run on a machine would seem to hang."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Any) -> None:
        module = event.data["dispatcher"].py_func.__module__
        if not self._said and module.startswith("freqgs_plugin."):
            self._said = True
            Console(stderr=True).print(
                "Compiling CPU kernels: half a minute, once. Later starts load them from numba's cache."
            )

    def on_end(self, event: Any) -> None:
        """Nothing: each kernel ends by itself, and training's own output follows."""


def _load_tbb() -> bool:
    """Load the library of the installed `tbb` distribution; False where there is none for this machine."""
    try:
        candidates = [f for f in files("tbb") or [] if f.name in _LIBRARIES]
    except PackageNotFoundError:
        return False
    for candidate in candidates:
        try:
            ctypes.CDLL(str(candidate.locate().resolve()), mode=ctypes.RTLD_GLOBAL)  # pyright: ignore
        except OSError:
            continue
        return True
    return False


def _choose_layer() -> None:
    """Ask numba for a thread-safe layer: tbb, or else omp. NUMBA_THREADING_LAYER wins.

    tbb is out of reach where another package has loaded its own old copy before (open3d and pymeshlab do); numba warns.
    """
    if "NUMBA_THREADING_LAYER" not in os.environ:
        _load_tbb()
        numba.config.THREADING_LAYER = "threadsafe"  # pyright: ignore


def check_layer() -> str:
    """Name of the layer in use, after the first parallel kernel ran.

    Raises:
        RuntimeError: it is the one that aborts when two threads render.
    """
    layer = numba.threading_layer()
    if layer == "workqueue":
        raise RuntimeError(
            "numba runs on its 'workqueue' threading layer, which aborts the process when two threads render at once. "
            "Install tbb (`pip install tbb`) and unset NUMBA_THREADING_LAYER, or use the torch rasterizer."
        )
    return layer


_choose_layer()
event.register("numba:compile", _Announcement())
