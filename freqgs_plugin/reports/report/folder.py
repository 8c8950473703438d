"""The folder of a report: there as a whole, or not at all."""

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from freqgs_plugin.reports.bench.runner import check_folder
from freqgs_plugin.reports.report.options import ReportError

RECORD = "report.json"


def check_output(folder: Path) -> None:
    """Refuse a folder that a report cannot go into, before anything is measured.

    Raises:
        ReportError: it is a file, or holds other things than an earlier report, which would be lost.
        OSError: nothing can be written there; names the folder.
    """
    if folder.exists() and not folder.is_dir():
        raise ReportError(f"{folder} is a file; name a folder with --output-dir.")
    foreign = _foreign(folder) if folder.is_dir() else []
    if foreign:
        raise ReportError(
            f"{folder} holds files that are no part of an earlier report ({', '.join(foreign[:3])}). Nothing was "
            "changed. Choose another --output-dir, or move them away."
        )
    check_folder(folder)
    # the report is put together beside the folder
    check_folder(folder.resolve().parent)


def _foreign(folder: Path) -> list[str]:
    """Names in the folder that the report in it does not list."""
    try:
        ours = {*json.loads((folder / RECORD).read_text(encoding="utf-8"))["files"], RECORD}
    except (OSError, ValueError, KeyError, TypeError):
        ours = set()
    return sorted(path.name for path in folder.iterdir() if path.name not in ours)


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write all files into a new folder beside `folder`, then let it take that one's place.

    Whatever goes wrong before, nothing is left behind, and what was there stays.

    Raises:
        ReportError: `folder` has come to hold other things meanwhile.
        OSError: the disk is full, or the like; names the file.
    """
    check_output(folder)
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    new = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    old = new.with_name(new.name + "-old")
    try:
        # a temporary folder is for its owner alone
        new.chmod(0o777 & ~_umask())
        for name, contents in files.items():
            _write(new / name, contents)
        if folder.exists():
            os.replace(folder, old)
        os.replace(new, folder)
    finally:
        # an interrupt, too, may come between the two
        if old.exists() and not folder.exists():
            os.replace(old, folder)
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)


def _write(path: Path, contents: bytes) -> None:
    try:
        with path.open("wb") as file:
            file.write(contents)
            file.flush()
            # some file systems find out that they are full only here
            os.fsync(file.fileno())
    except OSError as error:
        raise OSError(error.errno, f"the report was not written ({error.strerror})", path.name) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
