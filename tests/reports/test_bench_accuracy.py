"""Errors and approximations: what the tables of `freqgs bench accuracy` are made of."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from fake_run import fake_run, fake_views

from freqgs_plugin import cli
from freqgs_plugin.rendering import torch_compositing, torch_tiles
from freqgs_plugin.rendering.base import ALPHA_MIN, get_rasterizer
from freqgs_plugin.reports.bench import accuracy, trained
from freqgs_plugin.reports.bench.approximations import APPROXIMATIONS, variants
from freqgs_plugin.reports.bench.errors import errors
from freqgs_plugin.reports.bench.numba_variants import NumbaConstants, NumbaVariant
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.rounds import fitting, patient
from freqgs_plugin.reports.bench.variants import EXACT, Constants, constants
from freqgs_plugin.reports.bench.workloads import (
    draw,
    draw_and_differentiate,
    load_workload,
    random_workload,
    save_workload,
    workload,
)
from freqgs_plugin.reports.stability import dense as dense_module
from freqgs_plugin.reports.stability.dense import dense


def tiny():
    return random_workload("tiny", 60, 40, 30, (0.05, 0.2)).to("cpu", torch.float64)


def test_errors_have_their_closed_forms():
    picture, gradient = torch.zeros(2, 2, 3).double(), torch.tensor([3.0, 4.0]).double()
    found = errors(picture + 0.1, {"a": gradient * 1.01, "b": gradient}, picture, {"a": gradient, "b": gradient})
    assert found.largest == pytest.approx(0.1) and found.rms == pytest.approx(0.1)
    assert found.psnr == pytest.approx(20) and found.gradients["b"] == 0
    assert found.gradients["a"] == found.worst_gradient == pytest.approx(0.01)
    same = errors(picture, {"a": 0 * gradient}, picture, {"a": 0 * gradient})
    assert same.psnr == math.inf and same.worst_gradient == 0
    assert errors(picture, {"a": gradient}, picture, {"a": 0 * gradient}).worst_gradient == math.inf


def test_the_exact_sum_is_the_dense_one_without_thresholds(monkeypatch):
    of, rasterizer = tiny(), get_rasterizer("torch", "cpu")
    for name in ("ALPHA_MIN", "TRANSMITTANCE_MIN"):
        monkeypatch.setattr(dense_module, name, 0.0)
    monkeypatch.setattr(dense_module, "RADIUS_SIGMAS", 1e6)
    truth = dense(of.splats, of.camera, of.background)["features"]
    with constants(EXACT):
        exact = draw(rasterizer, of)
    torch.testing.assert_close(exact, truth, rtol=0, atol=1e-9)
    assert float((draw(rasterizer, of) - truth).abs().max()) > 1e-4, "thresholds change the picture"


def test_constants_return_to_what_they_were():
    before = torch_compositing.ALPHA_MIN, torch_tiles.TILE, torch_compositing.PIXELS
    with pytest.raises(RuntimeError), constants(Constants(alpha_min=0.5, tile=32)):
        assert (torch_compositing.ALPHA_MIN, torch_tiles.TILE, torch_compositing.PIXELS) == (0.5, 32, 1024)
        raise RuntimeError
    assert (torch_compositing.ALPHA_MIN, torch_tiles.TILE, torch_compositing.PIXELS) == before
    assert before[0] == ALPHA_MIN


@pytest.mark.parametrize("tile", [8, 16, 32])
def test_tile_size_changes_nothing_but_rounding(tile):
    of, rasterizer = tiny(), get_rasterizer("torch", "cpu")
    picture, gradients = draw_and_differentiate(rasterizer, of)
    with constants(Constants(tile=tile)):
        found = errors(*draw_and_differentiate(rasterizer, of), picture, gradients)
    assert found.largest < 1e-12 and found.worst_gradient < 1e-11


# large Gaussians finish pixels; small ones lie outside of the image with tails that reach into it
@pytest.mark.parametrize(
    "constant, size", [("alpha_min", (0.1, 0.5)), ("stop", (0.1, 0.5)), ("radius_sigmas", (0.01, 0.1))]
)
def test_each_threshold_has_an_effect_of_its_own(constant, size):
    of = random_workload("many", 3000, 40, 30, size).to("cpu", torch.float64)
    rasterizer = get_rasterizer("torch", "cpu")
    with constants(EXACT):
        exact = draw(rasterizer, of)
    with constants(replace(EXACT, **{constant: getattr(Constants(), constant)})):
        error = float((draw(rasterizer, of) - exact).abs().max())
    assert 1e-9 < error < 0.1


def test_approximations_begin_with_the_exact_sum_and_quick_compiles_nothing():
    assert next(iter(APPROXIMATIONS.values())) == (EXACT, torch.float64)
    quick = variants(quick=True)
    assert all(how == NumbaConstants() for _, how in quick.values() if isinstance(how, NumbaConstants))
    assert set(quick) < set(variants(quick=False)) == set(APPROXIMATIONS)


def test_workloads_travel_as_files(tmp_path):
    of = replace(workload("medium", quick=True), antialiased=True)
    save_workload(of, tmp_path / "w.pt")
    again, rasterizer = load_workload(tmp_path / "w.pt"), get_rasterizer("torch", "cpu")
    assert again.antialiased and again.name == of.name
    assert torch.equal(draw(rasterizer, again), draw(rasterizer, of))
    assert not torch.equal(draw(rasterizer, of), draw(rasterizer, replace(of, antialiased=False)))


def test_an_unchanged_variant_gives_the_same_bits(tmp_path):
    of = workload("medium", quick=True)
    save_workload(of, tmp_path / "w.pt")
    picture, gradients = draw_and_differentiate(get_rasterizer("numba", "cpu", absgrad=False), of)
    with NumbaVariant(tmp_path / "w.pt", 1, NumbaConstants()) as child:
        assert child.milliseconds("forward") > 0
        found = child.result()
    assert torch.equal(found[0], picture) and all(torch.equal(found[1][k], g) for k, g in gradients.items())


@pytest.mark.slow
def test_a_variant_with_other_constants_is_compiled_anew(tmp_path):
    of = workload("medium", quick=True)
    save_workload(of, tmp_path / "w.pt")
    lower = 1e-6
    with NumbaVariant(tmp_path / "w.pt", 1, NumbaConstants(alpha_min=lower, exact_exponential=True)) as child:
        found = child.result()
    double = of.to("cpu", torch.float64)
    with constants(Constants(alpha_min=lower)):
        truth = draw_and_differentiate(get_rasterizer("torch", "cpu"), double)
    assert errors(*found, *truth).largest < 1e-4
    shipped = draw_and_differentiate(get_rasterizer("torch", "cpu"), double)
    assert errors(*found, *shipped).largest > 1e-3


def test_a_failing_variant_tells_why(tmp_path):
    with NumbaVariant(tmp_path / "missing.pt", 1, NumbaConstants()) as child:
        with pytest.raises(BenchError, match=r"missing\.pt"):
            child.milliseconds("forward")


def test_rounds_fit_into_the_time():
    assert fitting(7, 10.0, 1.0) == 7 and fitting(7, 10.0, 3.0) == 3 and fitting(7, 10.0, 30.0) == 2
    assert fitting(1, 10.0, 30.0) == 1 and fitting(7, 10.0, 0.0) == 7
    calls = []
    assert patient({"a": lambda: calls.append(1)}, 3, 1e6)["a"].repeats == 3 and len(calls) == 4


def test_accuracy_from_the_command_line(tmp_path):
    cli.main(["bench", "accuracy", "--quick", "--rounds", "1", "--output-dir", str(tmp_path)])
    tables = json.loads((tmp_path / "accuracy.json").read_text())["tables"]
    for row in tables["accuracy"]["rows"]:
        # one contribution of 1/255 may be on the other side of its threshold
        assert row["errors"]["largest"] <= 1.01 / 255
        assert (row["errors"]["largest"] == 0) == row["backend"].endswith("(the truth)")
        assert max(row["errors"]["gradients"].values()) < 0.01
        assert row["forward"]["median_ms"] > 0 and row["forward_backward"]["median_ms"] > 0
    rows = {row["approximation"]: row for row in tables["accuracy-approximations"]["rows"]}
    assert list(rows) == list(variants(quick=True))
    assert rows["none: the exact sum, float64"]["errors"]["largest"] == 0
    assert rows["float32"]["errors"]["largest"] < 1e-5 < rows["alpha under 1/255 is skipped"]["errors"]["largest"]
    assert rows["torch as it is, tiles of 8 px"]["own_errors"]["largest"] < 5e-3


def test_a_trained_view_is_measured_with_the_runs_settings(tmp_path):
    run = fake_run()
    run.cameras = lambda split: fake_views(1) if split == "train" else []
    of = trained.trained_workload(run)
    assert of.antialiased and of.camera.width == 40 and torch.equal(of.background, run.background)
    rows = accuracy.backend_rows(of, BenchOptions(rounds=1))
    assert {row["workload"] for row in rows} == {"trained view"}
    assert accuracy.backend_table(rows).note.startswith("*trained view*: 60 Gaussians, 40x30 px")


@pytest.mark.parametrize("name", ["savings", "apps", "stream", "focus"])
def test_a_page_without_its_places_is_told_before_a_run_is_loaded(tmp_path, capsys, name):
    page = tmp_path / "page.md"
    page.touch()
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", name, "--load-config", str(tmp_path / "config.yml"), "--docs", str(page)])
    assert stop.value.code == 1 and "has no one place for the table" in capsys.readouterr().err


def test_a_missing_run_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", "accuracy", "--load-config", str(tmp_path / "config.yml")])
    assert stop.value.code == 1 and "name the config.yml of a trained run" in capsys.readouterr().err
