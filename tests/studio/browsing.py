"""Starts `ns-viewer` and opens its page in a browser. As a program: writes screenshots of a trained run."""

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
PATIENCE = 180
"""seconds for anything to happen"""
DRAWN = re.compile(r"^([\d,]+) / ([\d,]+), (\d+) ms$")
FULL = "Resolution: 512x"
"""what the page says of a picture of full size; nerfstudio draws a smaller one first"""


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

        try:
            wait_until(up, "ns-viewer")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        if self._child.poll() is not None:
            return
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
            if before is None or before[0] != count or not self.full():
                return False
            self.page.wait_for_timeout(1500)
            return self.drawn() == before and before

        return wait_until(quiet, f"{count} Gaussians to be drawn; it says {self.drawn()}")

    def full(self):
        """Whether the picture is the one of full size."""
        return FULL in self.page.locator("body").inner_text()

    def look(self):
        """The rendered part of the page."""
        clip = {"x": 0, "y": 60, "width": WINDOW["width"] - PANEL, "height": WINDOW["height"] - 60}
        data = self.page.screenshot(clip=clip)
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(float)

    def picture(self, path):
        """The same, and it is kept, with the whole page beside it."""
        self.page.screenshot(path=path.with_name(f"page_{path.name}"))
        found = self.look()
        Image.fromarray(found.astype(np.uint8)).save(path)
        return found

    def note(self):
        """What the panel says about its controls, as one line."""
        return " ".join(self.page.locator("p:visible").all_inner_texts())

    def shows(self, label):
        """Whether there is a control with this label."""
        return self.page.get_by_text(label, exact=True).first.is_visible()

    def choose(self, label, option):
        """Pick an option of a drop-down list."""
        field = self.page.get_by_label(label, exact=True).first
        field.scroll_into_view_if_needed()
        field.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def enter(self, label, value):
        """Type a number."""
        field = self.page.get_by_label(label, exact=True).first
        field.scroll_into_view_if_needed()
        field.fill(str(value))
        field.press("Enter")

    def write(self, label, text):
        """Type a text: viser does not tie the labels of such fields to them."""
        field = self.page.locator(f'xpath=//*[text()="{label}"]/ancestor::*[.//input][1]//input').first
        field.scroll_into_view_if_needed()
        field.fill(str(text))
        field.press("Enter")

    def press(self, label):
        self.page.get_by_role("button", name=label, exact=True).click()

    def place(self, x, y):
        """Click in the picture, at shares of its width and height, once the panel asks for it."""
        wait_until(lambda: "Click in the picture" in self.note(), "being asked to click")
        self.page.wait_for_timeout(300)
        box = self.page.locator("canvas").first.bounding_box()
        self.page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        wait_until(lambda: "Click in the picture" not in self.note(), "the click to arrive")

    def drag(self, dx, dy):
        """Turn the camera around what it looks at, by dragging the picture so many px."""
        x, y = WINDOW["width"] / 3, WINDOW["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(x + dx, y + dy, steps=5)
        self.page.mouse.up()

    def take_a_photographs_place(self):
        """Click the first photograph that is found in the picture: the camera goes there."""
        for y in range(80, WINDOW["height"], 20):
            for x in range(20, WINDOW["width"] - PANEL, 20):
                self.page.mouse.move(x, y)
                if self.page.evaluate("document.body.style.cursor") == "pointer":
                    self.page.mouse.click(x, y)
                    return

    def slide(self, share, smallest=1, largest=None):
        """Drag a slider's thumb, by default the one for levels or scales, to `share` of its way."""
        largest = self._largest if largest is None else largest
        thumb = self.page.locator(f'[role="slider"][aria-valuemin="{smallest}"][aria-valuemax="{largest}"]')
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


def away(page):
    """No tooltip, and the whole panel."""
    page.page.mouse.move(WINDOW["width"] / 3, 30)
    page.page.get_by_text("Drawn", exact=True).scroll_into_view_if_needed()
    page.page.wait_for_timeout(3000)


def screenshots(config, folder, closer, masks=None):
    """Pages of `ns-viewer` on a run of several levels, `viewer_*.png`: as it starts, and with each control in use.

    The camera is that of a photograph, moved closer by so many turns of the wheel. `masks`: a folder of an object's.
    """
    with sync_playwright() as playwright, Viewer(config, folder / "viewer.log") as viewer:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = Page(browser, viewer.port)
        wait_until(page.drawn, "a picture")
        page.take_a_photographs_place()
        page.press("Hide Train Cams")
        page.page.mouse.move(WINDOW["width"] / 3, WINDOW["height"] / 2)
        for _ in range(closer):
            page.page.mouse.wheel(0, -200)
            page.page.wait_for_timeout(300)

        def shoot(name):
            away(page)
            picture = Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")
            # few colours: small files
            picture.quantize(256, kmeans=3).save(folder / f"viewer_{name}.png", optimize=True)

        shoot("prefix")
        page.choose("Mode", "band")
        shoot("band")
        page.choose("Mode", "budget")
        page.enter("Budget (thousands)", 10)
        shoot("budget")
        page.choose("Mode", "prefix")
        page.choose("Gaze", "click")
        page.place(0.48, 0.5)
        shoot("gaze")
        page.choose("Gaze", "off")
        page.choose("Filter", "xray")
        shoot("filter")
        page.choose("Filter", "off")
        page.choose("Focus", "click")
        page.place(0.48, 0.5)
        shoot("focus")
        if masks is not None:
            page.choose("Focus", "masks")
            page.write("Mask folder", masks)
            page.press("Find the object")
            wait_until(lambda: "The object has" in page.note(), "the object")
            shoot("masks")
        browser.close()


if __name__ == "__main__":
    screenshots(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 0, *sys.argv[4:5])
