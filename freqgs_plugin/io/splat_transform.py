"""PlayCanvas's `splat-transform`, where it is installed: SPZ files and streamed SOGs."""

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from freqgs_plugin.io.ply import SplatFileError

NAME = "splat-transform"
INSTALL = "npm install -g @playcanvas/splat-transform"
_SECONDS = 1800


def find_tool() -> str | None:
    """The program on the PATH; None where there is none."""
    return shutil.which(NAME)


def run_tool(*arguments: str | Path, folder: Path | None = None) -> None:
    """Run it in `folder`.

    Raises:
        SplatFileError: it is not installed, or it failed; the message holds what it said last.
    """
    tool = find_tool()
    if tool is None:
        raise SplatFileError(f"{NAME} is not on the PATH; install it with `{INSTALL}` (it needs node).")
    command = [tool, *map(str, arguments)]
    try:
        done = subprocess.run(
            command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_SECONDS, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise SplatFileError(f"{NAME} was stopped after {_SECONDS} s; the scene may be too large for it.") from error
    except OSError as error:
        raise SplatFileError(f"{tool} cannot be run ({error.strerror}); install it anew with `{INSTALL}`.") from error
    if done.returncode != 0:
        said = " ".join((done.stderr + done.stdout).split())[-400:]
        raise SplatFileError(f"`{NAME} {' '.join(command[1:])}` failed with status {done.returncode}: {said}")


def tool_version() -> str:
    """As the tool tells it; "unknown" where it does not."""
    tool = find_tool()
    if tool is None:
        return "not installed"
    try:
        done = subprocess.run([tool, "--version"], capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return (done.stdout + done.stderr).strip().splitlines()[-1] if (done.stdout + done.stderr).strip() else "unknown"


def finest_files(streamed: Path) -> list[Path]:
    """Of a streamed SOG, the files of its finest level of detail, which the tool reads one by one.

    Args:
        streamed: its lod-meta.json.

    Raises:
        SplatFileError: it names no such files.
    """

    def finest(node: Any) -> set[int]:
        found = {int(node["lods"]["0"]["file"])} if "0" in node.get("lods", {}) else set()
        return found.union(*(finest(child) for child in node.get("children", [])))

    try:
        content = json.loads(streamed.read_text(encoding="utf-8"))
        files = [streamed.parent / content["filenames"][index] for index in sorted(finest(content["tree"]))]
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise SplatFileError(f"{streamed} is no streamed SOG, or damaged ({error!r}); export it again.") from error
    inside = streamed.parent.resolve()
    if not files or not all(inside in file.resolve().parents and file.is_file() for file in files):
        raise SplatFileError(f"{streamed} names no files of a finest level beside it; export it again.")
    return files


def streamed_command(prefixes: Sequence[str], output: str) -> list[str]:
    """Arguments that turn complete scenes, the coarsest first, into one streamed SOG, whose level 0 is the finest.

    One round of clustering the harmonics: on a CPU the tool's ten were not done with 54,000 Gaussians in half an hour.
    """
    arguments = ["-w", "-g", "cpu", "-i", "1"]
    for lod, name in enumerate(reversed(prefixes)):
        arguments += [name, "-l", str(lod)]
    return [*arguments, output]
