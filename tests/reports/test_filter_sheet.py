"""Filters side by side, and whether they stay where they are when the camera moves."""

import io

import pytest
import torch
from fake_run import fake_run, fake_views
from rich.console import Console

from freqgs_plugin.apps.filters import FILTERS
from freqgs_plugin.reports.bench.apps import app_subject, apps_bench
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.runner import run_bench
from freqgs_plugin.reports.filters import draw_filters, seen_from, spread, stepped_aside
from freqgs_plugin.types import Camera, Rendering


def wall(camera, offset=0.0):
    """What a camera at the origin that looks along z sees of a wall at z = 2, coloured by where it is."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    centre = camera.centre
    u = (x - camera.K[0, 2]) / camera.K[0, 0] * 2 + centre[0] + offset
    v = (y - camera.K[1, 2]) / camera.K[1, 1] * 2 + centre[1]
    colours = torch.stack([0.5 + 0.1 * u, 0.5 + 0.1 * v, 0.5 + 0 * u], -1)
    ones = torch.ones(camera.height, camera.width, 1)
    return Rendering(colours, ones, 2 * ones, {})


def test_a_wall_is_the_same_from_a_step_aside_and_a_moving_picture_is_not():
    K = torch.tensor([[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, 40, 30)
    aside = stepped_aside(camera, 0.1)
    torch.testing.assert_close(aside.centre, torch.tensor([0.1, 0.0, 0.0]))
    here = wall(camera)
    colours, seen = seen_from(aside, wall(aside), camera, here)
    # two columns have left the picture
    assert seen[:, 2:].all() and not seen[:, :1].any()
    inner = seen.clone()
    inner[:, :3] = False
    inner[:, -3:] = inner[:3] = inner[-3:] = False
    torch.testing.assert_close(colours[inner], here.features[inner], atol=1e-5, rtol=0)
    # strokes drawn onto each picture anew: the same pixels, whatever they show
    colours, seen = seen_from(aside, here, camera, here)
    assert (colours - here.features)[inner].abs()[:, 0].min() > 5e-3
    # a wall at another depth is another surface
    far = Rendering(here.features, here.alpha, 3 * here.alpha, {})
    assert not seen_from(aside, far, camera, here)[1].any()


def test_a_sheet_has_a_row_per_view_and_a_column_per_filter():
    run, views = fake_run(), fake_views(2)
    ticks = []
    rows, sheet = draw_filters(run, views, FILTERS, lambda: ticks.append(1))
    assert [row.name for row in rows] == ["plain", *FILTERS] and len(ticks) == 4
    assert [name for name, _ in sheet] == ["view_0", "view_1"]
    assert all([label for label, _ in pictures] == ["plain", *FILTERS] for _, pictures in sheet)
    assert rows[0].changed == 0 and all(row.changed > 0.01 for row in rows[1:])
    with pytest.raises(ValueError, match="no views"):
        draw_filters(run, [], FILTERS)
    assert spread(5, 3) == [0, 2, 4] and spread(2, 3) == [0, 1]


def test_the_benchmark_of_applications(tmp_path):
    bench = apps_bench(BenchOptions(tmp_path / "out", quick=True, rounds=1), app_subject(fake_run(), fake_views(4)))
    page = tmp_path / "page.md"
    page.write_text("".join(f"<!-- {name} -->\n<!-- end of {name} -->\n" for name in bench.tables))
    options = BenchOptions(tmp_path / "out", docs=page, quick=True, rounds=1)
    tables = run_bench(bench, options, Console(width=200, file=io.StringIO())).tables
    assert [table.name for table in tables] == list(bench.tables)
    assert "| xray | 60 |" in page.read_text()
    with pytest.raises(BenchError, match="one level"):
        app_subject(fake_run(levels=1), fake_views(1))
