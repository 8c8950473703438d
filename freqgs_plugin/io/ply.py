"""3DGS PLY files through plyfile: those of INRIA, nerfstudio, gsplat, SuperSplat, Brush, and ours.

Stored are raw parameters: logarithms of scales, logits of opacities, quaternions wxyz in `rot_0..3`, harmonics in
`f_dc_0..2` and, channel by channel, in `f_rest_*`. Ours adds `level` and `decay`, and a comment of the header says
whether opacities were trained with compensation: `SplatRenderMode: mip` or `default`, as Brush writes it.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyElement, PlyParseError

from freqgs_plugin.functional.harmonics import C0, MAX_DEGREE, num_coefficients
from freqgs_plugin.io.parameters import RawGaussians

_MEANS = ("x", "y", "z")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
_NORMALS = ("nx", "ny", "nz")
_REST_COUNTS = {3 * (num_coefficients(degree) - 1): degree for degree in range(MAX_DEGREE + 1)}
_ENOUGH_TO_JUDGE = 10
"""Gaussians from which on the values' ranges tell activated parameters from raw ones"""
_WRITERS = {
    "freqgs": "freqgs",
    "supersplat": "SuperSplat",
    "nerstudio": "nerfstudio",
    "nerfstudio": "nerfstudio",
    "brush": "Brush",
    "splat-transform": "splat-transform",
    "postshot": "Postshot",
}
"""what a comment holds, and which program writes it (nerfstudio misspells itself)"""


class SplatFileError(ValueError):
    """A file or run whose Gaussians cannot be used; the message names the file and the remedy."""


_LARGEST_HEADER = 1 << 20
"""bytes; a real one has a few thousand, and to parse a long one takes minutes"""
_LARGEST_LOG_SCALE = 88.0
"""whose exponential float32 still holds"""


@dataclass(frozen=True)
class PlySummary:
    """What was found in a file."""

    path: Path
    count: int
    sh_degree: int
    source: str
    """the program that probably wrote it, by comments and properties"""
    encoding: str
    """ascii, binary little endian or binary big endian"""
    antialiased: bool | None
    """trained with opacity compensation; None: the file does not say"""
    has_level: bool
    has_decay: bool
    ignored: tuple[str, ...]
    """properties and elements that were not read"""
    remarks: tuple[str, ...]
    """what looks wrong without being an error"""

    def __str__(self) -> str:
        mode = {True: "antialiased", False: "not antialiased", None: "antialiased or not: the file does not say"}
        extras = [name for name, there in (("levels", self.has_level), ("decay", self.has_decay)) if there]
        parts = [
            f"{self.path}: {self.count:,} Gaussians",
            f"SH degree {self.sh_degree}",
            *(f"with {name}" for name in extras),
            mode[self.antialiased],
            f"{self.encoding}, probably by {self.source}" if self.source != "unknown" else self.encoding,
            *([f"ignored: {', '.join(self.ignored)}"] if self.ignored else []),
        ]
        return "; ".join(parts) + "." + "".join(f" {remark}" for remark in self.remarks)


