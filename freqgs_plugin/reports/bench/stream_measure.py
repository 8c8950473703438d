"""What a stream shows after so many bytes and seconds, against one PLY."""

import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import DistanceDecay
from freqgs_plugin.io.parameters import RawGaussians
from freqgs_plugin.io.ply import read_ply, write_ply
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.reports.bench.trained import load, views_of, views_of_split
from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.reports.tables import psnr
from freqgs_plugin.stream.client import fetch
from freqgs_plugin.stream.enlarging import without_holes
from freqgs_plugin.stream.manifest import Chunk
from freqgs_plugin.stream.received import Received
from freqgs_plugin.stream.scene import StreamScene
from freqgs_plugin.stream.server import Server
from freqgs_plugin.stream.write import Stream
from freqgs_plugin.types import Gaussians, Rendering

_TENSORS = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
Pictures = list[Float[Tensor, "h w 3"]]


@dataclass(frozen=True)
class StreamSubject:
    """A scene and the photographs that it is measured on."""

    name: str
    scene: StreamScene
    views: Sequence[HeldOutView]


@dataclass(frozen=True)
class Point:
    """After a chunk."""

    level: int
    part: str
    bytes: int
    """with the manifest"""
    photographs: float
    """mean PSNR, dB"""
    complete: float
    """mean PSNR against the run's own pictures, dB"""
    covered: float
    """of the view with most holes, the share of pixels that are none, beside the whole base"""
    gaussians: int


@dataclass(frozen=True)
class Times:
    """Seconds since the request."""

    first: float
    """something is seen"""
    complete: float
    """the picture is complete"""
    base: float
    """all Gaussians of the base are"""
    full: float


def subject_of_run(config: Path, name: str | None = None) -> StreamSubject:
    """A trained run with its held-out views, or those trained on where none is held out.

    Raises:
        BenchError: there is no such run.
    """
    run = load(config)
    g = run.gaussians
    values = {field: getattr(g, field).detach() for field in _TENSORS}
    gaussians = replace(g, **values, decay=None if g.decay is None else g.decay.detach())
    train = [view.camera for view in views_of_split(run, "train")]
    scene = StreamScene(
        gaussians, run.background, run.antialiased, run.scene_distance, train, rasterizer=run.rasterizer.name
    )
    return StreamSubject(name or run.config.experiment_name, scene, views_of(run))


def renderings(subject: StreamSubject, gaussians: Gaussians) -> list[Rendering]:
    """Of all views."""
    scene = subject.scene
    decay = None if gaussians.decay is None else DistanceDecay(1.0, "scene", scene.scene_distance)
    rasterizer = get_rasterizer(scene.rasterizer, gaussians.means.device, absgrad=False)
    options = {"rasterizer": rasterizer, "background": scene.background, "antialiased": scene.antialiased}
    with torch.no_grad():
        return [render(gaussians, v.camera, decay, depth=False, **options) for v in subject.views]


def pictures(subject: StreamSubject, gaussians: Gaussians) -> Pictures:
    """Of all views, as they are shown."""
    return shown(renderings(subject, gaussians))


def shown(found: Sequence[Rendering]) -> Pictures:
    return [rendering.features.clamp(0, 1) for rendering in found]


def covered(found: Sequence[Rendering], whole: Sequence[Rendering]) -> float:
    """The share of pixels without holes, of the view that has least of them."""
    pairs = zip(found, whole, strict=True)
    return min(float(without_holes(part.alpha, all_of_it.alpha).float().mean()) for part, all_of_it in pairs)


def quality(found: Pictures, expected: Sequence[Tensor]) -> float:
    """Mean PSNR, dB."""
    values = [psnr(a, b.to(a)) for a, b in zip(found, expected, strict=True)]
    return sum(values) / len(values)


def curve(subject: StreamSubject, stream: Stream) -> list[Point]:
    """After every chunk."""
    received, scene = Received(stream.manifest), subject.scene.gaussians
    own, base = pictures(subject, scene), renderings(subject, scene.select(scene.level == scene.level.min()))
    photographs = [view.image for view in subject.views]
    points, begin = [], len(stream.manifest.text())
    for chunk in stream.manifest.chunks:
        end = chunk.offset + chunk.bytes
        received.add(chunk, stream.data[chunk.offset : end])
        drawn = renderings(subject, received.gaussians())
        found = shown(drawn)
        qualities = quality(found, photographs), quality(found, own), covered(drawn, base)
        points.append(Point(chunk.level, chunk.part, begin + end, *qualities, received.count))
    return points


def ply_of(gaussians: Gaussians, antialiased: bool, path: Path) -> int:
    """Write the scene as a PLY without normals; its bytes."""
    raw = RawGaussians(
        means=gaussians.means,
        scales=gaussians.scales.log(),
        quats=gaussians.quats,
        features_dc=gaussians.features_dc,
        features_rest=gaussians.features_rest,
        opacities=gaussians.opacities.clamp(1e-7, 1 - 1e-7).logit()[:, None],
        level=gaussians.level,
        decay=gaussians.decay,
    )
    write_ply(path, raw, antialiased=antialiased, normals=False)
    return path.stat().st_size


@contextmanager
def serving(folder: Path, mbits: float | None = None) -> Iterator[str]:
    """The address of a server for `folder`, at `mbits` Mbit/s."""
    with Server(folder, mbits=mbits) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.url
        finally:
            server.shutdown()
            thread.join()


def stream_times(folder: Path, mbits: float, complete: int) -> Times:
    """Fetch and decode a stream over a slow line; with the chunk `complete` the picture is complete."""
    found: dict[str, float] = {}
    base: list[tuple[int, str]] = []
    with serving(folder, mbits) as url:
        start = time.monotonic()

        def arrived(chunk: Chunk, _bytes: int) -> None:
            found.setdefault("first", time.monotonic() - start)
            base.append((chunk.level, chunk.part))
            if len(base) == complete + 1:
                found["complete"] = time.monotonic() - start
            # the cores of the base come first
            if base[-1] == base[0]:
                found["base"] = time.monotonic() - start

        fetched = fetch(url, arrived=arrived)
        full = time.monotonic() - start
    assert fetched.complete
    return Times(found["first"], found["complete"], found["base"], full)


def ply_seconds(path: Path, mbits: float) -> float:
    """Fetch and read a PLY over a slow line: until then nothing is seen."""
    with serving(path.parent, mbits) as url:
        start = time.monotonic()
        with urllib.request.urlopen(f"{url}/{path.name}") as response:
            data = response.read()
        copy = path.with_name("received.ply")
        copy.write_bytes(data)
        read_ply(copy)
        return time.monotonic() - start
