"""`ns-viewer` on a trained run, in a real browser."""

import numpy as np
import pytest
import torch
from browsing import ARGUMENTS, CHROMIUM, Page, Viewer, wait_until
from playwright.sync_api import sync_playwright
from running import STEPS

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def chromium():
    if CHROMIUM is None:
        pytest.skip("no Chromium on the PATH")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


def difference(a, b):
    return np.abs(a - b).mean()


def test_level_of_detail_in_a_browser(trained, chromium, tmp_path):
    checkpoint = torch.load(trained.parent / "nerfstudio_models" / f"step-{STEPS - 1:09d}.ckpt", map_location="cpu")
    counts = torch.bincount(checkpoint["pipeline"]["_model.level"].long())[1:].cumsum(0).tolist()
    with Viewer(trained, tmp_path / "viewer.log") as viewer:
        page = Page(chromium, viewer.port)
        _, everything, _ = page.settled(counts[2])
        assert everything == counts[2]
        full = page.picture(tmp_path / "full.png")
        assert full.std() > 5, "the page shows no picture"

        assert page.slide(0.0) == 1.0
        page.settled(counts[0])
        base = page.picture(tmp_path / "base.png")
        change = difference(full, base)
        assert change > 2

        assert 1.0 < page.slide(0.5) < 3.0
        wait_until(lambda: page.drawn() and page.drawn()[0] in counts[1:], "levels in between")

        assert page.slide(1.0) == 3.0
        page.settled(counts[2])
        assert difference(full, page.picture(tmp_path / "again.png")) < change / 2

        names = page.choose_output("levels")
        expected = {"rgb", "depth", "levels", *(f"{kind}_{k}" for kind in ("prefix", "band") for k in (1, 2, 3))}
        assert expected <= set(names)
        page.page.wait_for_timeout(3000)
        assert difference(full, page.picture(tmp_path / "levels.png")) > change / 2
        page.page.close()
    log = (tmp_path / "viewer.log").read_text()
    assert "Traceback" not in log, log


def test_detail_scale_in_a_browser(faded, chromium, tmp_path):
    with Viewer(faded, tmp_path / "viewer.log") as viewer:
        page = Page(chromium, viewer.port, "Detail scale", 10)
        most, everything, _ = wait_until(page.drawn, "a picture")
        page.settled(most)
        assert 0 < most <= everything
        full = page.picture(tmp_path / "full.png")
        assert full.std() > 5, "the page shows no picture"

        assert page.slide(1.0) == 10.0
        least = wait_until(lambda: page.drawn() and page.drawn()[0] < most and page.drawn(), "fewer Gaussians")[0]
        page.settled(least)
        change = difference(full, page.picture(tmp_path / "far.png"))
        assert change > 0.5

        between = page.slide(0.6)
        assert 1.0 < between < 10.0
        wait_until(lambda: page.drawn() and least < page.drawn()[0] <= most, "a scale in between")

        assert page.slide(0.0) == 1.0
        page.settled(most)
        assert difference(full, page.picture(tmp_path / "again.png")) < change / 2

        names = page.choose_output("decay")
        expected = {"rgb", "depth", "decay", "drawn_share", *(f"detail_{s}" for s in ("1", "1.5", "2", "3", "5"))}
        assert expected <= set(names)
        page.page.wait_for_timeout(3000)
        assert difference(full, page.picture(tmp_path / "decay.png")) > change / 2
        page.page.close()
    log = (tmp_path / "viewer.log").read_text()
    assert "Traceback" not in log, log