def read_ply(path: Path) -> tuple[RawGaussians, PlySummary]:
    """Read a 3DGS PLY, ascii or binary, of SH degree 0..4, with or without normals, levels and decay.

    8-bit `red`, `green`, `blue` in place of `f_dc_*` (nerfstudio's `--ply-color-mode rgb`) become constant harmonics.

    Raises:
        FileNotFoundError: there is no such file.
        SplatFileError: it is no 3DGS PLY, truncated, compressed, lacks a property, or holds values that cannot be used.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file; name a 3DGS PLY.")
    data = _parse(path)
    vertex = _vertex(path, data)
    names = vertex.dtype.names or ()
    degree = _sh_degree(path, names)
    _require(path, names, (*_MEANS, "opacity", *_SCALES, *_QUATS))
    rgb = _DC[0] not in names and set(_RGB) <= set(names)
    if not rgb:
        _require(path, names, _DC)
    dc = (_columns(path, vertex, _RGB) / 255 - 0.5) / C0 if rgb else _columns(path, vertex, _DC)
    rest = _columns(path, vertex, tuple(f"f_rest_{i}" for i in range(3 * (num_coefficients(degree) - 1))))
    raw = RawGaussians(
        means=torch.from_numpy(_columns(path, vertex, _MEANS)),
        scales=torch.from_numpy(_columns(path, vertex, _SCALES)),
        quats=torch.from_numpy(_columns(path, vertex, _QUATS)),
        features_dc=torch.from_numpy(dc.astype(np.float32)),
        features_rest=torch.from_numpy(rest.reshape(len(vertex), 3, -1).transpose(0, 2, 1).copy()),
        opacities=torch.from_numpy(_columns(path, vertex, ("opacity",))),
        level=_level(path, vertex) if "level" in names else None,
        decay=torch.from_numpy(_columns(path, vertex, ("decay",))[:, 0].copy()) if "decay" in names else None,
    )
    _refuse_zero_quaternions(path, raw)
    remarks = _judge_ranges(path, raw)
    known = {*_MEANS, *_NORMALS, *_SCALES, *_QUATS, *(_RGB if rgb else _DC), "opacity", "level", "decay"}
    unread = [name for name in names if name not in known and not name.startswith("f_rest_")]
    return raw, PlySummary(
        path=path,
        count=len(raw),
        sh_degree=degree,
        source=_source(data, names),
        encoding="ascii" if data.text else f"binary {'little' if data.byte_order == '<' else 'big'} endian",
        antialiased=_antialiased(path, data.comments),
        has_level=raw.level is not None,
        has_decay=raw.decay is not None,
        ignored=(*unread, *(f"element {e.name}" for e in data.elements if e.name != "vertex")),
        remarks=(*(["Colours are 8-bit RGB, not harmonics."] if rgb else []), *remarks),
    )


def write_ply(
    path: Path,
    gaussians: RawGaussians,
    *,
    antialiased: bool | None = None,
    normals: bool = True,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY; float32 parameters come back bit for bit.

    `level` (1 byte where it fits) and `decay` follow the ordinary properties, where viewers skip them. Zero normals
    are what INRIA's viewer and some others count on. A file that exists is replaced only once the new one is complete.

    Raises:
        ValueError: a comment that does not fit on a line of ASCII.
        OSError: the file cannot be written.
    """
    lines = ["Generated by freqgs", *_mode_comment(antialiased), *comments]
    for line in lines:
        if not line.isascii() or "\n" in line or "\r" in line:
            raise ValueError(f"PLY comment {line!r} must be one line of ASCII.")
    element = PlyElement.describe(_structured(gaussians, normals), "vertex")
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as stream:
            PlyData([element], byte_order="<", comments=lines).write(stream)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


# -- reading ----------------------------------------------------------------------------------------------------------


def _parse(path: Path) -> PlyData:
    if path.stat().st_size == 0:
        raise SplatFileError(f"{path} is empty (0 bytes); copy or export it again.")
    with path.open("rb") as stream:
        start = stream.read(_LARGEST_HEADER)
    if start[:3] != b"ply":
        raise SplatFileError(
            f"{path} is no PLY file: it begins with {start[:4]!r}. Of .splat, .spz, .sog and .ksplat files, make a PLY "
            "first (for instance `splat-transform IN OUT.ply`)."
        )
    if path.stat().st_size > _LARGEST_HEADER and b"end_header" not in start:
        raise SplatFileError(
            f"{path} has no end_header in its first {_LARGEST_HEADER:,} bytes: it is damaged, or no 3DGS PLY. Copy or "
            "export it again."
        )
    try:
        return PlyData.read(str(path))
    except (PlyParseError, UnicodeDecodeError, ValueError, MemoryError, OverflowError) as error:
        if _declares_none(path):
            raise SplatFileError(f"{path} holds no Gaussians; export it again.") from error
        early = "early end-of-file" in str(error)
        what = "is truncated" if early else "cannot be parsed"
        raise SplatFileError(f"{path} {what} ({error}); copy or export it again.") from error


