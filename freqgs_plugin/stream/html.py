"""A scene and the page in one file, which opens without a server."""

import base64
import re
from pathlib import Path

from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.files import folder_for
from freqgs_plugin.stream.scene import StreamScene
from freqgs_plugin.stream.server import PAGE
from freqgs_plugin.stream.write import Stream, StreamOptions, encode_stream, replace_file

MOST_BYTES = 64 * 2**20
"""of chunks: larger files take browsers long to open"""
_SECURITY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; worker-src blob:; img-src data:"


def write_html(scene: StreamScene, path: Path, options: StreamOptions | None = None) -> Stream:
    """Write one self-contained HTML file.

    Raises:
        StreamError: the scene is too large, or cannot be streamed.
        OSError: the file cannot be written.
    """
    stream = encode_stream(scene, options or StreamOptions())
    text = html_text(stream)
    with folder_for(path):
        replace_file(path, text.encode())
    return stream


def html_text(stream: Stream) -> str:
    """The page with its styles, scripts and the stream inside.

    Raises:
        StreamError: it is too large for one file.
    """
    if len(stream.data) > MOST_BYTES:
        smaller = "" if stream.manifest.variant == "small" else ", or choose a smaller variant"
        raise StreamError(
            f"{len(stream.data) / 2**20:.0f} MiB are too much for one HTML file (at most {MOST_BYTES // 2**20}); write "
            f"a stream and serve it (`freqgs serve`){smaller}."
        )
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    page = page.replace(
        '<meta charset="utf-8">',
        f'<meta charset="utf-8">\n<meta http-equiv="Content-Security-Policy" content="{_SECURITY}">',
    )
    page = re.sub(r'<link rel="stylesheet" href="(.*?)">', lambda m: f"<style>\n{_part(m[1])}</style>", page)
    page = re.sub(r'<script src="(.*?)"></script>', lambda m: f"<script>\n{_part(m[1])}</script>", page)
    # no tag can end within: "<" does not occur in base64, and is escaped in the JSON
    inside = "\n".join(
        [
            _inert("manifest", "application/json", stream.manifest.text().replace("<", "\\u003c")),
            _inert("sort-source", "text/plain", _part("sort.js")),
            _inert("splats", "text/plain", base64.b64encode(stream.data).decode()),
        ]
    )
    return page.replace("<script>", f"{inside}\n<script>", 1)


def _part(name: str) -> str:
    text = (PAGE / name).read_text(encoding="utf-8")
    assert "</" not in text, f"{name} would end its element"
    return text


def _inert(identifier: str, kind: str, text: str) -> str:
    return f'<script id="{identifier}" type="{kind}">{text}</script>'
