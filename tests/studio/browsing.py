"""Starts `ns-viewer` and opens its page in a browser. As a program: writes a screenshot of a trained run."""

import io
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = [
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"),
    *("--disable-background-networking", "--disable-dev-shm-usage"),
]
WINDOW = {"width": 1280, "height": 720}
PANEL = 330
"""px at the right edge that belong to the controls"""
PATIENCE = 90
"""seconds for anything to happen"""
DRAWN = re.compile(r"^([\d,]+) / ([\d,]+), (\d+) ms$")


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def wait_until(true, what, patience=PATIENCE):
    end = time.monotonic() + patience
    while time.monotonic() < end:
        found = true()
        if found:
            return found
        time.sleep(0.2)
    raise TimeoutError(f"waited {patience} s for {what}")


def listening(port):
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True


class Viewer:
    """An `ns-viewer` process; use as a context."""

    def __init__(self, config, log):
        self.port = free_port()
        self._log = log
        program = Path(sys.executable).with_name("ns-viewer")
        command = [str(program if program.exists() else shutil.which("ns-viewer")), "--load-config", str(config)]
        command += ["--viewer.websocket-port", str(self.port), "--viewer.websocket-host", "127.0.0.1"]
        with log.open("w") as file:
            self._child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, start_new_session=True
            )

    def __enter__(self):
        def up():
            assert self._child.poll() is None, self._log.read_text()
            return listening(self.port)

        wait_until(up, "ns-viewer")
        return self

    def __exit__(self, *_):
        os.killpg(self._child.pid, signal.SIGTERM)
        try:
            self._child.wait(10)
        except subprocess.TimeoutExpired:
            os.killpg(self._child.pid, signal.SIGKILL)
            self._child.wait()


class Page:
    """What a user sees and does on the viewer's page."""

    def __init__(self, browser, port, slider="Level of detail", largest=3):
        self._largest = largest
        self.page = browser.new_page(viewport=WINDOW)
        # the page asks for a logo on the internet
        local = f"127.0.0.1:{port}"
        self.page.route("**/*", lambda route: route.continue_() if local in route.request.url else route.abort())
        self.page.goto(f"http://{local}")
        self.page.wait_for_selector(f"text={slider}", timeout=PATIENCE * 1000)

    def drawn(self):
        """Gaussians drawn, of how many, and the text; None before the first picture."""
        for element in self.page.query_selector_all("input"):
            match = DRAWN.match(element.input_value())
            if match:
                return (*(int(match[k].replace(",", "")) for k in (1, 2)), match[0])
        return None

    def settled(self, count):
        """Wait for `count` drawn Gaussians and the last, full picture of them, after which nothing is drawn again."""

        def quiet():
            before = self.drawn()
            if before is None or before[0] != count:
                return False
            self.page.wait_for_timeout(1500)
            return self.drawn() == before and before

        return wait_until(quiet, f"{count} Gaussians to be drawn; it says {self.drawn()}")

    def picture(self, path):
        """The rendered part of the page."""
        clip = {"x": 0, "y": 60, "width": WINDOW["width"] - PANEL, "height": WINDOW["height"] - 60}
        data = self.page.screenshot(clip=clip)
        path.write_bytes(data)
        self.page.screenshot(path=path.with_name(f"page_{path.name}"))
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(float)

    def slide(self, share):
        """Drag the slider's thumb to `share` of its way."""
        thumb = self.page.locator(f'[role="slider"][aria-valuemin="1"][aria-valuemax="{self._largest}"]')
        thumb.scroll_into_view_if_needed()
        box = thumb.bounding_box()
        track = thumb.locator("xpath=..").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(track["x"] + share * track["width"], y, steps=5)
        self.page.mouse.up()
        return float(thumb.get_attribute("aria-valuenow"))

    def choose_output(self, name):
        """Pick an output from the list; returns the list."""
        field = self.page.get_by_label("Output type").first
        field.scroll_into_view_if_needed()
        field.click()
        option = self.page.get_by_role("option", name=name, exact=True)
        option.wait_for()
        names = [o.inner_text() for o in self.page.get_by_role("option").all() if o.is_visible()]
        option.click()
        return names


def screenshot(config, target):
    """The whole page of `ns-viewer` on the run of `config`, as the viewer shows it first."""
    with sync_playwright() as playwright, Viewer(config, Path(target).with_suffix(".log")) as viewer:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = Page(browser, viewer.port)
        count = wait_until(page.drawn, "a picture")[0]
        page.settled(count)
        page.page.get_by_text("Level of detail", exact=True).scroll_into_view_if_needed()
        page.page.screenshot(path=target)
        browser.close()


if __name__ == "__main__":
    screenshot(Path(sys.argv[1]), Path(sys.argv[2]))
