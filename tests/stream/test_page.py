"""The page in a real browser: its pictures are ours, its controls do what they say, and little stops it."""

import re
import threading
from dataclasses import replace

import pytest
from browsing import ARGUMENTS, CHROMIUM
from playwright.sync_api import sync_playwright
from scene_page import ScenePage, agreement, ours
from scenes_to_stream import breaking, damaging, deaf, served, small_scene, stalling

from freqgs_plugin.stream.client import fetch
from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.html import write_html
from freqgs_plugin.stream.manifest import MANIFEST
from freqgs_plugin.stream.received import Received
from freqgs_plugin.stream.write import StreamOptions, write_stream

pytestmark = pytest.mark.browser
GOAL = 35
"""dB, page against our own pictures"""


@pytest.fixture(scope="module")
def chromium():
    if CHROMIUM is None:
        pytest.skip("no Chromium on the PATH")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stream")
    write_stream(small_scene(), folder, StreamOptions("balanced", 3))
    received = fetch(folder).received
    return folder, received.manifest, received.gaussians()


@pytest.fixture
def visit(chromium, stream):
    """`visit(handler=...)`: a page on a server that behaves so."""
    pages, servers = [], []

    def open_page(*handler, folder=stream[0], **options):
        server = served(folder, *handler)
        servers.append(server)
        pages.append(ScenePage(chromium, server.__enter__().url, **options))
        return pages[-1]

    yield open_page
    for page in pages:
        page.page.context.close()
    for server in servers:
        server.__exit__(None, None, None)


def test_pictures_controls_and_counts(visit, stream):
    _, manifest, gaussians = stream
    page = visit().loaded()
    for level in (1, 2, 3, 1.4):
        picture, drawn = page.capture(level, view=1)
        expected, count = ours(gaussians, manifest, level, view=1)
        assert agreement(picture, expected) > GOAL and drawn == count, level
        assert expected.std() > 0.05
    counts = [level.count for level in manifest.levels]
    assert page.drawn() == sum(counts)
    full = page.page.locator("#canvas").screenshot()
    assert page.slide("level", 1) == counts[0]
    assert page.page.locator("#canvas").screenshot() != full
    assert f"{counts[0]} of {sum(counts)} splats" in page.text()
    assert page.slide("level", 1.5) == sum(counts[:2])
    page.slide("level", 3)
    assert page.slide("budget", 0.5) == round(sum(counts) / 4)
    page.slide("budget", 1)
    # orbit, fly, keys, next view
    mouse = page.page.mouse
    for act in (
        lambda: (mouse.move(100, 40), mouse.down(), mouse.move(160, 60), mouse.up()),
        lambda: mouse.wheel(0, 200),
        lambda: (page.page.locator("#mode").click(), page.page.locator("#canvas").press("KeyW", delay=200)),
        lambda: page.page.locator("#next").click(),
    ):
        before = page.tell("freqgs.eye.eye.join()")
        act()
        page.until(f"freqgs.eye.eye.join() !== '{before}'")
    page.drawn()
    assert re.search(r"\d ms", page.text()) and "view_1.png" in page.text() and not page.complaints
    assert len({url.split("/")[2] for url in page.asked if url.startswith("http")}) == 1


def test_decay(visit, tmp_path):
    write_stream(small_scene(levels=1, decay=True), tmp_path, StreamOptions("fine"))
    received = fetch(tmp_path).received
    page = visit(folder=tmp_path).loaded()
    assert page.page.locator("#scale").is_visible() and not page.page.locator("#level").is_visible()
    drawn = []
    for scale in (0.7, 1.0, 3.0):
        picture, count = page.capture(1, scale)
        expected, reference = ours(received.gaussians(), received.manifest, 1, scale)
        assert agreement(picture, expected) > GOAL and count == reference, scale
        drawn.append(count)
    assert drawn[0] > drawn[1] > drawn[2] > 0
    before = page.drawn()
    assert page.slide("scale", 0.5) < before


def test_half_a_stream_shows_the_base(visit, stream):
    _, manifest, gaussians = stream
    base = [chunk for chunk in manifest.chunks if chunk.level == 1][-1]
    stall = stalling(base.offset + base.bytes + 10)
    page = visit(stall)
    page.until(f"freqgs.received.chunks === {manifest.chunks.index(base) + 1}")
    picture, drawn = page.capture()
    expected, count = ours(gaussians, manifest, 1)
    assert agreement(picture, expected) > GOAL and drawn == count
    assert "% received" in page.text()
    stall.go.set()
    page.loaded()
    assert page.capture()[1] == len(gaussians)


