"""`ns-viewer` on a trained run, in a real browser."""

import numpy as np
import pytest
import torch
from browsing import ARGUMENTS, CHROMIUM, Page, Viewer, wait_until
from playwright.sync_api import sync_playwright
from running import SIZE, STEPS

from freqgs_plugin.io.images import write_image

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def chromium():
    if CHROMIUM is None:
        pytest.skip("no Chromium on the PATH")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def viewer(trained, tmp_path_factory):
    """One for all tests of this run; each leaves the controls as it has found them."""
    log = tmp_path_factory.mktemp("viewer") / "viewer.log"
    with Viewer(trained, log) as viewer:
        yield viewer
    text = log.read_text()
    assert "Traceback" not in text, text


def difference(a, b):
    return np.abs(a - b).mean()


def counts_of(config):
    checkpoint = torch.load(config.parent / "nerfstudio_models" / f"step-{STEPS - 1:09d}.ckpt", map_location="cpu")
    return torch.bincount(checkpoint["pipeline"]["_model.level"].long())[1:].cumsum(0).tolist()


def test_level_of_detail_in_a_browser(trained, viewer, chromium, tmp_path):
    counts = counts_of(trained)
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
    wait_until(lambda: difference(full, page.look()) > change / 2, "colours by level")
    page.choose_output("rgb")
    wait_until(lambda: difference(full, page.look()) < change / 2, "the picture")
    page.page.close()


SAME = 1.2
"""mean difference of two screenshots of one view, in 0..255, that compression alone may make"""


def still(page, looks=2):
    """The picture, once it is drawn at full size and is the same that many times in a row, half a second apart."""
    found = [page.look()]

    def again():
        page.page.wait_for_timeout(500)
        found.append(page.look())
        last = found[-looks:]
        return page.full() and len(last) == looks and all(np.array_equal(last[0], other) for other in last[1:])

    wait_until(again, "a picture that stays")
    return found[-1]


def back_to(page, picture, folder, what):
    """Wait for that picture; where it does not come, what is there instead is told and kept beside it."""
    try:
        wait_until(lambda: difference(picture, page.look()) < SAME, what)
    except TimeoutError as error:
        for name, pixels in (("wanted", picture), ("found", page.look())):
            write_image(folder / f"{name}.png", pixels.astype(np.uint8))
        size = "full" if page.full() else "another"
        raise AssertionError(
            f"{error}: they differ by {difference(picture, page.look()):.2f}, the panel says {page.drawn()}, the "
            f"picture has {size} size; wanted.png and found.png are in {folder}"
        ) from error


def without_cameras(page):
    """The picture, once the photographs' frames are gone from it: on a busy machine that takes a while."""
    before = still(page)
    page.press("Hide Train Cams")
    wait_until(
        lambda: page.shows("Show Train Cams") and not np.array_equal(before, page.look()), "the frames to vanish"
    )
    still(page)
    # nerfstudio can miss the last small move of a camera that settles as the page opens, and then shows the scene from
    # a pixel aside until something is drawn anew: what is kept here is compared with minutes later
    for mode in ("all", "prefix"):
        page.choose("Mode", mode)
        page.page.wait_for_timeout(1000)
    return still(page, looks=6)


def until_it_changes(page, before):
    """The picture, once it is another one."""
    wait_until(lambda: difference(before, page.look()) > SAME, "another picture")
    return still(page)


def test_each_control_in_a_browser(trained, viewer, chromium, tmp_path):
    counts = counts_of(trained)
    page = Page(chromium, viewer.port)
    page.settled(counts[2])
    full = without_cameras(page)

    assert not any(
        map(page.shows, ("Budget (thousands)", "Gaze radius", "Focus radius", "Move the gaze", "Mask folder"))
    )
    use_modes(page, counts, full, tmp_path)
    use_gaze(page, counts)
    use_filters(page, counts, tmp_path)
    use_focus(page, counts)
    use_masks(page, counts, tmp_path)
    page.choose("Focus", "off")
    wait_until(lambda: page.drawn()[0] == counts[2], "everything")
    page.page.close()


def use_masks(page, counts, folder):
    """A folder that is not there, and one with a mask: what is found is drawn, and a second mistake changes nothing."""
    page.choose("Focus", "masks")
    wait_until(lambda: page.shows("Mask folder"), "the folder's field")
    page.write("Mask folder", folder / "nowhere")
    page.press("Find the object")
    wait_until(lambda: "nowhere is no folder" in page.note(), "a message")
    assert page.drawn()[0] == counts[2]
    (folder / "masks").mkdir()
    mask = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    mask[10:50, 10:60] = 255
    for number in (1, 2, 3):
        write_image(folder / "masks" / f"view_{number:03d}.png", mask)
    page.write("Mask folder", folder / "masks")
    page.press("Find the object")
    wait_until(lambda: "The object has" in page.note(), "the object")
    wait_until(lambda: counts[0] < page.drawn()[0] < counts[2], "the object in full")
    few = page.drawn()[0]
    page.write("Mask folder", folder / "nowhere")
    page.press("Find the object")
    wait_until(lambda: "The last object stays." in page.note(), "a message")
    assert page.drawn()[0] == few


