"""`freqgs serve`: look at streams in a browser. Heavy imports happen inside."""

from pathlib import Path
from typing import Annotated

import tyro


def serve(
    directory: Annotated[Path, tyro.conf.Positional],
    host: str = "127.0.0.1",
    port: int = 8080,
    mbits: float | None = None,
) -> None:
    """Serve the streams in a folder, and the page that shows them, until interrupted.

    For trying: any web server that supports ranges can serve the files.

    Args:
        directory: folder of a stream, or of folders of streams.
        host: address to listen at; 0.0.0.0 lets other devices in the network see it.
        port: to listen at; 0 takes a free one.
        mbits: speed of the line in Mbit/s, to see how it arrives; as fast as it goes if left out.
    """
    from urllib.parse import quote

    from rich.console import Console

    from freqgs_plugin.commands.options import CommandError
    from freqgs_plugin.stream.manifest import MANIFEST, parse_manifest
    from freqgs_plugin.stream.server import Server

    if mbits is not None and not mbits > 0:
        raise CommandError(f"mbits is {mbits:g}; give a speed above 0, in Mbit/s.")
    if not directory.is_dir():
        raise CommandError(f"{directory} is no folder; name one that `freqgs export --format stream` wrote.")
    # what lies elsewhere is not served
    found = {*directory.glob(MANIFEST), *directory.glob(f"*/{MANIFEST}")}
    manifests = sorted(path for path in found if path.resolve().is_relative_to(directory.resolve()))
    if not manifests:
        raise CommandError(
            f"{directory} holds no {MANIFEST}; name a folder that `freqgs export --format stream` wrote."
        )
    for path in manifests:
        parse_manifest(path.read_bytes(), str(path))
    try:
        server = Server(directory, host, port, mbits)
    except (OSError, OverflowError) as error:
        raise CommandError(
            f"cannot listen at {host}:{port} ({error}); choose another --port, 0 for a free one, or another --host."
        ) from error
    console = Console()
    for path in manifests:
        # a parameter that is an address itself
        below = "" if path.parent == directory else f"/?stream={quote(quote(path.parent.name))}/"
        console.print(f"{server.url}{below}", soft_wrap=True, highlight=False)
    console.print("Stop with Ctrl-C.")
    with server:
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            console.print("Stopped.")
