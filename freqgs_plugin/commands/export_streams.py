"""The formats that are shown as they arrive: a folder for `freqgs serve`, and one HTML file with the page in it."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from freqgs_plugin.commands.export_loss import Loss, Shown, Written, mean_psnr
from freqgs_plugin.commands.export_options import ExportOptions
from freqgs_plugin.commands.export_source import Source
from freqgs_plugin.rendering.render import render
from freqgs_plugin.stream.html import html_text
from freqgs_plugin.stream.manifest import Manifest
from freqgs_plugin.stream.received import Received
from freqgs_plugin.stream.scene import StreamScene
from freqgs_plugin.stream.write import Stream, StreamOptions, encode_stream, replace_file, save_stream

if TYPE_CHECKING:
    from freqgs_plugin.commands.export_formats import Work
    from freqgs_plugin.commands.scene import Scene

FOLDER, PAGE = "stream", "scene.html"
SHOWN = 12
"""views that the page offers, at most"""


def write_as_stream(source: Source, options: ExportOptions, work: "Work") -> list[Written]:
    """stream/: manifest.json and a file of chunks, coarse levels first."""
    begun = time.perf_counter()
    stream = _encoded(source, options, work)
    save_stream(stream, work.folder / FOLDER)
    work.console.print(f"See it with: freqgs serve {options.output_dir / FOLDER}", soft_wrap=True, highlight=False)
    return [_written(work.folder / FOLDER, stream, source, options, begun)]


def write_as_html(source: Source, options: ExportOptions, work: "Work") -> list[Written]:
    """scene.html: the page and the scene in it, to be opened without a server."""
    begun = time.perf_counter()
    stream = _encoded(source, options, work)
    replace_file(work.folder / PAGE, html_text(stream).encode())
    return [_written(work.folder / PAGE, stream, source, options, begun)]


def check_stream(source: Source, options: ExportOptions) -> None:
    """Refuse options that mean nothing to the page, which draws signed colours and decays as they are."""
    asked = {
        "--bake": options.bake,
        "--viewer": options.viewer is not None,
        "--extra": bool(options.extra),
        "--distance": options.distance is not None,
        "--detail": options.detail != 1,
        "--frame dataset": options.frame != "scene",
    }
    if wrong := [name for name, given in asked.items() if given]:
        raise ValueError(
            f"{', '.join(wrong)}: the page draws the scene as it is trained, at any detail. Leave it out, or "
            "choose --format ply."
        )


def stream_scene(scene: "Scene", source: Source | None = None) -> StreamScene:
    """What is streamed of a run: training views decide about the order, held-out ones are shown.

    `source` names the rows of it that are sent.
    """
    from freqgs_plugin.reports.bench.trained import views_of_split

    train, test = (views_of_split(scene.run, split) for split in ("train", "test"))
    chosen = test or train
    return StreamScene(
        scene.gaussians if source is None else source.gaussians,
        scene.background,
        scene.antialiased,
        scene.scene_distance,
        [view.camera for view in train],
        [(view.name, view.camera) for view in chosen[:: max(1, -(-len(chosen) // SHOWN))]],
        scene.rasterizer.name,
    )


def _encoded(source: Source, options: ExportOptions, work: "Work") -> Stream:
    with work.console.status("Finding out what to send first"):
        return encode_stream(stream_scene(source.scene, source), StreamOptions(options.variant))


def _written(path: Path, stream: Stream, source: Source, options: ExportOptions, begun: float) -> Written:
    loss = stream_loss(stream, source)
    manifest = stream.manifest
    note = f"coarse first, in {len(manifest.chunks)} chunks, {options.variant}"
    return Written(path, manifest.count, loss, time.perf_counter() - begun, note)


@torch.no_grad()
def stream_loss(stream: Stream, source: Source) -> Loss:
    """All chunks are decoded, and drawn as our own pictures are: the page agrees with these."""
    manifest: Manifest = stream.manifest
    received = Received(manifest)
    for chunk in manifest.chunks:
        received.add(chunk, stream.data[chunk.offset : chunk.offset + chunk.bytes])
    gaussians, scene = received.gaussians(), source.scene
    pictures = [
        render(
            gaussians,
            view.camera,
            source.attenuation,
            rasterizer=scene.rasterizer,
            background=scene.background,
            antialiased=scene.antialiased,
            depth=False,
        ).features.clamp(0, 1)
        for view in source.views
    ]
    photographs = [view.image.to(scene.background) for view in source.views]
    shown = Shown(mean_psnr(pictures, source.pictures), mean_psnr(pictures, photographs))
    return Loss(len(source.views), mean_psnr(source.pictures, photographs), None, shown)
