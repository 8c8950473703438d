"""What a report measures, and the files that it makes of it, without a trained run."""

import csv
import errno
import io
import json
import math
import os
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fake_lab import decaying_run
from fake_run import fake_run, fake_views
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from freqgs_plugin.functional.pyramid import reduce
from freqgs_plugin.reports.drawing import draw, prefix
from freqgs_plugin.reports.report import runs as report_runs
from freqgs_plugin.reports.report.circumstances import sentence
from freqgs_plugin.reports.report.drawn import OPAQUE, SHOWN, full_detail, subsets
from freqgs_plugin.reports.report.folder import check_output, write_folder
from freqgs_plugin.reports.report.front import pareto_front
from freqgs_plugin.reports.report.health import scale_health
from freqgs_plugin.reports.report.html_page import html_page
from freqgs_plugin.reports.report.left_out import left_out
from freqgs_plugin.reports.report.options import ReportError, ReportOptions, command_line
from freqgs_plugin.reports.report.page import markdown_page
from freqgs_plugin.reports.report.plots import figures
from freqgs_plugin.reports.report.quality import measure_quality, rmse_of
from freqgs_plugin.reports.report.runner import _png
from freqgs_plugin.reports.report.runs import ReportedRun, spread
from freqgs_plugin.reports.report.tables import points_csv, tables, training_csv
from freqgs_plugin.reports.tables import psnr

RUN = Path("a") / "config.yml"


def options(**more):
    return ReportOptions(load_config=(RUN,), **more)


def reported(run, kind, views=None):
    views = fake_views() if views is None else views
    return ReportedRun("mine", run, RUN, views, len(views), kind)


# -- the front --------------------------------------------------------------------------------------------------------

numbers = st.floats(0, 10) | st.sampled_from((math.inf, math.nan, 0.0, 1.0))


@given(st.lists(st.tuples(numbers, numbers), max_size=30))
def test_on_the_front_is_exactly_what_nothing_beats(points):
    front = pareto_front(points)

    def beats(a, b):
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    finite = [i for i, p in enumerate(points) if all(map(math.isfinite, p))]
    for i in finite:
        beaten = any(beats(points[j], points[i]) for j in finite)
        twin = any(points[j] == points[i] for j in front)
        assert (i in front) <= (not beaten)
        assert beaten or twin
    assert set(front) <= set(finite)
    assert [points[i] for i in front] == sorted({points[i] for i in front})


# -- what is drawn ----------------------------------------------------------------------------------------------------


def test_prefixes_are_measured_at_both_sizes():
    run, views = fake_run(), fake_views()
    rows = [measure_quality(s, views, None) for s in subsets(reported(run, "prefixes"), options())]
    assert [row["label"] for row in rows] == ["1", "1-2", "1-3"]
    assert [row["drawn"] for row in rows] == [20, 40, 60]
    # 4 coefficients: 3 + 3 + 4 + 1 + 12 floats
    assert [row["bytes"] for row in rows] == [20 * 92, 40 * 92, 60 * 92]
    for level, row in enumerate(rows, start=1):
        shown = [(prefix(run, v.camera, level).clamp(0, 1), v.image) for v in views]
        full = np.mean([psnr(picture, image) for picture, image in shown])
        assert row["psnr"] == pytest.approx(full, abs=1e-4)
        assert row["rmse"] == pytest.approx(10 ** (-full / 20))
        if level < 3:
            small = [[reduce(i.permute(2, 0, 1)[None], 3 - level) for i in pair] for pair in shown]
            own = np.mean([psnr(a[0].permute(1, 2, 0), b[0].permute(1, 2, 0)) for a, b in small])
            assert row["own"]["psnr"] == pytest.approx(own, abs=1e-4)
        else:
            assert row["own"] is None


def test_lpips_is_the_mean_over_views_or_not_computed():
    of = reported(fake_run(), "prefixes")
    values = iter((0.25, 0.75))
    assert measure_quality(full_detail(of), of.views, lambda a, b: next(values))["lpips"] == 0.5
    assert measure_quality(full_detail(of), of.views, None)["lpips"] is None