def _declares_none(path: Path) -> bool:
    """The header says that there are no vertices (which cannot be memory-mapped)."""
    with path.open("rb") as stream:
        return re.search(rb"^element vertex 0\s*$", stream.read(1 << 16), re.MULTILINE) is not None


def _vertex(path: Path, data: PlyData) -> np.ndarray:
    elements = {element.name: element for element in data.elements}
    if "chunk" in elements or any("packed_position" in (e.data.dtype.names or ()) for e in data.elements):
        raise SplatFileError(
            f"{path} is a compressed PLY (SuperSplat's, gsplat's `ply_compressed`). Uncompress it first, "
            "for instance with `splat-transform IN.compressed.ply OUT.ply`."
        )
    if "vertex" not in elements:
        raise SplatFileError(
            f"{path} has no element 'vertex' but {sorted(elements)}; Gaussians are stored in 'vertex'. Export it again."
        )
    rows = elements["vertex"].data
    names = rows.dtype.names or ()
    if "opacity" not in names and "scale_0" not in names:
        kind = "a mesh" if "face" in elements else "a point cloud"
        raise SplatFileError(
            f"{path} is {kind}: its vertices have {', '.join(names)}, no opacity and no scale_0. Name a 3DGS PLY "
            "(nerfstudio's is made by `ns-export gaussian-splat`)."
        )
    if len(rows) == 0:
        raise SplatFileError(f"{path} holds no Gaussians; export it again.")
    return rows


def _require(path: Path, names: Sequence[str], wanted: Sequence[str]) -> None:
    missing = [name for name in wanted if name not in names]
    if missing == ["scale_2"]:
        raise SplatFileError(
            f"{path} has no property scale_2: it holds flat Gaussians (2DGS), which are not drawn here. Name a 3DGS "
            "PLY."
        )
    if missing:
        raise SplatFileError(f"{path} lacks the properties {', '.join(missing)}; export it as an ordinary 3DGS PLY.")


def _sh_degree(path: Path, names: Sequence[str]) -> int:
    rest = {name for name in names if name.startswith("f_rest_")}
    degree = _REST_COUNTS.get(len(rest))
    if degree is None or rest != {f"f_rest_{i}" for i in range(len(rest))}:
        counts = ", ".join(str(count) for count in _REST_COUNTS)
        raise SplatFileError(
            f"{path} has {len(rest)} properties f_rest_*; there must be {counts} (SH degree 0..{MAX_DEGREE}), numbered "
            "from 0. Export it again."
        )
    return degree


def _columns(path: Path, vertex: np.ndarray, names: Sequence[str]) -> Float[np.ndarray, "n m"]:
    """The properties side by side in float32, all finite."""
    out = np.empty((len(vertex), len(names)), dtype=np.float32)
    for i, name in enumerate(names):
        if vertex.dtype[name].kind not in "fiu":
            raise SplatFileError(f"{path}: property {name} is a list; it must be one number. Export it again.")
        with np.errstate(over="ignore"):
            out[:, i] = vertex[name]
        bad = int((~np.isfinite(out[:, i])).sum())
        if bad:
            raise SplatFileError(
                f"{path}: property {name} of {bad} of {len(vertex)} Gaussians is NaN or infinite. Remove them, "
                "for instance with `splat-transform IN.ply --filter-nan OUT.ply`."
            )
        large = int((out[:, i] > _LARGEST_LOG_SCALE).sum()) if name.startswith("scale_") else 0
        if large:
            raise SplatFileError(
                f"{path}: property {name} of {large} of {len(vertex)} Gaussians is over {_LARGEST_LOG_SCALE:g} (up to "
                f"{out[:, i].max():g}). It is the logarithm of a size, which would be infinite. Remove them, or export "
                "it again."
            )
    return out


def _level(path: Path, vertex: np.ndarray) -> torch.Tensor:
    value = _columns(path, vertex, ("level",))[:, 0]
    wrong = value[(value < 1) | (value != np.round(value))]
    if len(wrong):
        raise SplatFileError(
            f"{path}: property level of {len(wrong)} Gaussians is not a whole number from 1 on (for instance "
            f"{wrong[0]:g}). Levels begin with 1, the base."
        )
    return torch.from_numpy(value.astype(np.int32))


