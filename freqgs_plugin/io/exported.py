"""Exported scenes, read back: a PLY, an SPZ or SOG through splat-transform, or the folder of levels."""

import json
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.init_source import frame_of
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.io.ply import SplatFileError, read_ply
from freqgs_plugin.io.splat_transform import finest_files, run_tool
from freqgs_plugin.io.spz import read_antialiased

MANIFEST = "manifest.json"
_BY_TOOL = (".spz", ".sog")
_STREAMED = "lod-meta.json"


@dataclass(frozen=True)
class Exported:
    """Gaussians of a file, and what is known of them."""

    path: Path
    gaussians: RawGaussians
    """in the file's frame"""
    signed_residuals: bool
    antialiased: bool | None
    """for viewers that compensate opacities; None: the file does not say"""
    frame: str | None
    """scene or dataset; None: it does not say"""
    origin: dict[str, Any] = field(default_factory=dict)
    """of the run that was exported, by `studio.origin`; empty: not known"""

    @property
    def scene(self) -> Similarity | None:
        """From the data set's frame to that of the run that was exported; None: not known.

        Raises:
            SplatFileError: the manifest is damaged.
        """
        if not self.origin:
            return None
        try:
            return frame_of(self.origin["transform"], self.origin["scale"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise SplatFileError(f"the manifest of {self.path} is damaged ({error}); export it again.") from error


def read_exported(path: Path) -> Exported:
    """Read a PLY, .spz, .sog or lod-meta.json, or a folder of levels or its manifest.

    Raises:
        FileNotFoundError: there is nothing.
        SplatFileError: it cannot be used; the message names the remedy.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; name a file or a folder that `freqgs export` wrote.")
    if path.is_dir() or path.name == MANIFEST:
        return _levels(path if path.is_dir() else path.parent)
    manifest = _manifest(path.with_name(f"{path.name}.json"))
    if path.suffix in _BY_TOOL or path.name == _STREAMED:
        if path.name == _STREAMED:
            manifest = _manifest(path.parent.parent / MANIFEST)
        with tempfile.TemporaryDirectory() as folder:
            back = Path(folder) / "back.ply"
            files = finest_files(path) if path.name == _STREAMED else [path]
            run_tool("-w", *(file.resolve() for file in files), back)
            gaussians, summary = read_ply(back)
        # a level of detail is no level of ours
        gaussians, antialiased = replace(gaussians, level=None), summary.antialiased
        if path.suffix == ".spz":
            antialiased = read_antialiased(path)
        elif manifest.get("viewer") in ("mip", "classic"):
            antialiased = manifest["viewer"] == "mip"
    else:
        gaussians, summary = read_ply(path)
        antialiased = summary.antialiased
    return Exported(path, gaussians, False, antialiased, manifest.get("frame"), manifest.get("origin", {}))


def _manifest(path: Path) -> dict[str, Any]:
    """What lies beside a file; empty where nothing does.

    Raises:
        SplatFileError: it is damaged, or not ours.
    """
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        ours = isinstance(content, dict) and str(content["format"]).startswith("freqgs ")
    except (ValueError, KeyError, OSError) as error:
        raise SplatFileError(f"{path} is damaged ({error}); export the scene again, or remove it.") from error
    if not ours or not isinstance(content.get("origin"), dict) or content.get("frame") not in ("scene", "dataset"):
        raise SplatFileError(f"{path} is no manifest of `freqgs export`; export the scene again, or remove it.")
    if content.get("version") != 1:
        raise SplatFileError(f"{path} has version {content.get('version')}, and 1 is known here; update freqgs.")
    return content


def _levels(folder: Path) -> Exported:
    """All levels together, each from its own file: as they were trained, sorted by level."""
    path = folder / MANIFEST
    manifest = _manifest(path)
    if not manifest:
        raise SplatFileError(f"{folder} holds no {MANIFEST}; name the folder `levels` that `freqgs export` wrote.")
    names, signed = manifest.get("deltas"), manifest.get("signed_residuals")
    if not isinstance(names, list) or not isinstance(signed, bool) or not any(names):
        raise SplatFileError(f"{path} names no files of levels; name the PLY or SPZ itself.")
    parts, antialiased = [], None
    for level, name in enumerate(names, start=1):
        if name is None:
            continue
        if not isinstance(name, str) or Path(name).name != name:
            raise SplatFileError(f"{path} names {name!r}, which is no file beside it; export the scene again.")
        part, summary = read_ply(folder / name)
        if part.level is None or bool((part.level != level).any()):
            raise SplatFileError(f"{folder / name} does not hold level {level}; export the scene again.")
        antialiased = summary.antialiased
        parts.append(part)
    degrees = {part.sh_degree for part in parts}
    if len(degrees) > 1:
        raise SplatFileError(f"the levels in {folder} have harmonics of degrees {sorted(degrees)}; export them again.")
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in (*GROUPS, "level")}
    return Exported(folder, RawGaussians(**joined), signed, antialiased, manifest["frame"], manifest["origin"])
