"""From a scene to a stream: a folder of two files that any web server can serve."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from freqgs_plugin.functional.attenuation import DistanceDecay
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.stream.chunks import Columns, checksum, encode_chunk
from freqgs_plugin.stream.enlarging import enlargements
from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.files import folder_for
from freqgs_plugin.stream.manifest import DATA, MANIFEST, Chunk, Level, Manifest
from freqgs_plugin.stream.order import importance, size, streaming_order
from freqgs_plugin.stream.quantise import NAMES, VARIANTS, coding_of
from freqgs_plugin.stream.scene import StreamScene
from freqgs_plugin.types import Camera, Gaussians, Rendering

PARTS = ("core", "sh")
LEAST_ROWS, MOST_ROWS = 256, 16384
BASE_CUTS = 2
"""the base's cores are cut into this many times as many chunks: something is seen sooner"""


@dataclass(frozen=True)
class StreamOptions:
    """How a stream is written."""

    variant: str = "balanced"
    """exact (float32), fine, balanced or small"""
    chunks_per_level: int = 8
    """places within a level at which a stream may end; more where a chunk would exceed 16384 rows"""

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise StreamError(f"unknown variant '{self.variant}'; choose one of {', '.join(VARIANTS)}.")
        if self.chunks_per_level < 1:
            raise StreamError(f"chunks_per_level is {self.chunks_per_level}; it must be at least 1.")


@dataclass(frozen=True)
class Stream:
    """A stream in memory."""

    manifest: Manifest
    data: bytes


def write_stream(scene: StreamScene, folder: Path, options: StreamOptions | None = None) -> Manifest:
    """Write the manifest and the file of chunks; a stream that is there already is replaced.

    Raises:
        StreamError: nothing to send, or numbers that cannot be.
        OSError: the folder cannot be written.
    """
    stream = encode_stream(scene, options or StreamOptions())
    save_stream(stream, folder)
    return stream.manifest


def save_stream(stream: Stream, folder: Path) -> None:
    """Write both files, the manifest last; files of an earlier stream are removed.

    Raises:
        OSError: the folder cannot be written; an earlier stream is still there, and nothing new is.
    """
    data, manifest = folder / stream.manifest.data, folder / MANIFEST
    with folder_for(data, manifest):
        replace_file(data, stream.data)
        replace_file(manifest, stream.manifest.text().encode())
    for path in folder.iterdir():
        if DATA.fullmatch(path.name) and path.name != stream.manifest.data:
            path.unlink()


def encode_stream(scene: StreamScene, options: StreamOptions) -> Stream:
    """The stream, coarse levels first. See `order` and `enlarging` for what takes time.

    Raises:
        StreamError: as `write_stream`.
    """
    gaussians = scene.gaussians
    if not len(gaussians):
        raise StreamError("the scene has no Gaussians; there is nothing to stream.")
    decays = gaussians.decay is not None
    if decays and not scene.scene_distance:
        raise StreamError(
            "the Gaussians fade with distance, but the scene's distance is not known, which a PLY does not say. Stream "
            "the run: `freqgs export --load-config RUN/config.yml --format stream`."
        )
    drawing = _drawing(scene)
    gaussians = gaussians.select(_order(scene, drawing))
    columns = columns_of(gaussians)
    levels: list[Level] = []
    for number, count in zip(*(values.tolist() for values in gaussians.level.unique(return_counts=True)), strict=True):
        levels.append(_level(number, sum(level.count for level in levels), count, columns, options))
    cuts = [cut for level in levels for cut in _cuts(level, options.chunks_per_level, level is levels[0])]
    factors = _enlargements(scene, gaussians, [cut for cut in cuts if cut[0] is levels[0]], drawing)
    chunks, data = _chunks(cuts, factors, columns)
    manifest = Manifest(
        data=f"splats-{checksum(data):08x}.bin",
        variant=options.variant,
        sh_degree=round((gaussians.features_rest.shape[1] + 1) ** 0.5) - 1,
        signed_residuals=gaussians.signed_residuals,
        antialiased=scene.antialiased,
        background=tuple(scene.background.tolist()),
        scene_distance=scene.scene_distance if decays else None,
        levels=tuple(levels),
        chunks=tuple(chunks),
        views=tuple(view_json(name, camera) for name, camera in scene.shown),
    )
    return Stream(manifest, data)


