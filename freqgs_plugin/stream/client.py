"""A reader that fetches a stream by ranges of bytes, and gets by with lines that break and bytes that are wrong."""

import http.client
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from freqgs_plugin.stream.chunks import checksum
from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.manifest import MANIFEST, Chunk, Manifest, parse_manifest
from freqgs_plugin.stream.received import Received

_BROKEN = (OSError, http.client.HTTPException)
Arrived = Callable[[Chunk, int], object]
"""called with each chunk that is right, and the bytes received so far"""


@dataclass
class Fetched:
    """What was fetched, and what went wrong."""

    received: Received
    bytes: int = 0
    """over the line, with the manifest and with what was sent twice"""
    resumed: int = 0
    """bytes that were there from before"""
    breaks: int = 0
    """times that the line broke"""
    ranges_ignored: bool = False
    damaged: list[int] = field(default_factory=list)
    """chunks that stayed wrong"""

    @property
    def complete(self) -> bool:
        return not self.damaged

    def problems(self) -> str:
        """One line; empty where nothing is missing."""
        if self.complete:
            return ""
        chunks = self.received.manifest.chunks
        count = len(self.damaged)
        places = ", ".join(f"{chunks[i].offset:,}" for i in self.damaged[:3])
        return (
            f"{count} of {len(chunks)} chunks stayed damaged (at byte {places}{' ...' if count > 3 else ''}); the rest "
            "is shown. Write the stream anew, or copy it to the server again."
        )


@dataclass(frozen=True)
class Patience:
    """How long to try."""

    breaks: int = 5
    """times in a row that a line may break without a chunk having arrived"""
    damages: int = 3
    """times that a chunk may arrive damaged"""
    pause: float = 0.5
    """seconds before the second try; doubled with each further one"""
    timeout: float = 20.0
    """seconds without a byte after which a line counts as broken"""


def fetch(
    source: str | Path,
    *,
    folder: str | Path | None = None,
    patience: Patience | None = None,
    arrived: Arrived | None = None,
) -> Fetched:
    """Fetch a stream from the URL or path of its folder.

    With `folder` it is kept there, and what an earlier, interrupted call left there is not fetched again.

    Raises:
        StreamError: no manifest, the server refuses, or the line stays broken; the message says how much arrived.
    """
    patience = patience or Patience()
    line = _Line(source, patience)
    text = _patiently(line, patience)
    manifest = parse_manifest(text, f"{source}/{MANIFEST}")
    fetched = Fetched(Received(manifest), bytes=len(text))
    store = None if folder is None else _Store(Path(folder), manifest)
    missing = list(range(len(manifest.chunks)))
    if store is not None:
        for index, data in store.kept():
            fetched.received.add(manifest.chunks[index], data)
            fetched.resumed += len(data)
            missing.remove(index)
            if arrived is not None:
                arrived(manifest.chunks[index], fetched.bytes)
    try:
        _fetch_chunks(line, missing, fetched, store, patience, arrived)
    finally:
        if store is not None:
            store.close()
    if store is not None and fetched.complete:
        store.finish(text)
    return fetched


def _patiently(line: "_Line", patience: Patience) -> bytes:
    for attempt in range(patience.breaks + 1):
        try:
            with line.open(MANIFEST, 0, None)[0] as stream:
                return stream.read()
        except _BROKEN as error:
            if attempt == patience.breaks:
                raise StreamError(f"{line.source}/{MANIFEST} cannot be fetched ({error}); is the server up?") from error
            time.sleep(patience.pause * 2**attempt)
    raise AssertionError


def _fetch_chunks(
    line: "_Line",
    missing: list[int],
    fetched: Fetched,
    store: "_Store | None",
    patience: Patience,
    arrived: Arrived | None,
) -> None:
    manifest = fetched.received.manifest
    chunks = manifest.chunks
    breaks, damages = 0, dict.fromkeys(missing, 0)
    while missing:
        run = _first_run(missing)
        try:
            for index, data in line.read(manifest, run, fetched):
                if checksum(data) != chunks[index].crc32:
                    damages[index] += 1
                    # to the end: what follows it is drawn first
                    missing.remove(index)
                    (fetched.damaged if damages[index] >= patience.damages else missing).append(index)
                    continue
                fetched.received.add(chunks[index], data)
                if store is not None:
                    store.put(chunks[index], data)
                missing.remove(index)
                breaks = 0
                if arrived is not None:
                    arrived(chunks[index], fetched.bytes)
        except _BROKEN as error:
            fetched.breaks += 1
            breaks += 1
            if breaks > patience.breaks:
                have = len(chunks) - len(missing)
                raise StreamError(
                    f"the line to {line.source} broke {breaks} times in a row ({error}); {have} of {len(chunks)} "
                    "chunks arrived. Try again later; with a folder to keep it, what has arrived is not fetched again."
                ) from error
            time.sleep(patience.pause * 2 ** (breaks - 1))


