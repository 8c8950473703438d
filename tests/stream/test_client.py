"""The reader and the server, over loopback, with everything going wrong that can."""

import urllib.error
import urllib.request
from dataclasses import replace

import pytest
import torch
from scenes_to_stream import Recording, breaking, damaging, deaf, served, small_scene

from freqgs_plugin.stream.client import Patience, fetch
from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.manifest import MANIFEST
from freqgs_plugin.stream.server import Throttle, byte_range
from freqgs_plugin.stream.write import StreamOptions, write_stream

SOON = Patience(breaks=2, pause=0.01, timeout=5.0)


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stream")
    return folder, write_stream(replace(small_scene(1500), cameras=()), folder, StreamOptions("fine", 3))


@pytest.fixture(scope="module")
def expected(stream):
    return fetch(stream[0]).received.gaussians()


def same(fetched, expected):
    found = fetched.received.gaussians()
    return torch.equal(found.means, expected.means) and torch.equal(found.features_rest, expected.features_rest)


def test_one_request_brings_it_all(stream, expected):
    folder, manifest = stream
    recording = type("R", (Recording,), {"asked": []})
    seen = []
    with served(folder, recording) as server:
        fetched = fetch(server.url, patience=SOON, arrived=lambda chunk, _: seen.append(chunk))
    assert same(fetched, expected) and fetched.complete and not fetched.problems()
    assert recording.asked[1:] == [(f"/{manifest.data}", f"bytes=0-{manifest.bytes - 1}")]
    assert seen == list(manifest.chunks)
    assert fetched.bytes == manifest.bytes + len(manifest.text())


def test_a_server_that_ignores_ranges(stream, expected, tmp_path):
    folder, manifest = stream
    with served(folder, deaf()) as server:
        assert same(fetch(server.url, patience=SOON), expected)
    # what is there already is passed over
    half = manifest.chunks[len(manifest.chunks) // 2]
    (tmp_path / f".{manifest.data}.part").write_bytes((folder / manifest.data).read_bytes()[: half.offset])
    with served(folder, deaf()) as server:
        fetched = fetch(server.url, folder=tmp_path, patience=SOON)
    assert same(fetched, expected) and fetched.ranges_ignored and fetched.resumed == half.offset


def test_a_line_that_breaks_goes_on_where_it_was(stream, expected):
    folder, manifest = stream
    handler = breaking(manifest.chunks[3].offset + 5, 2)
    with served(folder, handler) as server:
        fetched = fetch(server.url, patience=SOON)
    assert same(fetched, expected) and fetched.breaks == 2
    starts = [int(asked.split("=")[1].split("-")[0]) for path, asked in handler.asked if path.endswith(".bin")]
    assert starts[0] == 0 and starts[1] == manifest.chunks[3].offset < starts[2]


def test_a_line_that_stays_broken_is_reported_and_resumed(stream, expected, tmp_path):
    folder, manifest = stream
    with (
        served(folder, breaking(manifest.chunks[2].offset + 1, -1)) as server,
        pytest.raises(StreamError, match=r"broke 3 times in a row .* of \d+ chunks arrived"),
    ):
        # never more than two chunks: from the third on, the first of the rest is larger than what comes through
        fetch(server.url, folder=tmp_path, patience=SOON, arrived=_stop_after(server, 2))
    with served(folder) as server:
        fetched = fetch(server.url, folder=tmp_path, patience=SOON)
    assert fetched.resumed >= manifest.chunks[2].offset and same(fetched, expected)
    assert sorted(p.name for p in tmp_path.iterdir()) == [MANIFEST, manifest.data]
    again = fetch(str(tmp_path), folder=str(tmp_path))
    assert again.resumed == manifest.bytes


def _stop_after(server, count):
    """From the chunk after so many on nothing comes through."""
    seen = []

    def arrived(chunk, _):
        seen.append(chunk)
        if len(seen) == count:
            server.RequestHandlerClass._send = lambda self, stream, rest: self.connection.shutdown(2)

    return arrived


@pytest.mark.parametrize(("times", "stays"), [(1, False), (-1, True)])
def test_a_damaged_chunk_is_asked_for_again(stream, expected, times, stays):
    folder, manifest = stream
    with served(folder, damaging(manifest.chunks[1].offset + 3, times)) as server:
        fetched = fetch(server.url, patience=SOON)
    assert fetched.damaged == ([1] if stays else [])
    if stays:
        assert fetched.problems().startswith(f"1 of {len(manifest.chunks)} chunks stayed damaged")
        assert fetched.received.count == manifest.count - manifest.chunks[1].count
    else:
        assert same(fetched, expected)


def test_errors_say_what_to_do(stream, tmp_path):
    manifest = stream[1]
    with pytest.raises(StreamError, match="freqgs export --format stream"):
        fetch(tmp_path)
    with served(tmp_path) as server:
        with pytest.raises(StreamError, match=r"404 .*name the address"):
            fetch(server.url, patience=SOON)
        (tmp_path / MANIFEST).write_text("{}")
        with pytest.raises(StreamError, match="no manifest"):
            fetch(server.url, patience=SOON)
        (tmp_path / MANIFEST).write_text(manifest.text())
        (tmp_path / manifest.data).write_bytes(b"")
        with pytest.raises(StreamError, match=r"416 .*shorter than its manifest"):
            fetch(server.url, patience=SOON)
    with pytest.raises(StreamError, match="is the server up"):
        fetch("http://127.0.0.1:9", patience=SOON)


@pytest.mark.parametrize(
    ("asked", "found"),
    [("bytes=0-9", (0, 10)), ("bytes=90-", (90, 100)), ("bytes=-5", (95, 100)), ("bytes=50-999", (50, 100)),
     ("bytes=100-", (100, 100)), ("bytes=5-2", None), ("bytes=0-1,4-5", None), ("lines=1-2", None), ("bytes=-", None)],
)  # fmt: skip
def test_ranges(asked, found):
    assert byte_range(asked, 100) == found


def test_the_server_serves_its_folder_and_nothing_else(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "in" / "link").symlink_to(tmp_path / "secret")
    with served(tmp_path / "in") as server:
        for path in ("/link", "/../secret", "/%2e%2e/secret", "/nothing", "/../server.py"):
            with pytest.raises(urllib.error.HTTPError, match=r"404"):
                urllib.request.urlopen(server.url + path)
        with urllib.request.urlopen(server.url) as page:
            assert "default-src 'none'" in page.headers["Content-Security-Policy"]
            assert b"<canvas" in page.read()


def test_a_slow_line_takes_its_time():
    import time

    throttle, start = Throttle(8.0), time.monotonic()
    for _ in range(10):
        throttle.wait(5000)
    assert time.monotonic() - start >= 0.049
