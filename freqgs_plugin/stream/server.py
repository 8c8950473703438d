"""A small web server for trying a stream: files with ranges, the page, and a line that can be made slow."""

import os
import re
import threading
import time
from collections.abc import Mapping
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote, urlsplit

PAGE = Path(__file__).parent / "page"
BLOCK = 4096
"""bytes sent at once"""
SECURITY = "default-src 'none'; img-src data:; " + "; ".join(
    f"{kind}-src 'self'" for kind in ("script", "style", "connect", "worker")
)
"""the page may talk to nobody but its own server"""
_TYPES: Mapping[str, str] = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
}


class Throttle:
    """A line of so many Mbit/s that all connections share; None: as fast as it goes."""

    def __init__(self, mbits: float | None):
        self._seconds_per_byte = 0.0 if mbits is None else 8 / (mbits * 1e6)
        self._lock, self._free = threading.Lock(), 0.0

    def wait(self, count: int) -> None:
        """Return when `count` more bytes are through."""
        if self._seconds_per_byte == 0:
            return
        with self._lock:
            self._free = max(self._free, time.monotonic()) + count * self._seconds_per_byte
            until = self._free
        time.sleep(max(0.0, until - time.monotonic()))


class Handler(SimpleHTTPRequestHandler):
    """GET and HEAD, with `Range: bytes=a-b`, `a-` and `-n`. `/` and the page's files are the package's."""

    server: "Server"
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._answer(send=True)

    def do_HEAD(self) -> None:
        self._answer(send=False)

    def _answer(self, send: bool) -> None:
        path = self._file()
        if path is None:
            return self.send_error(HTTPStatus.NOT_FOUND, "There is no such file")
        try:
            stream = path.open("rb")
        except OSError:
            return self.send_error(HTTPStatus.NOT_FOUND, "There is no such file")
        with stream:
            size = os.fstat(stream.fileno()).st_size
            asked = self.headers.get("Range")
            wanted = None if asked is None else byte_range(asked, size)
            if wanted is None:
                start, end = 0, size
                self.send_response(HTTPStatus.OK)
            elif wanted[0] >= wanted[1]:
                self.send_response(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                self.send_header("Content-Range", f"bytes */{size}")
                self.send_header("Content-Length", "0")
                return self.end_headers()
            else:
                start, end = wanted
                self.send_response(HTTPStatus.PARTIAL_CONTENT)
                self.send_header("Content-Range", f"bytes {start}-{end - 1}/{size}")
            self.send_header("Content-Type", _TYPES.get(path.suffix, "application/octet-stream"))
            self.send_header("Content-Length", str(end - start))
            self.send_header("Accept-Ranges", "bytes")
            self.send_header("Cache-Control", "no-cache")
            self.send_header("Content-Security-Policy", SECURITY)
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            if send:
                stream.seek(start)
                self._send(stream, end - start)

    def _send(self, stream: BinaryIO, count: int) -> None:
        try:
            while count > 0:
                block = stream.read(min(BLOCK, count))
                if not block:
                    break
                self.server.throttle.wait(len(block))
                self.wfile.write(block)
                count -= len(block)
        except (BrokenPipeError, ConnectionResetError):
            # the reader has left
            self.close_connection = True

    def _file(self) -> Path | None:
        name = unquote(urlsplit(self.path).path)
        if "\0" in name:
            return None
        page = PAGE / ("index.html" if name == "/" else name.lstrip("/"))
        if page.parent == PAGE and page.is_file():
            return page
        # only what lies in the folder, links out of it excluded
        path = (self.server.folder / name.lstrip("/")).resolve()
        return path if path.is_file() and path.is_relative_to(self.server.folder) else None

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal belongs to the command."""


class Server(ThreadingHTTPServer):
    """Serves `folder` and the page at `http://host:port`; port 0 takes a free one."""

    daemon_threads = True

    def __init__(
        self,
        folder: Path,
        host: str = "127.0.0.1",
        port: int = 0,
        mbits: float | None = None,
        handler: type[Handler] = Handler,
    ):
        self.folder, self.throttle = folder.resolve(), Throttle(mbits)
        super().__init__((host, port), handler)

    @property
    def url(self) -> str:
        """Where the page is."""
        host, port = self.server_address[:2]
        return f"http://{'127.0.0.1' if host in ('0.0.0.0', '::') else host}:{port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Readers that leave are nothing to report."""


def byte_range(asked: str, size: int) -> tuple[int, int] | None:
    """First byte and one past the last; an empty range cannot be satisfied. None: not one range, to be ignored."""
    match = re.fullmatch(r"bytes=(\d*)-(\d*)", asked.strip())
    if match is None or not (match[1] or match[2]):
        return None
    if not match[1]:
        return max(0, size - int(match[2])), size
    start = int(match[1])
    end = min(int(match[2]) + 1, size) if match[2] else size
    if match[2] and int(match[2]) < start:
        return None
    return (start, end) if start < size else (size, size)