def test_pixels_outside_of_the_range_are_counted_before_clamping():
    run, views = fake_run(), fake_views(1)
    picture = draw(run, views[0].camera).features
    found = measure_quality(full_detail(reported(run, "prefixes", views)), views, None)["clamped"]
    outside = ((picture < 0) | (picture > 1)).any(-1)
    assert 0 < found["share"] < 1 and found["share"] == pytest.approx(float(outside.float().mean()))
    assert (found["lowest"], found["highest"]) == pytest.approx((float(picture.min()), float(picture.max())))
    assert found["non_finite"] == 0


def test_a_picture_that_is_not_finite_is_told():
    run, views = fake_run(levels=1), fake_views(1)
    run.background = torch.full((3,), torch.nan)
    found = measure_quality(full_detail(reported(run, "shares", views)), views, None)
    assert found["clamped"]["non_finite"] == 40 * 30 and math.isnan(found["psnr"])


def test_the_sweep_draws_less_the_farther_away():
    run = decaying_run()
    rows = [
        measure_quality(s, fake_views(), None)
        for s in subsets(reported(run, "scales"), options(scales=(5.0, 1.0, 2.0)))
    ]
    assert [row["label"] for row in rows] == ["s_v 1", "s_v 2", "s_v 5"]
    assert rows[0]["drawn"] >= rows[1]["drawn"] >= rows[2]["drawn"]
    # a decay is one float more
    assert rows[0]["bytes"] == rows[0]["drawn"] * 96


def test_cuts_keep_the_most_opaque_and_what_shows_most():
    run = decaying_run(decay=None)
    seen = []
    cuts = subsets(reported(run, "shares"), options(shares=(0.25, 1.0, 0.5)), lambda: seen.append(1))
    assert [(c.series, c.label) for c in cuts] == [(s, p) for s in (OPAQUE, SHOWN) for p in ("100 %", "50 %", "25 %")]
    assert len(seen) == 2, "a tick for each training view"
    opacities = run.gaussians.opacities
    for cut, count in zip(cuts[:3], (60, 30, 15), strict=True):
        torch.testing.assert_close(cut.gaussians.opacities, opacities.sort(descending=True).values[:count])
    whole = draw(run, fake_views()[0].camera).features
    for cut in (cuts[0], cuts[3]):
        torch.testing.assert_close(cut.draw(fake_views()[0].camera).features, whole, atol=1e-5, rtol=1e-4)
    # what shows most is nearer to the whole picture than what is most opaque, or as near
    error = [(c.draw(fake_views()[0].camera).features - whole).square().mean() for c in (cuts[2], cuts[5])]
    assert error[1] <= error[0]


def test_a_tiny_share_keeps_one_gaussian():
    run = decaying_run(decay=None, n=5)
    assert {len(c.gaussians) for c in subsets(reported(run, "shares"), options(shares=(0.001,)))} == {1}


@given(st.integers(1, 50), st.integers(1, 60))
def test_views_are_spread_from_the_first_to_the_last(count, most):
    found = spread(count, most)
    assert len(found) == min(count, most) and found == sorted(set(found))
    assert found[0] == 0 and (len(found) == 1 or found[-1] == count - 1)


# -- health -----------------------------------------------------------------------------------------------------------


def test_near_degenerate_is_what_a_float32_covariance_cannot_hold():
    thin = 1 / 5000
    scales = torch.tensor([[1, 1, 1], [1, 0.5, 1e-3], [2, 2 * thin, 1], [0, 1, 1], [torch.nan, 1, 1]])
    found = scale_health(scales)
    assert found["near_degenerate"] == 2 and found["share"] == 0.5
    assert found["smallest"] == 0 and found["largest"] == 2 and found["largest_ratio"] is None
    assert scale_health(scales[:2])["largest_ratio"] == pytest.approx(1000)
    assert float(torch.tensor(1.0) + torch.tensor(thin).square()) == 1.0


