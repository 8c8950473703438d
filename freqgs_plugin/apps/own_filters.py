"""Filters by name, or from a file of one's own: `FILE.py:FUNCTION`."""

import runpy
from pathlib import Path

from freqgs_plugin.apps.filters import FILTERS, Filter, apply_filter
from freqgs_plugin.types import Gaussians


def find_filter(text: str) -> Filter:
    """The filter called `text`, or the function that `FILE.py:FUNCTION` names. The file is run as Python.

    What is returned refuses, with a ValueError, scenes that it cannot be applied to; of one's own filters, too.

    Raises:
        ValueError: no such filter, or the file has no such function or fails.
        FileNotFoundError: there is no such file.
    """
    file, separator, function = text.rpartition(":")
    if not separator or not file.endswith(".py"):
        if text not in FILTERS:
            raise ValueError(f"filter is '{text}'; choose {', '.join(FILTERS)}, or FILE.py:FUNCTION for one's own.")
        return lambda gaussians: apply_filter(gaussians, text)
    path = Path(file)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file; name the Python file of the filter '{function}'.")
    try:
        found = runpy.run_path(str(path)).get(function)
    except Exception as error:
        raise ValueError(f"{path} cannot be run: {type(error).__name__}: {error}") from error
    if not callable(found):
        raise ValueError(f"{path} has no function '{function}'; name one that takes Gaussians and returns Gaussians.")

    def own(gaussians: Gaussians) -> Gaussians:
        try:
            filtered = found(gaussians)
        except Exception as error:
            raise ValueError(f"filter '{text}' failed: {type(error).__name__}: {error}") from error
        if not isinstance(filtered, Gaussians):
            raise ValueError(f"filter '{text}' returned {type(filtered).__name__}; it must return Gaussians.")
        return filtered

    return own


def filter_file(text: str) -> Path | None:
    """The file that `FILE.py:FUNCTION` names; None of a filter by name."""
    file, separator, _ = text.rpartition(":")
    return Path(file) if separator and file.endswith(".py") else None


def filter_label(text: str) -> str:
    """What a filter is called above its pictures: its name, or that of its function."""
    return text.rpartition(":")[2] if filter_file(text) is not None else text
