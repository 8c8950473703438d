"""`freqgs stream`: a scene as a stream, or as one HTML file. Heavy imports happen inside."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from freqgs_plugin.commands.scene import Scene
    from freqgs_plugin.stream.scene import StreamScene

SHOWN = 12
"""views that the page offers, at most"""


def stream(
    load_config: Path | None = None,
    ply: Path | None = None,
    output_dir: Path = Path("stream-out"),
    variant: Literal["exact", "fine", "balanced", "small"] = "balanced",
    html: Path | None = None,
) -> None:
    """Write a scene so that it can be shown as it arrives: coarse levels first, any part of it a scene.

    Look at it with `freqgs serve DIR`; any web server that supports ranges serves the two files as well.

    Args:
        load_config: config.yml of a trained run.
        ply: Gaussians to send in place of the run's; without a run, largest first.
        output_dir: folder for manifest.json and the file of chunks.
        variant: exact is float32, bit for bit; the others are quantised, see the documentation for errors and bytes.
        html: write one HTML file with the page and the scene in it instead.
    """
    from rich.console import Console

    from freqgs_plugin.commands.options import CommandError
    from freqgs_plugin.commands.scene import open_scene
    from freqgs_plugin.stream.html import write_html
    from freqgs_plugin.stream.write import StreamOptions, write_stream

    try:
        scene = stream_scene(open_scene(load_config, ply, "auto"))
    except ValueError as error:
        raise CommandError(str(error)) from error
    options = StreamOptions(variant)
    console = Console()
    with console.status("Finding out what to send first"):
        if html is not None:
            manifest, path = write_html(scene, html, options).manifest, html
        else:
            manifest, path = write_stream(scene, output_dir, options), output_dir
    console.print(
        f"{path}: {manifest.count:,} Gaussians in {manifest.bytes / 1e6:.2f} MB, {len(manifest.chunks)} chunks, "
        f"{manifest.bytes / manifest.count:.1f} bytes each.",
        soft_wrap=True,
        highlight=False,
    )
    if html is None:
        console.print(f"See it with: freqgs serve {output_dir}", soft_wrap=True, highlight=False)


def stream_scene(scene: "Scene") -> "StreamScene":
    """What is streamed of a run or a PLY: training views decide about the order, held-out ones are shown."""
    from freqgs_plugin.reports.bench.trained import views_of_split
    from freqgs_plugin.stream.scene import StreamScene

    cameras, shown = [], []
    if scene.run is not None:
        train, test = (views_of_split(scene.run, split) for split in ("train", "test"))
        cameras = [view.camera for view in train]
        chosen = test or train
        shown = [(view.name, view.camera) for view in chosen[:: max(1, -(-len(chosen) // SHOWN))]]
    return StreamScene(
        scene.gaussians,
        scene.background,
        scene.antialiased,
        scene.scene_distance,
        cameras,
        shown,
        scene.rasterizer.name,
    )