# -- options ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"load_config": ()}, "no run to report on"),
        ({"load_config": (RUN, Path("a/../a/config.yml"))}, "names a run twice"),
        ({"names": ("x", "y")}, "2 names for 1 runs"),
        ({"load_config": (RUN, Path("b")), "names": ("x", "x")}, "let them differ"),
        ({"scales": ()}, r"\(nothing\): name at least one s_v"),
        ({"scales": (1.0, -2.0)}, "1 -2: name at least one s_v, each of them above 0"),
        ({"scales": (math.inf,)}, "finite"),
        ({"shares": ()}, "name at least one share"),
        ({"shares": (0.5, 1.5)}, "at most 1"),
        ({"views": 0}, "--views is 0"),
        ({"rounds": 0}, "must be at least 1, not 0 and 1"),
    ],
)
def test_options_that_make_no_sense_are_refused(more, message):
    with pytest.raises(ReportError, match=message):
        ReportOptions(**{"load_config": (RUN,), **more})


def test_the_command_tells_no_folders():
    found = command_line(ReportOptions((Path("/secret/a"),), shares=(0.5,), rounds=3), ("lapsplat a",))
    assert found == "freqgs report --load-config LAPSPLAT_A/config.yml --shares 0.5 --rounds 3"


# -- runs that cannot be compared -------------------------------------------------------------------------------------


def loaded(views, train=(), name="lapsplat", levels=3, steps=10):
    run = fake_run(levels=levels)
    model = SimpleNamespace(seed=1)
    run.config = SimpleNamespace(method_name=name, max_num_iterations=steps, pipeline=SimpleNamespace(model=model))
    run.scene_distance = None
    run.cameras = lambda split: list(views) if split == "test" else list(train)
    return run


def open_them(monkeypatch, *each, names=(), most=None):
    by_path = {Path(f"{i}/config.yml"): run for i, run in enumerate(each)}
    monkeypatch.setattr(report_runs, "load", lambda path: by_path[path])
    return report_runs.open_runs(list(by_path), names, most)


def test_runs_get_names_and_share_views(monkeypatch):
    views = fake_views(5)
    found, warnings = open_them(monkeypatch, loaded(views), loaded(views, levels=1), loaded(views), most=2)
    assert [f.name for f in found] == ["lapsplat 0", "plain", "lapsplat 2"]
    assert [f.kind for f in found] == ["prefixes", "shares", "prefixes"]
    assert [v.name for v in found[0].views] == ["view_0.png", "view_4.png"] and found[0].held_out == 5
    assert warnings == []


def test_other_photographs_and_other_sizes_are_refused(monkeypatch):
    for others in (fake_views(2)[::-1], fake_views(1), fake_views(2, width=48)):
        with pytest.raises(ReportError, match=r"1.config.yml and 0.config.yml hold different views out"):
            open_them(monkeypatch, loaded(fake_views(2)), loaded(others))


def test_a_run_without_held_out_views_is_refused(monkeypatch):
    with pytest.raises(ReportError, match="holds no view out"):
        open_them(monkeypatch, loaded([]))


def test_views_that_were_trained_on_and_other_lengths_are_warned_of(monkeypatch):
    views = fake_views(3)
    first, second = loaded(views[:2], train=views[2:]), loaded(views[:2], train=views[1:], steps=20)
    _, warnings = open_them(monkeypatch, first, second, names=("x", "y"))
    text = " ".join(warnings)
    assert "1 of its 2 evaluation views were trained on" in text and "trained on other views than 0" in text
    assert "different numbers of steps: x 10, y 20" in text


# -- the folder -------------------------------------------------------------------------------------------------------


def record_of(*names):
    return json.dumps({"files": list(names)}).encode()


def test_a_report_takes_the_place_of_an_earlier_one(tmp_path):
    out = tmp_path / "new" / "report"
    write_folder(out, {"a.md": b"1", "report.json": record_of("a.md", "report.json")})
    write_folder(out, {"b.md": b"2", "report.json": record_of("b.md", "report.json")})
    assert sorted(p.name for p in out.iterdir()) == ["b.md", "report.json"]
    assert [p.name for p in out.parent.iterdir()] == ["report"]
    assert oct(out.stat().st_mode)[-3:] == oct(out.parent.stat().st_mode)[-3:]


def test_a_full_disk_leaves_nothing_and_loses_nothing(tmp_path, monkeypatch):
    out = tmp_path / "report"
    write_folder(out, {"a.md": b"1", "report.json": record_of("a.md")})

    def full(number):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"not written \(No space left on device\).*b\.md"):
        write_folder(out, {"b.md": b"2"})
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["a.md", "report", "report.json"]


