import io
import json
import math
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from fake_run import fake_run, fake_views

from freqgs_plugin.io.images import read_image
from freqgs_plugin.reports.contact_sheet import GAP, LABEL, contact_sheet, view_pictures, write_sheet
from freqgs_plugin.reports.drawing import LEVEL_COLOURS, band, colour_by_level, draw, levels_picture, prefix
from freqgs_plugin.reports.tables import PrefixRow, prefix_rows, prefix_table, psnr, reduced_psnr, write_report
from freqgs_plugin.reports.timing import Timing, commit, environment, measure


def test_bands_add_up_to_the_full_picture():
    run, (view, *_) = fake_run(), fake_views()
    total = sum(band(run, view.camera, level) for level in (1, 2, 3))
    torch.testing.assert_close(total, draw(run, view.camera).features)
    assert (band(run, view.camera, 2) < 0).any(), "bands above the base are signed"


def test_levels_picture_holds_only_mixtures_of_the_levels_colours():
    run, (view, *_) = fake_run(levels=1), fake_views()
    picture, alpha = levels_picture(run, view.camera), draw(run, view.camera).alpha
    torch.testing.assert_close(picture, alpha * torch.tensor(LEVEL_COLOURS[0]), atol=1e-5, rtol=1e-4)
    three = colour_by_level(fake_run(levels=3).gaussians)
    assert len(torch.unique(three.features_dc, dim=0)) == 3 and not three.signed_residuals


def test_psnr_has_its_closed_form():
    target = torch.full((8, 9, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20, abs=1e-4)
    assert reduced_psnr(target + 0.1, target, 2) == pytest.approx(20, abs=1e-4)
    assert psnr(target, target) == math.inf


def test_reduced_psnr_ignores_detail():
    noisy = torch.full((32, 32, 3), 0.5)
    noisy[::2, ::2] += 0.3
    noisy[1::2, 1::2] -= 0.3
    flat = torch.full((32, 32, 3), 0.5)
    assert reduced_psnr(noisy, flat, 2) > psnr(noisy, flat) + 10


def test_rows_count_prefixes_and_the_last_one_is_at_full_size():
    run, views = fake_run(), fake_views()
    rows = prefix_rows(run, views, repeats=2)
    assert [row.gaussians for row in rows] == [20, 40, 60]
    assert rows[-1].psnr_own == pytest.approx(rows[-1].psnr_full)
    expected = np.mean([psnr(prefix(run, v.camera, 1).clamp(0, 1), v.image) for v in views])
    assert rows[0].psnr_full == pytest.approx(expected)
    with pytest.raises(ValueError, match="no held-out views"):
        prefix_rows(run, [])


def test_table_and_json_hold_the_same_numbers(tmp_path):
    from rich.console import Console

    rows = [
        PrefixRow(1, 1234, 30.5, 20.25, Timing(5.0, 4.5, 6.0, 9)),
        PrefixRow(2, 5678, math.inf, 25.0, Timing(7.0, 6.5, 8.0, 9)),
    ]
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(prefix_table(rows))
    text = console.export_text()
    for part in ("1,234", "30.50 dB", "1-2", "7.0 (6.5-8.0)"):
        assert part in text
    write_report(tmp_path / "r.json", rows, steps=7, folder=tmp_path)
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["steps"] == 7 and report["folder"] == str(tmp_path)
    assert report["prefixes"][0]["render"]["median_ms"] == 5.0
    assert report["prefixes"][1]["psnr_own"] is None
    assert {"date", "hardware", "versions", "commit"} <= report.keys()


def test_environment_names_hardware_versions_and_date():
    found = environment()
    assert found["date"].endswith("+00:00")
    assert found["hardware"]["processor"] and found["hardware"]["cores"] >= 1
    assert found["versions"]["torch"] == torch.__version__.partition("+")[0] or found["versions"]["torch"]


def test_commit_is_none_outside_of_a_checkout(monkeypatch, tmp_path):
    import freqgs_plugin.reports.timing as timing

    monkeypatch.setattr(timing, "__file__", str(tmp_path / "timing.py"))
    assert commit() is None


def test_measure_reports_the_median_and_warms_up():
    calls = []

    def work():
        calls.append(time.perf_counter())
        time.sleep(0.1 if len(calls) == 1 else 0.002)

    timing = measure(work, repeats=5, warmup=1)
    assert len(calls) == 6
    assert 2 <= timing.low_ms <= timing.median_ms <= timing.high_ms < 50
    with pytest.raises(ValueError, match="at least one"):
        measure(work, repeats=0)


def test_contact_sheet_shows_pixels_unchanged(tmp_path):
    rng = np.random.default_rng(0)
    first, second, third = (rng.integers(0, 256, (30, 40, 3)) / np.float32(255) for _ in range(3))
    write_sheet(tmp_path / "s.png", [("a", [("x", first), ("y", second)]), ("b", [("x", third)])])
    sheet = read_image(tmp_path / "s.png")
    assert sheet.shape == (2 * (30 + LABEL + GAP), 2 * 40 + 3 * GAP, 3)
    for picture, top, left in ((first, LABEL, GAP), (second, LABEL, 40 + 2 * GAP), (third, 2 * LABEL + 30 + GAP, GAP)):
        np.testing.assert_array_equal(sheet[top : top + 30, left : left + 40], np.round(picture * 255).astype(np.uint8))
    assert (sheet[:LABEL] < 128).any(), "labels are drawn"


def test_contact_sheet_of_a_run(tmp_path):
    run, views = fake_run(), fake_views()
    labels = [label for label, _ in view_pictures(run, views[0])]
    assert labels == [
        "photo",
        "level 1",
        "levels 1-2",
        "levels 1-3",
        "added by level 2",
        "added by level 3",
        "colour by level",
    ]
    contact_sheet(tmp_path / "s.png", run, views)
    assert read_image(tmp_path / "s.png").shape[1] == 7 * (40 + GAP) + GAP
    with pytest.raises(ValueError, match="no held-out views"):
        contact_sheet(tmp_path / "t.png", run, [])
