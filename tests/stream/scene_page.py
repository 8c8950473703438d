"""Opens the page in a browser, and compares its pictures with ours. As a program: screenshots and a table."""

import argparse
import base64
import io
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from freqgs_plugin.functional.attenuation import DistanceDecay, LevelCut, Product
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.stream.client import fetch
from freqgs_plugin.stream.manifest import Manifest
from freqgs_plugin.types import Camera

CAPTURE = """async ([view, level, scale, budget]) => {
  const found = await freqgs.capture(freqgs.manifest.views[view], { level, scale, budget });
  const { pixels } = found;
  let text = "";
  for (let i = 0; i < pixels.length; i += 8192) text += String.fromCharCode(...pixels.subarray(i, i + 8192));
  return [btoa(text), found.drawn];
}"""
"""pixels as base64, and how many Gaussians were drawn"""


class ScenePage:
    """The page at an address; what it complains about is kept."""

    def __init__(self, browser, url, size=(480, 320), touch=False):
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, has_touch=touch)
        self.page = context.new_page()
        self.complaints, self.asked = [], []
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type in ("error", "warning") else None)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(url)

    def tell(self, expression):
        return self.page.evaluate(expression)

    def until(self, expression, patience=60):
        """Poll: the page's policy forbids what playwright would wait with."""
        end = time.monotonic() + patience
        while not (found := self.tell(expression)):
            assert time.monotonic() < end, f"waited {patience} s for {expression}; {self.text()} {self.complaints}"
            time.sleep(0.03)
        return found

    def loaded(self):
        self.until("!!freqgs.done")
        return self

    def drawn(self):
        """Wait for the picture of what is set."""
        self.until("!freqgs.dirty && freqgs.sorts.asked === freqgs.sorts.done && !freqgs.redraw && !freqgs.held")
        return self.tell("freqgs.drawn")

    def text(self):
        return self.page.locator("#panel").inner_text()

    def slide(self, name, value):
        """Move a slider as a user does."""
        slider = self.page.locator(f"#{name}")
        slider.evaluate("(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", value)
        return self.drawn()

    def capture(self, level=99, scale=1.0, budget=10**9, view=0):
        """A view's picture at its own size, [h, w, 3] in [0, 1], and how many Gaussians it shows."""
        text, drawn = self.page.evaluate(CAPTURE, [view, level, scale, budget])
        height, width = self.tell(f"(v => [v.height, v.width])(freqgs.manifest.views[{view}])")
        pixels = np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)
        return pixels[::-1, :, :3] / 255, drawn


def ours(gaussians, manifest: Manifest, level=99, scale=1.0, view=0):
    """Our picture of the same, as it is stored, and how many Gaussians it shows."""
    v = manifest.views[view]
    viewmat, K = (torch.tensor(v[key], dtype=torch.float32).reshape(n, n) for key, n in (("viewmat", 4), ("K", 3)))
    camera = Camera(viewmat, K, v["width"], v["height"])
    parts = [LevelCut(level)]
    if manifest.scene_distance is not None:
        parts.append(DistanceDecay(scale, "scene", manifest.scene_distance))
    with torch.no_grad():
        rendering = render(
            gaussians,
            camera,
            Product(tuple(parts)),
            rasterizer=get_rasterizer("numba", "cpu", absgrad=False),
            background=torch.tensor(manifest.background),
            antialiased=manifest.antialiased,
            depth=False,
        )
    return np.round(rendering.features.clamp(0, 1).numpy() * 255) / 255, rendering.info["drawn"]


def agreement(a, b):
    """PSNR, dB."""
    return float(-10 * np.log10(max(((a - b) ** 2).mean(), 1e-12)))


def shoot(page, path):
    page.drawn()
    # the first picture compiles
    page.tell("freqgs.milliseconds = 0, freqgs.touch()")
    page.drawn()
    page.until("freqgs.milliseconds > 0")
    data = io.BytesIO(page.page.screenshot())
    Image.open(data).convert("RGB").save(path, quality=88, optimize=True)


