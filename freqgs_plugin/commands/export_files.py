"""Files of an export appear all at once, complete, or not at all."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from freqgs_plugin.reports.bench.runner import check_folder
from freqgs_plugin.reports.tables import finite_json


def targets(folder: Path, name: str, manifest: str) -> list[Path]:
    """What an export with the main file or folder `name` leaves in `folder`."""
    return [folder / name] if not Path(name).suffix else [folder / name, folder / f"{name}.{manifest}"]


def check_targets(paths: list[Path], overwrite: bool) -> None:
    """Refuse what is there already, and a folder that cannot be written to.

    Raises:
        FileExistsError, OSError: with the remedy.
    """
    there = [path for path in paths if path.exists()]
    if there and not overwrite:
        raise FileExistsError(f"{there[0]} exists; add --overwrite, or name another --output-dir.")
    check_folder(paths[0].parent)


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """A folder beside the targets that is gone afterwards, with all that still is in it."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix=".export-", dir=folder, ignore_cleanup_errors=True) as name:
            yield Path(name)
    finally:
        for path in missing:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def put_in_place(sources: list[Path], destinations: list[Path]) -> None:
    """Move each source to its destination; what was there is removed only once all are in place."""
    old: list[tuple[Path, Path]] = []
    placed: list[Path] = []
    try:
        for path in destinations:
            if path.exists():
                aside = path.with_name(f".{path.name}.{os.getpid()}.old")
                # noted first, for an interrupt between the two
                old.append((path, aside))
                path.rename(aside)
        for source, path in zip(sources, destinations, strict=True):
            source.rename(path)
            placed.append(path)
    except BaseException:
        for path in placed:
            _remove(path)
        for path, aside in old:
            if aside.exists():
                aside.rename(path)
        raise
    for _, aside in old:
        _remove(aside)


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def write_manifest(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(finite_json(content), indent=1, default=str, allow_nan=False) + "\n", encoding="utf-8")