def _refuse_zero_quaternions(path: Path, raw: RawGaussians) -> None:
    zero = int((raw.quats == 0).all(-1).sum())
    if zero:
        raise SplatFileError(
            f"{path}: the quaternion rot_0..rot_3 of {zero} of {len(raw)} Gaussians is zero, which is no rotation. "
            "Set it to 1 0 0 0, or remove them."
        )


def _judge_ranges(path: Path, raw: RawGaussians) -> list[str]:
    """Refuse what is activated; raw scales are logarithms (mostly negative), raw opacities logits (of any size)."""
    if len(raw) < _ENOUGH_TO_JUDGE:
        return []
    within = bool(((raw.opacities >= 0) & (raw.opacities <= 1)).all())
    positive = bool((raw.scales > 0).all())
    if within and positive:
        raise SplatFileError(
            f"{path} seems to hold activated parameters: every opacity is in [0, 1] and every scale_* above 0. "
            "A 3DGS PLY holds logits of opacities and natural logarithms of scales: convert them."
        )
    if within:
        return ["Every opacity is in [0, 1]; they are taken as logits."]
    return ["Every scale_* is above 0; they are taken as logarithms."] if positive else []


def _source(data: PlyData, names: Sequence[str]) -> str:
    comments = " ".join(data.comments).lower()
    for mark, name in _WRITERS.items():
        if mark in comments:
            return name
    if data.comments:
        return "unknown"
    if set(_NORMALS) <= set(names):
        return "INRIA's 3D Gaussian splatting"
    if tuple(names[:6]) == (*_MEANS, *_DC):
        return "gsplat"
    return "unknown"


def _antialiased(path: Path, comments: Sequence[str]) -> bool | None:
    """By Brush's `SplatRenderMode: mip | default` or Postshot's `antialiased 0 | 1`; the last one counts."""
    found = None
    for comment in comments:
        match = re.fullmatch(r"\s*(?:splatrendermode\s*:\s*(\w+)|antialiased\s+([01]))\s*", comment, re.IGNORECASE)
        if match is None:
            continue
        mode = (match[1] or {"0": "default", "1": "mip"}[match[2]]).lower()
        if mode not in ("mip", "default"):
            raise SplatFileError(
                f"{path} is for SplatRenderMode '{mode}'; only 3D Gaussians (mip, default) are drawn here."
            )
        found = mode == "mip"
    return found


# -- writing ----------------------------------------------------------------------------------------------------------


def _mode_comment(antialiased: bool | None) -> list[str]:
    return [] if antialiased is None else [f"SplatRenderMode: {'mip' if antialiased else 'default'}"]


def _structured(raw: RawGaussians, normals: bool) -> np.ndarray:
    """All parameters as one structured array in the order of INRIA's files."""
    n = len(raw)
    rest = raw.features_rest.transpose(1, 2).reshape(n, -1)
    columns = [
        (_MEANS, raw.means),
        *([(_NORMALS, torch.zeros(n, 3))] if normals else []),
        (_DC, raw.features_dc),
        (tuple(f"f_rest_{i}" for i in range(rest.shape[1])), rest),
        (("opacity",), raw.opacities),
        (_SCALES, raw.scales),
        (_QUATS, raw.quats),
        *([(("decay",), raw.decay[:, None])] if raw.decay is not None else []),
    ]
    fields: list[tuple[str, str]] = [(name, "<f4") for names, _ in columns for name in names]
    if raw.level is not None:
        fields.append(("level", "u1" if n == 0 or int(raw.level.max()) < 256 else "<i4"))
    out = np.empty(n, dtype=fields)
    for names, values in columns:
        values = values.detach().cpu().float().numpy()
        for i, name in enumerate(names):
            out[name] = values[:, i]
    if raw.level is not None:
        out["level"] = raw.level.cpu().numpy()
    return out