def columns_of(gaussians: Gaussians) -> Columns:
    """Numbers of all rows, by name, in float32."""
    n = len(gaussians)
    found = {
        "means": gaussians.means,
        "scales": gaussians.scales,
        "quats": gaussians.quats,
        "opacities": gaussians.opacities[:, None],
        "features_dc": gaussians.features_dc,
        "features_rest": gaussians.features_rest.reshape(n, -1),
    }
    if gaussians.decay is not None:
        found["decay"] = gaussians.decay.reshape(n, 1)
    return {name: values.detach().cpu().float().contiguous().numpy() for name, values in found.items()}


def view_json(name: str, camera: Camera) -> dict[str, Any]:
    """A camera in a manifest."""
    viewmat, K = (t.detach().cpu().double().flatten().tolist() for t in (camera.viewmat, camera.K))
    return {"name": name, "viewmat": viewmat, "K": K, "width": camera.width, "height": camera.height}


def _drawing(scene: StreamScene) -> dict[str, Any]:
    """How the scene's views are drawn."""
    decays = scene.gaussians.decay is not None
    return {
        "rasterizer": get_rasterizer(scene.rasterizer, scene.gaussians.means.device, absgrad=False),
        "antialiased": scene.antialiased,
        "attenuation": DistanceDecay(1.0, "scene", scene.scene_distance) if decays else None,
    }


def _order(scene: StreamScene, drawing: dict[str, Any]) -> torch.Tensor:
    gaussians = scene.gaussians
    if not scene.cameras:
        return streaming_order(size(gaussians), gaussians.level)
    with torch.no_grad():
        return streaming_order(importance(gaussians, scene.cameras, **drawing), gaussians.level)


def _level(number: int, first: int, count: int, columns: Columns, options: StreamOptions) -> Level:
    own = {name: values[first : first + count] for name, values in columns.items()}
    try:
        codings = tuple(coding_of(name, own[name], VARIANTS[options.variant]) for name in NAMES if name in own)
    except ValueError as error:
        raise StreamError(str(error)) from error
    box = (tuple(own["means"].min(0).tolist()), tuple(own["means"].max(0).tolist()))
    return Level(number, first, count, box, codings)


_Cut = tuple[Level, str, int, int]
"""level, part, first row and count of a chunk"""


def _cuts(level: Level, cuts: int, base: bool) -> Iterator[_Cut]:
    """A level's chunks: all cores before any harmonics."""
    for part in PARTS:
        if part == "sh" and not any(c.kept or any(c.low) for c in level.part(part)):
            continue
        wanted = cuts * BASE_CUTS if base and part == "core" else cuts
        length = min(max(-(-level.count // wanted), LEAST_ROWS), MOST_ROWS)
        for first in range(0, level.count, length):
            yield level, part, level.first + first, min(length, level.count - first)


def _chunks(cuts: Sequence[_Cut], factors: Sequence[float], columns: Columns) -> tuple[list[Chunk], bytes]:
    """All chunks, and their bytes; `factors` are of the first ones."""
    chunks, data = [], b""
    for index, (level, part, first, rows) in enumerate(cuts):
        cut = {name: values[first : first + rows] for name, values in columns.items()}
        found = encode_chunk(level.part(part), cut)
        factor = factors[index] if index < len(factors) else 1.0
        chunks.append(Chunk(level.level, part, first, rows, len(data), len(found), checksum(found), factor))
        data += found
    return chunks, data


def _enlargements(
    scene: StreamScene, gaussians: Gaussians, cuts: Sequence[_Cut], drawing: dict[str, Any]
) -> list[float]:
    """Factors of the base's cores."""
    ends = [first + rows for _, part, first, rows in cuts if part == "core"]

    def draw(shown: Gaussians, camera: Camera) -> Rendering:
        return render(shown, camera, background=scene.background, depth=False, **drawing)

    with torch.no_grad():
        return enlargements(gaussians.select(torch.arange(ends[-1])), ends, scene.cameras, draw)


def replace_file(path: Path, contents: bytes) -> None:
    """Write a file in one piece."""
    partial = path.with_name(f".{path.name}.part")
    try:
        partial.write_bytes(contents)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