def _first_run(missing: list[int]) -> list[int]:
    """The first missing chunk and those that follow it without a gap."""
    run = [missing[0]]
    for index in missing[1:]:
        if index != run[-1] + 1:
            break
        run.append(index)
    return run


class _Line:
    """A URL or a folder."""

    def __init__(self, source: str | Path, patience: Patience):
        self.source = str(source).rstrip("/")
        self._remote = self.source.startswith(("http://", "https://"))
        self._timeout = patience.timeout

    def open(self, name: str, start: int, end: int | None) -> tuple[IO[bytes] | http.client.HTTPResponse, int]:
        """The bytes `start` to `end` (exclusive) of a file, and where what is read begins.

        Raises:
            StreamError: the server refuses.
        """
        if not self._remote:
            path = Path(self.source) / name
            if not path.is_file():
                raise StreamError(
                    f"{path} is no file; name the folder of a stream (`freqgs export --format stream` writes one)."
                )
            stream = path.open("rb")
            stream.seek(start)
            return stream, start
        headers = {} if end is None else {"Range": f"bytes={start}-{end - 1}"}
        request = urllib.request.Request(f"{self.source}/{name}", headers=headers)
        try:
            response = urllib.request.urlopen(request, timeout=self._timeout)
        except urllib.error.HTTPError as error:
            if error.code >= 500 or error.code in (408, 429):
                raise
            remedy = "the file on the server is shorter than its manifest says; copy the stream there again"
            if error.code != 416:
                remedy = "name the address of a stream's folder"
            raise StreamError(f"{self.source}/{name}: {error.code} {error.reason}; {remedy}.") from error
        return response, start if response.status == 206 else 0

    def read(self, manifest: Manifest, run: list[int], fetched: Fetched) -> Iterator[tuple[int, bytes]]:
        """The chunks of `run`, one after the other.

        Raises:
            OSError, http.client.HTTPException: the line broke.
        """
        chunks = manifest.chunks
        start, end = chunks[run[0]].offset, chunks[run[-1]].offset + chunks[run[-1]].bytes
        stream, position = self.open(manifest.data, start, end)
        with stream:
            if position != start:
                fetched.ranges_ignored = True
                fetched.bytes += len(_exactly(stream, start))
            for index in run:
                data = _exactly(stream, chunks[index].bytes)
                fetched.bytes += len(data)
                yield index, data


def _exactly(stream: IO[bytes] | http.client.HTTPResponse, count: int) -> bytes:
    found = bytearray()
    while len(found) < count:
        block = stream.read(count - len(found))
        if not block:
            raise ConnectionError(f"it ended {count - len(found):,} bytes early")
        found += block
    return bytes(found)


class _Store:
    """A folder in which a stream is kept as it arrives."""

    def __init__(self, folder: Path, manifest: Manifest):
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._manifest = folder, manifest
        done = folder / manifest.data
        self._partial = done if done.is_file() else folder / f".{manifest.data}.part"
        self._partial.touch()
        self._file = self._partial.open("r+b")
        self._file.truncate(manifest.bytes)

    def kept(self) -> Iterator[tuple[int, bytes]]:
        """Chunks that are there and right."""
        for index, chunk in enumerate(self._manifest.chunks):
            self._file.seek(chunk.offset)
            data = self._file.read(chunk.bytes)
            if checksum(data) == chunk.crc32:
                yield index, data

    def put(self, chunk: Chunk, data: bytes) -> None:
        self._file.seek(chunk.offset)
        self._file.write(data)

    def close(self) -> None:
        self._file.close()

    def finish(self, manifest: bytes) -> None:
        """Everything is there: the names under which it can be served."""
        os.replace(self._partial, self._folder / self._manifest.data)
        partial = self._folder / f".{MANIFEST}.part"
        partial.write_bytes(manifest)
        os.replace(partial, self._folder / MANIFEST)
