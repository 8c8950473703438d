"""From a scene to a stream: a folder of two files that any web server can serve."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from freqgs_plugin.functional.attenuation import DistanceDecay
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.stream.chunks import Columns, checksum, encode_chunk
from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.manifest import DATA, MANIFEST, Chunk, Level, Manifest
from freqgs_plugin.stream.order import importance, size, streaming_order
from freqgs_plugin.stream.quantise import NAMES, VARIANTS, Coding, coding_of
from freqgs_plugin.stream.scene import StreamScene
from freqgs_plugin.types import Camera, Gaussians

PARTS = ("core", "sh")
LEAST_ROWS, MOST_ROWS = 256, 16384


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
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(folder / stream.manifest.data, stream.data)
    replace_file(folder / MANIFEST, stream.manifest.text().encode())
    for path in folder.iterdir():
        if DATA.fullmatch(path.name) and path.name != stream.manifest.data:
            path.unlink()


def encode_stream(scene: StreamScene, options: StreamOptions) -> Stream:
    """The stream, coarse levels first. See `order.importance` for the order within a level and for its time.

    Raises:
        StreamError: as `write_stream`.
    """
    gaussians = scene.gaussians
    if not len(gaussians):
        raise StreamError("the scene has no Gaussians; there is nothing to stream.")
    decays = gaussians.decay is not None
    if decays and not scene.scene_distance:
        raise StreamError("the Gaussians fade with distance, but the scene's distance is not known: name the run.")
    gaussians = gaussians.select(_order(scene))
    level = gaussians.level.cpu().numpy()
    columns = columns_of(gaussians)
    levels, chunks, parts = [], [], []
    for number in sorted(set(level.tolist())):
        rows = np.flatnonzero(level == number)
        own = {name: values[rows] for name, values in columns.items()}
        try:
            codings = tuple(coding_of(name, own[name], VARIANTS[options.variant]) for name in NAMES if name in own)
        except ValueError as error:
            raise StreamError(str(error)) from error
        box = (tuple(own["means"].min(0).tolist()), tuple(own["means"].max(0).tolist()))
        levels.append(Level(number, int(rows[0]), len(rows), box, codings))
        for part, first, count in _cuts(codings, len(rows), options.chunks_per_level):
            cut = {name: values[first : first + count] for name, values in own.items()}
            data = encode_chunk([c for c in codings if c.part == part], cut)
            offset = sum(map(len, parts))
            chunks.append(Chunk(number, part, int(rows[0]) + first, count, offset, len(data), checksum(data)))
            parts.append(data)
    data = b"".join(parts)
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


def _order(scene: StreamScene) -> torch.Tensor:
    gaussians = scene.gaussians
    if not scene.cameras:
        return streaming_order(size(gaussians), gaussians.level)
    attenuation = None if gaussians.decay is None else DistanceDecay(1.0, "scene", scene.scene_distance)
    rasterizer = get_rasterizer(scene.rasterizer, gaussians.means.device, absgrad=False)
    options = {"rasterizer": rasterizer, "antialiased": scene.antialiased, "attenuation": attenuation}
    with torch.no_grad():
        return streaming_order(importance(gaussians, scene.cameras, **options), gaussians.level)


def _cuts(codings: tuple[Coding, ...], rows: int, cuts: int) -> Iterator[tuple[str, int, int]]:
    """Part, first row and count of a level's chunks: all cores before any harmonics."""
    length = min(max(-(-rows // cuts), LEAST_ROWS), MOST_ROWS)
    for part in PARTS:
        if part == "sh" and not any(c.kept or any(c.low) for c in codings if c.part == part):
            continue
        for first in range(0, rows, length):
            yield part, first, min(length, rows - first)


def replace_file(path: Path, contents: bytes) -> None:
    """Write a file in one piece."""
    partial = path.with_name(f".{path.name}.part")
    try:
        partial.write_bytes(contents)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