def test_an_interrupt_between_the_two_renames_loses_nothing(tmp_path, monkeypatch):
    out = tmp_path / "report"
    write_folder(out, {"a.md": b"1", "report.json": record_of("a.md")})
    replace, calls = os.replace, []

    def interrupted(source, target):
        calls.append(source)
        if len(calls) == 2:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_folder(out, {"b.md": b"2"})
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["a.md", "report", "report.json"]


def test_folders_of_others_are_refused(tmp_path):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ReportError, match=r"mine\.txt.*Nothing was changed"):
        check_output(tmp_path)
    with pytest.raises(ReportError, match="is a file"):
        check_output(tmp_path / "mine.txt")
    with pytest.raises(OSError, match="nothing can be written there"):
        check_output(tmp_path / "mine.txt" / "report")
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


# -- files ------------------------------------------------------------------------------------------------------------


def point(label, value, db, drawn, ms, own=None):
    errors = {"psnr": db, "ssim": 0.5, "lpips": None, "rmse": rmse_of(db), "1-ssim": 0.5}
    return {
        **{"label": label, "value": value, **errors, "own": own, "drawn": drawn, "bytes": 100 * drawn},
        "clamped": {"share": 0.25, "lowest": -0.5, "highest": 1.5, "non_finite": 0},
        "render": {"median_ms": ms, "low_ms": ms - 1, "high_ms": ms + 1, "repeats": 3},
        "ms_per_megapixel": 10 * ms,
    }


def a_record():
    events = {"skipped_steps": 2, "first_step": 7, "exact": True, "what": "step 7: loss dft", "scalars": {"Loss": 8}}
    health = {
        "clamped": {"share": 0.25, "lowest": -0.5, "highest": 1.5, "non_finite": 0},
        "dead_decay": None,
        "scales": {"near_degenerate": 3, "share": 0.1},
        "parameters": {"means": 4},
        "training": events,
    }
    common = {"method": "lapsplat", "steps": 10, "checkpoint_step": 9, "gaussians": 30, "bytes_each": 100}
    common |= {"seeds": {"machine": 42, "model": 43}, "rasterizer": "numba", "health": health, "left_out": []}
    trained = {"step": 5, "seconds": 2.5, "psnr": 20.0, "ssim": 0.5, "rmse": 0.1, "1-ssim": 0.5, "source": "log"}
    levels = [point("1", 1, 20.0, 10, 4, {"psnr": 25.0, "ssim": 0.9, "rmse": 0.05, "1-ssim": 0.1})]
    levels.append(point("1-2", 2, math.inf, 30, 9))
    cuts = [point("100 %", 1.0, 21.0, 300, 30), point("50 %", 0.5, 10.0, 150, 15)]
    return {
        **{"date": "2001-02-03T04:05:06+00:00", "commit": "abc123", "rounds": 3, "load": 0.5, "lpips": "not computed"},
        "hardware": {"processor": "a processor", "cores": 2, "threads": 1, "gpu": None},
        "versions": {"torch": "2.9", "numba": "0.6", "gsplat": None},
        "command": "freqgs report",
        "warnings": ["Beware of this."],
        "views": {"measured": 2, "held_out": 2, "timed": 2, "sizes": [(40, 30)], "pixels": 1200, "names": []},
        "runs": [
            {
                **{**common, "name": "a <b>", "kind": "prefixes", "series": [{"name": "", "points": levels}]},
                "training": {"points": [trained], "seconds": 3.0, "missing": "", "pauses": [1, 60.0]},
            },
            {
                **{**common, "name": "plain", "kind": "shares", "series": [{"name": OPAQUE, "points": cuts}]},
                "training": {"points": [], "seconds": None, "missing": "has no log: do so", "pauses": [0, 0.0]},
            },
        ],
    }


def both_drawn():
    """The subsets that `a_record` describes."""
    cuts = subsets(reported(decaying_run(None), "shares"), options(shares=(1.0, 0.5)))
    return [subsets(reported(fake_run(2), "prefixes"), options()), cuts[:2]]