def compare(browser, name, folder):
    """Rows of the table of agreement, at the levels and scales that the scene has."""
    from scenes_to_stream import served

    fetched = fetch(folder)
    manifest, gaussians = fetched.received.manifest, fetched.received.gaussians()
    top = manifest.levels[-1].level
    looks = [(k, 1.0) for k in range(1, top + 1)] + ([(1.5, 1.0)] if top > 1 else [])
    looks += [] if manifest.scene_distance is None else [(1, 2.0), (1, 8.0)]
    rows = []
    with served(folder) as server:
        page = ScenePage(browser, server.url).loaded()
        for level, scale in looks:
            picture, drawn = page.capture(level, scale)
            expected, count = ours(gaussians, manifest, level, scale)
            rows.append({"scene": name, "level": level, "scale": scale, "drawn": drawn, "ours": count,
                         "psnr": agreement(picture, expected), "largest": float(np.abs(picture - expected).max() * 255),
                         })  # fmt: skip
        page.page.context.close()
    return rows


def main():
    """Screenshots of the first folder, and the table of all."""
    from browsing import ARGUMENTS, CHROMIUM
    from playwright.sync_api import sync_playwright
    from scenes_to_stream import served, stalling

    from freqgs_plugin.reports.bench.page import fill, table_text
    from freqgs_plugin.reports.bench.tables import BenchTable
    from freqgs_plugin.reports.timing import environment

    parser = argparse.ArgumentParser()
    parser.add_argument("--docs", type=Path, required=True, help="streaming.md")
    parser.add_argument("streams", nargs="+", help="NAME=FOLDER")
    options = parser.parse_args()
    streams = [(s.split("=")[0], Path(s.split("=")[1])) for s in options.streams]
    images = options.docs.parent / "images"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        rows = [row for name, folder in streams for row in compare(browser, name, folder)]
        version = browser.version
        folder = streams[0][1]
        with served(folder) as server:
            shoot(ScenePage(browser, server.url, (1100, 680)).loaded(), images / "stream_page.jpg")
            shoot(ScenePage(browser, server.url, (390, 700), touch=True).loaded(), images / "stream_phone.jpg")
        base = [c for c in fetch(folder).received.manifest.chunks if c.level == 1][-1]
        handler = stalling(base.offset + base.bytes)
        with served(folder, handler) as server:
            page = ScenePage(browser, server.url, (1100, 680))
            page.until(f"freqgs.received.rows >= {base.first + base.count}")
            shoot(page, images / "stream_base.jpg")
            handler.go.set()
        browser.close()
    table = BenchTable(
        "stream-page",
        "The page's pictures against ours",
        rows,
        [
            ("scene", lambda row: row["scene"]),
            ("level", lambda row: f"{row['level']:g}"),
            ("s_v", lambda row: f"{row['scale']:g}"),
            ("drawn by the page", lambda row: f"{row['drawn']:,}"),
            ("drawn by us", lambda row: f"{row['ours']:,}"),
            ("PSNR, dB", lambda row: f"{row['psnr']:.1f}"),
            ("largest difference, of 255", lambda row: f"{row['largest']:.0f}"),
        ],
        f"First view at its own size, 8 bits, headless Chromium {version} with SwiftShader, both from the same stream. "
        "The page cuts nothing but what is fainter than 1/255; we stop at pixels that let through less than 1e-4.",
    )
    record = {**environment(), "load": "-", "quick": False}
    record["command"] = "python tests/stream/scene_page.py --docs docs/streaming.md NAME=FOLDER ..."
    options.docs.write_text(fill(options.docs.read_text("utf-8"), "stream-page", table_text(table, record)), "utf-8")


if __name__ == "__main__":
    import sys

    sys.path[:0] = [str(Path(__file__).parents[1] / folder) for folder in ("reports", "studio")]
    main()
