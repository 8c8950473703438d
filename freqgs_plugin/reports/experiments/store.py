"""Finished steps on disk: one JSON file each, found again by its settings. A step that was interrupted left none."""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from freqgs_plugin.reports.bench.runner import write_all
from freqgs_plugin.reports.experiments.options import ExperimentError
from freqgs_plugin.reports.tables import finite_json
from freqgs_plugin.reports.timing import environment

_FIELDS = {"settings": dict, "seconds": (int, float), "date": str, "commit": str}
"""of every record, and their types"""


@dataclass(frozen=True)
class Store:
    """A folder of finished steps."""

    folder: Path

    def path(self, name: str, settings: dict[str, Any]) -> Path:
        """The file of a step: `name` and a hash of its settings."""
        return self.folder / f"{name}-{key(settings)}.json"

    def read(self, name: str, settings: dict[str, Any]) -> dict[str, Any] | None:
        """The record of a finished step: `result`, `seconds` and circumstances; None where it is not finished.

        Raises:
            ExperimentError: the file is damaged.
        """
        path = self.path(name, settings)
        if not path.is_file():
            return None
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(record, dict) or ("settings" in record and record.get("result") is None):
                raise ValueError("no finished step")
            missing = [name for name in (*_FIELDS, "digest") if name not in record]
            if missing:
                raise ValueError(f"without {', '.join(missing)}")
            wrong = [name for name, kind in _FIELDS.items() if not isinstance(record[name], kind)]
            if wrong:
                raise ValueError(f"{wrong[0]} is {record[wrong[0]]!r:.40}")
            if record["digest"] != key({"result": record["result"]}):
                raise ValueError("its result was changed")
            if record["settings"] != _as_json(settings):
                raise ValueError("its settings are not those of its name")
        except (ValueError, RecursionError) as error:
            raise ExperimentError(f"{path} is damaged ({error}); remove it, and the step is done again") from error
        return record

    def write(self, name: str, settings: dict[str, Any], result: Any, seconds: float) -> dict[str, Any]:
        """Save a finished step in one piece, and return its record as `read` would. Infinite numbers become null."""
        record = {**environment(), "name": name, "seconds": round(seconds, 1), "settings": settings}
        record["result"] = json.loads(json.dumps(finite_json(result), allow_nan=False))
        record["digest"] = key({"result": record["result"]})
        text = json.dumps(finite_json(record), indent=1, allow_nan=False)
        write_all({self.path(name, settings): text.encode() + b"\n"})
        return json.loads(text)


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """No other process works in `folder` meanwhile.

    Raises:
        ExperimentError: one does.
    """
    lock = FileLock(folder / "running.lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise ExperimentError(
            f"another `freqgs experiment` works in {folder}; wait until it ends, or choose another --output-dir"
        ) from error
    try:
        yield
    finally:
        lock.release()


def key(settings: dict[str, Any]) -> str:
    """Twelve hexadecimal digits that depend on the settings, not on their order."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def _as_json(settings: dict[str, Any]) -> Any:
    return json.loads(json.dumps(settings))