def use_modes(page, counts, full, folder):
    page.choose("Mode", "band")
    band = until_it_changes(page, full)
    assert band.std() < full.std(), "a band is mostly grey"
    assert page.slide(0.0) == 1.0
    wait_until(lambda: page.drawn()[0] == counts[0], "the base")
    page.choose("Mode", "all")
    wait_until(lambda: page.drawn()[0] == counts[2], "everything")
    back_to(page, full, folder, "the full picture")
    assert not page.shows("Level of detail")
    page.choose("Mode", "budget")
    wait_until(lambda: page.shows("Budget (thousands)"), "the budget's field")
    assert page.slide(1.0) == 3.0
    page.enter("Budget (thousands)", 0.3)
    wait_until(lambda: page.drawn()[0] == 300, "300 Gaussians")
    assert "The budget of 300 is below level 1" in page.note()
    page.enter("Budget (thousands)", -1)
    wait_until(lambda: "The last stays: 300 Gaussians." in page.note(), "a message")
    assert page.drawn()[0] == 300
    page.choose("Mode", "prefix")
    wait_until(lambda: page.drawn()[0] == counts[2], "everything")
    assert "udget" not in page.note()


def use_gaze(page, counts):
    before = still(page)
    page.choose("Gaze", "middle")
    wait_until(lambda: counts[0] <= page.drawn()[0] < counts[2], "less than everything")
    page.choose("Gaze", "salient")
    wait_until(lambda: counts[0] <= page.drawn()[0] < counts[2], "less than everything")
    page.choose("Gaze", "click")
    page.place(0.1, 0.1)
    corner = until_it_changes(page, before)
    few = page.drawn()[0]
    assert counts[0] <= few < counts[2]
    page.slide(1.0, 0, 0.5)
    wait_until(lambda: page.drawn()[0] > few, "a larger gaze")
    page.slide(0.2, 0, 0.5)
    page.press("Move the gaze")
    page.place(0.4, 0.7)
    moved = until_it_changes(page, corner)
    # and then the picture can be dragged again
    page.drag(40, 0)
    until_it_changes(page, moved)
    page.choose("Gaze", "off")
    wait_until(lambda: page.drawn()[0] == counts[2], "everything")


def use_filters(page, counts, folder):
    before = still(page)
    pictures = []
    for name in ("xray", "brush", "sharp"):
        page.choose("Filter", name)
        pictures.append(until_it_changes(page, pictures[-1] if pictures else before))
        assert difference(before, pictures[-1]) > SAME
    wait_until(lambda: page.drawn()[0] == counts[0] + counts[2] - counts[1], "what is not of level 2")
    page.choose("Filter", "off")
    back_to(page, before, folder, "the plain picture")


def use_focus(page, counts):
    before = still(page)
    page.choose("Focus", "click")
    page.place(0.4, 0.7)
    until_it_changes(page, before)
    few = page.drawn()[0]
    assert counts[0] <= few < counts[2]
    page.slide(1.0, 0.02, 1)
    wait_until(lambda: page.drawn()[0] > few, "a larger focus")


def test_detail_scale_in_a_browser(faded, chromium, tmp_path):
    farthest = 14  # twice s_max
    with Viewer(faded, tmp_path / "viewer.log") as viewer:
        page = Page(chromium, viewer.port, "Detail scale", farthest)
        most, everything, _ = wait_until(page.drawn, "a picture")
        page.settled(most)
        assert 0 < most <= everything
        full = page.picture(tmp_path / "full.png")
        assert full.std() > 5, "the page shows no picture"

        assert page.slide(1.0) == farthest
        least = wait_until(lambda: page.drawn() and page.drawn()[0] < most and page.drawn(), "fewer Gaussians")[0]
        page.settled(least)
        change = difference(full, page.picture(tmp_path / "far.png"))
        assert change > 0.5

        between = page.slide(0.6)
        assert 1.0 < between < farthest
        wait_until(lambda: page.drawn() and least < page.drawn()[0] <= most, "a scale in between")

        assert page.slide(0.0) == 1.0
        page.settled(most)
        assert difference(full, page.picture(tmp_path / "again.png")) < change / 2

        names = page.choose_output("decay")
        expected = {"rgb", "depth", "decay", "drawn_share", *(f"detail_{s}" for s in ("1", "1.5", "2", "3", "5", "7"))}
        assert expected <= set(names)
        wait_until(lambda: difference(full, page.look()) > change / 2, "decays as colours")
        page.page.close()
    log = (tmp_path / "viewer.log").read_text()
    assert "Traceback" not in log, log