def test_part_of_the_base_is_drawn_larger(visit, tmp_path):
    manifest = write_stream(small_scene(4000, levels=1), tmp_path, StreamOptions("balanced"))
    first, received = manifest.chunks[0], Received(manifest)
    received.add(first, (tmp_path / manifest.data).read_bytes()[: first.bytes])
    part = received.gaussians()
    stall = stalling(first.bytes + 10)
    page = visit(stall, folder=tmp_path)
    page.until("freqgs.received.chunks === 1")
    picture, drawn = page.capture()
    assert agreement(picture, ours(part, manifest)[0]) > GOAL and drawn == first.count
    assert first.enlarge > 1
    smaller = replace(part, scales=part.scales / first.enlarge)
    assert agreement(picture, ours(smaller, manifest)[0]) < GOAL
    stall.go.set()
    picture, _ = page.loaded().capture()
    assert agreement(picture, ours(fetch(tmp_path).received.gaussians(), manifest)[0]) > GOAL


def test_on_a_phone(visit, stream):
    page = visit(size=(360, 640), touch=True).loaded()
    box = page.page.locator("#panel").bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["y"] > 320 and box["y"] + box["height"] <= 640
    assert page.tell("document.documentElement.scrollWidth") == 360
    page.page.locator("#fold").tap()
    assert page.page.locator("#panel").bounding_box()["height"] < 60


def whole(page, stream):
    picture, drawn = page.loaded().capture()
    expected, _ = ours(stream[2], stream[1])
    return drawn == len(stream[2]) and agreement(picture, expected) > GOAL


def test_broken_lines_damage_and_deaf_servers(visit, stream):
    _, manifest, _ = stream
    read = threading.Event()
    handler = breaking(manifest.chunks[4].offset + 7, 1, lambda: read.wait(60))
    page = visit(handler)
    page.until("freqgs.received?.chunks === 4")
    read.set()
    assert whole(page, stream) and not page.tell("freqgs.problem")
    asked = [range_ for path, range_ in handler.asked if path.endswith(".bin")]
    assert len(asked) == 2 and asked[1].startswith(f"bytes={manifest.chunks[4].offset}-")
    for handler in (damaging(manifest.chunks[2].offset + 3, 1), deaf()):
        page = visit(handler)
        assert whole(page, stream) and not page.tell("freqgs.problem"), handler


def test_what_stays_damaged_is_reported_and_the_rest_shown(visit, stream):
    _, manifest, gaussians = stream
    chunk = next(c for c in manifest.chunks if (c.level, c.part) == (2, "core"))
    handler = damaging(chunk.offset + 3, 3)
    page = visit(handler).loaded()
    assert f"1 of {len(manifest.chunks)} parts arrived damaged" in page.text()
    assert page.capture()[1] == len(gaussians) - chunk.count
    # by now the file is right again
    page.page.locator("#again").click()
    page.until("freqgs.received.chunks === freqgs.manifest.chunks.length")
    assert whole(page, stream)


@pytest.mark.parametrize(
    ("text", "said"), [('{"format": "else", "version": 3}', "else of version 3"), ("{", "is damaged"), (None, "404")]
)
def test_no_stream_is_said_so(visit, tmp_path, text, said):
    if text is not None:
        (tmp_path / MANIFEST).write_text(text)
    page = visit(folder=tmp_path)
    page.until("freqgs.problem")
    assert said in page.text() and "Nothing can be shown" in page.text()


def test_one_file_needs_no_server(chromium, stream, tmp_path):
    scene = small_scene()
    named = replace(scene, shown=[("</script>", camera) for _, camera in scene.shown])
    write_html(named, tmp_path / "scene.html", StreamOptions("balanced", 3))
    page = ScenePage(chromium, (tmp_path / "scene.html").as_uri())
    assert whole(page, stream) and not page.complaints
    assert [url for url in page.asked if url.startswith("http")] == []
    page.page.context.close()


def test_too_large_for_one_file(tmp_path, monkeypatch):
    monkeypatch.setattr("freqgs_plugin.stream.html.MOST_BYTES", 1000)
    with pytest.raises(StreamError, match="freqgs serve"):
        write_html(small_scene(), tmp_path / "scene.html")
    assert list(tmp_path.iterdir()) == []
