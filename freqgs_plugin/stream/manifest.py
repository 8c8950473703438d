"""The manifest: all that a reader must know before the first byte of a chunk."""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.quantise import NAMES, Coding, coding_from

FORMAT, VERSION = "freqgs-stream", 2
MANIFEST = "manifest.json"
DATA = re.compile(r"splats-[0-9a-f]{8}\.bin")
"""names of files of chunks: with a checksum, so that no cache takes an old one for a new one"""


@dataclass(frozen=True)
class Level:
    """One level: rows `first` to `first + count` of the stream."""

    level: int
    first: int
    count: int
    box: tuple[tuple[float, ...], tuple[float, ...]]
    """least and largest position, world units"""
    codings: tuple[Coding, ...]

    def part(self, part: str) -> list[Coding]:
        """Of a chunk's columns, in order."""
        return [coding for coding in self.codings if coding.part == part]


@dataclass(frozen=True)
class Chunk:
    """A range of bytes in the file of chunks."""

    level: int
    part: str
    first: int
    """row of the stream"""
    count: int
    offset: int
    bytes: int
    crc32: int
    enlarge: float = 1.0
    """factor of all axes while no more than this has arrived: closes the holes of what is missing"""


_CHUNK = tuple(field.name for field in fields(Chunk))


@dataclass(frozen=True)
class Manifest:
    """What is in a stream."""

    data: str
    """name of the file of chunks, beside the manifest"""
    variant: str
    """of `quantise.VARIANTS`"""
    sh_degree: int
    signed_residuals: bool
    antialiased: bool
    background: tuple[float, ...]
    scene_distance: float | None
    """of the decay, world units; None: opacities do not decay"""
    levels: tuple[Level, ...]
    chunks: tuple[Chunk, ...]
    views: tuple[Mapping[str, Any], ...] = ()
    """name, viewmat (16 numbers by rows, OpenCV axes), K (9), width, height"""

    @property
    def count(self) -> int:
        """Gaussians."""
        return sum(level.count for level in self.levels)

    @property
    def bytes(self) -> int:
        """Of all chunks."""
        return sum(chunk.bytes for chunk in self.chunks)

    def level(self, number: int) -> Level:
        return next(level for level in self.levels if level.level == number)

    def text(self) -> str:
        """As JSON."""
        found = {
            "format": FORMAT,
            "version": VERSION,
            "data": self.data,
            "bytes": self.bytes,
            "count": self.count,
            "variant": self.variant,
            "colour": {"sh_degree": self.sh_degree, "signed_residuals": self.signed_residuals},
            "render": {"antialiased": self.antialiased, "background": list(self.background)},
            "decay": None if self.scene_distance is None else {"scene_distance": self.scene_distance},
            "levels": [{**vars(level), "codings": [c.json() for c in level.codings]} for level in self.levels],
            "chunks": {name: [getattr(chunk, name) for chunk in self.chunks] for name in _CHUNK},
            "views": list(self.views),
        }
        return json.dumps(found, separators=(",", ":"), allow_nan=False)


def parse_manifest(text: str | bytes, where: str = MANIFEST) -> Manifest:
    """Read and check a manifest.

    Raises:
        StreamError: it is no manifest, of another version, or contradicts itself.
    """
    try:
        found = json.loads(text)
        kind, version = found["format"], found["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise StreamError(f"{where} is no manifest of a stream ({error!r}); name the folder of one.") from error
    if kind != FORMAT or version != VERSION:
        raise StreamError(
            f"{where} is {kind} of version {version}; this reads {FORMAT} of version {VERSION}. Write the stream anew."
        )
    try:
        levels = tuple(
            Level(**{**_only(Level, level), "box": tuple(map(tuple, level["box"])), "codings": _codings(level)})
            for level in found["levels"]
        )
        manifest = Manifest(
            data=str(found["data"]),
            variant=found["variant"],
            sh_degree=int(found["colour"]["sh_degree"]),
            signed_residuals=bool(found["colour"]["signed_residuals"]),
            antialiased=bool(found["render"]["antialiased"]),
            background=tuple(map(float, found["render"]["background"])),
            scene_distance=None if found["decay"] is None else float(found["decay"]["scene_distance"]),
            levels=levels,
            chunks=tuple(_chunks(found["chunks"])),
            views=tuple(found["views"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise StreamError(f"{where} is damaged ({error!r}); fetch or write it again.") from error
    problem = _contradiction(manifest)
    if problem is not None:
        raise StreamError(f"{where} is damaged: {problem}. Fetch or write it again.")
    return manifest


def _only(kind: Any, found: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a dataclass; a field that is missing is a KeyError."""
    return {name: found[name] for name in kind.__dataclass_fields__}


def _codings(level: Mapping[str, Any]) -> tuple[Coding, ...]:
    return tuple(coding_from(coding) for coding in level["codings"])


def _chunks(found: Mapping[str, Sequence[Any]]) -> Iterator[Chunk]:
    """From one list per field, which takes half the bytes."""
    for values in zip(*(found[name] for name in _CHUNK), strict=True):
        yield Chunk(*values)


def _contradiction(manifest: Manifest) -> str | None:
    if not DATA.fullmatch(manifest.data):
        return f"the file of chunks is called {manifest.data!r}"
    first = 0
    for level in manifest.levels:
        if level.first != first or level.count < 0:
            return f"level {level.level} begins with row {level.first} instead of {first}"
        first += level.count
        problem = next(filter(None, map(_coding_problem, level.codings)), None)
        if problem is not None:
            return f"level {level.level}: {problem}"
    numbers = [level.level for level in manifest.levels]
    if numbers != sorted(set(numbers)) or not all(n >= 1 for n in numbers):
        return f"levels are {numbers}"
    offset = 0
    for index, chunk in enumerate(manifest.chunks):
        if chunk.level not in numbers or chunk.part not in ("core", "sh"):
            return f"chunk {index} is of level {chunk.level}, part {chunk.part}"
        level = manifest.level(chunk.level)
        if chunk.count < 1 or chunk.first < level.first or chunk.first + chunk.count > level.first + level.count:
            return f"chunk {index} holds rows {chunk.first} to {chunk.first + chunk.count}, outside of its level"
        if chunk.offset != offset or chunk.bytes < 1:
            return f"chunk {index} begins at byte {chunk.offset} instead of {offset}"
        if not 1 <= chunk.enlarge < math.inf:
            return f"chunk {index} enlarges by {chunk.enlarge}"
        offset += chunk.bytes
    if manifest.scene_distance is not None and not 0 < manifest.scene_distance < math.inf:
        return f"scene_distance is {manifest.scene_distance}"
    return None


def _coding_problem(coding: Coding) -> str | None:
    lengths: Sequence[int] = (len(coding.low), len(coding.step))
    if coding.name not in NAMES or coding.size not in (1, 2, 4) or any(n != coding.components for n in lengths):
        return f"column {coding.name} cannot be read"
    if any(not 0 <= k < coding.components for k in coding.kept):
        return f"column {coding.name} keeps components {coding.kept} of {coding.components}"
    return None