def test_every_file_says_when_where_and_with_what():
    record = a_record()
    drawn = both_drawn()
    shown = tables(record, [0, 1])
    plots = {name: _png(figure, record) for name, figure in figures(record).items()}
    assert list(plots) == ["error_time", "error_bytes", "error_count", "error_training"]
    page = html_page(record, shown, plots, drawn)
    markdown = markdown_page(record, shown, list(plots))
    for text in (page, markdown, points_csv(record).decode(), training_csv(record).decode()):
        assert all(word in text for word in ("2001-02-03", "a processor", "2.9", "abc123", "42", "43"))
    assert "a &lt;b>" in markdown and "<b>" not in markdown
    for contents in plots.values():
        with Image.open(io.BytesIO(contents)) as image:
            assert image.text["Description"] == sentence(record) and image.size[0] > 800
    for text in (page, markdown):
        assert "Beware of this." in text and "First value of a" in text and "step 7: loss dft" in text
        assert "No error against training time for plain: it has no log: do so." in text and "60 s in all" in text


def test_the_html_page_needs_nothing_else():
    record = a_record()
    drawn = both_drawn()
    page = html_page(record, tables(record, []), {"error_time": b"png"}, drawn)
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    # a plot; and per run the photograph and two parts
    assert len(sources) == 1 + 2 * 3 and all(s.startswith("data:image/png;base64,") for s in sources)
    assert "url(" not in page and "<script" not in page and "//" not in re.sub(r'src="[^"]*"', "", page)
    assert "a &lt;b&gt;" in page and "<b>, " not in page


def test_what_is_left_out_is_told_with_what_more_would_buy(tmp_path):
    assert left_out({}, tmp_path) == []
    steps = [
        {"step": "as trained", "done": "", "more": ""},
        {"step": "decay", "done": "", "more": "none would save 1 MB"},
    ]
    (tmp_path / "trim.json").write_text(json.dumps({"summary": "2 MB became 1 MB.", "steps": steps}))
    choice = {"levels": 2, "energies": [0.5, 1e-9], "kept": [True, False], "bound": 1e-4, "size": [80, 64]}
    rows = left_out({**choice, "stopped": "level 2 gained 0.1 dB"}, tmp_path)
    assert [row["what"] for row in rows] == ["levels", "levels", "trimmed", "decay"]
    assert "2 levels (at most 3" in rows[0]["done"] and "dropped 1/1 size: 1.00e-09" in rows[0]["done"]
    assert rows[3] == {"what": "decay", "done": "nothing", "more": "none would save 1 MB"}
    record = a_record()
    assert len(tables(record, [])) == 4
    record["runs"][1]["left_out"] = rows
    (table,) = (t for t in tables(record, []) if t.title == "Left out")
    assert table.cells()[1] == ["plain", "levels", "level 2 gained 0.1 dB", "-"] and len(table.cells()) == 4
    (tmp_path / "trim.json").write_text("{")
    with pytest.raises(ReportError, match=r"trim\.json is damaged"):
        left_out({}, tmp_path)


def test_tables_and_csv_hold_the_same_numbers():
    record = a_record()
    runs, points, training, health = tables(record, [0])
    rows = list(csv.DictReader(io.StringIO(points_csv(record).decode())))
    assert [row["label"] for row in rows] == ["1", "1-2", "100 %", "50 %"]
    assert [float(row["psnr"]) for row in rows] == [20.0, math.inf, 21.0, 10.0]
    assert rows[0]["psnr_own_size"] == "25.0" and rows[1]["psnr_own_size"] == "" and rows[0]["lpips"] == "not computed"
    cells = points.cells()
    assert cells[0][:4] == ["a <b>", "1 *", "20.00", "0.1000"] and cells[2][0] == f"plain, {OPAQUE}"
    assert "not computed" in cells[0] and "4.00 (3.00-5.00)" in cells[0]
    assert "43, machine 42" in runs.cells()[0] and training.cells()[0][2] == "2.5"
    line = " ".join(health.cells()[0])
    assert "2, first at step 7" in line and "means: 4 Gaussians" in line and "Loss from step 8" in line
