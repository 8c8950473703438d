"""`freqgs stream`: a PLY without a run, to be shown as it arrives. Runs are exported (`commands.export_streams`)."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def stream(
    ply: Positional[Path],
    output_dir: Path = Path("stream-out"),
    variant: Literal["exact", "fine", "balanced", "small"] = "balanced",
    html: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Write the Gaussians of a 3DGS PLY so that they are shown as they arrive: any part of them is a scene.

    Those with the largest opacity times size come first. For a trained run, `freqgs export --format stream` knows its
    views, and orders by them. Look at it with `freqgs serve DIR`.

    Args:
        ply: a 3DGS PLY, of any tool.
        output_dir: folder for manifest.json and the file of chunks.
        variant: exact is float32, bit for bit; the others are quantised, see the documentation for errors and bytes.
        html: write one HTML file with the page and the scene in it instead.
        overwrite: replace the stream, or the HTML file, that is there.
    """
    from rich.console import Console

    from freqgs_plugin.commands.options import CommandError
    from freqgs_plugin.commands.scene import open_scene
    from freqgs_plugin.reports.bench.runner import check_folder
    from freqgs_plugin.stream.html import write_html
    from freqgs_plugin.stream.manifest import MANIFEST
    from freqgs_plugin.stream.scene import StreamScene
    from freqgs_plugin.stream.write import StreamOptions, write_stream

    target = output_dir / MANIFEST if html is None else html
    if target.exists() and not overwrite:
        raise CommandError(f"{target} exists; add --overwrite, or name another {'--html' if html else '--output-dir'}.")
    check_folder(target.parent)
    try:
        scene = open_scene(None, ply, "auto")
    except ValueError as error:
        raise CommandError(str(error)) from error
    given = StreamScene(
        scene.gaussians, scene.background, scene.antialiased, scene.scene_distance, [], [], scene.rasterizer.name
    )
    options = StreamOptions(variant)
    console = Console()
    with console.status("Finding out what to send first"):
        if html is not None:
            manifest, path = write_html(given, html, options).manifest, html
        else:
            manifest, path = write_stream(given, output_dir, options), output_dir
    console.print(
        f"{path}: {manifest.count:,} Gaussians in {manifest.bytes / 1e6:.2f} MB, {len(manifest.chunks)} chunks, "
        f"{manifest.bytes / manifest.count:.1f} bytes each.",
        soft_wrap=True,
        highlight=False,
    )
    if html is None:
        console.print(f"See it with: freqgs serve {output_dir}", soft_wrap=True, highlight=False)
