"""What all benchmarks share: tables, pages, files, threads, fits, workloads. No test looks at a measured time."""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from rich.console import Console

from freqgs_plugin import cli
from freqgs_plugin.rendering.base import PrefixRasterizer, get_rasterizer
from freqgs_plugin.reports.bench import cuda, raster, raster_threads, runner
from freqgs_plugin.reports.bench.fit import asymptotic, fit
from freqgs_plugin.reports.bench.memory import peak_mib
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.page import check_places, fill
from freqgs_plugin.reports.bench.runner import Bench, Measured, command_line, run_bench, use_threads, write_all
from freqgs_plugin.reports.bench.tables import BenchTable, milliseconds, number, ratio
from freqgs_plugin.reports.bench.workloads import (
    LEAVES,
    NAMES,
    draw_and_differentiate,
    random_levels,
    with_detail,
    workload,
)
from freqgs_plugin.reports.timing import Timing, interleaved, timing_of


def quiet():
    return Console(width=200, file=io.StringIO())


def table():
    rows = [{"x": 1.5, "timing": Timing(2.0, 1.0, 3.0, 5)}]
    columns = [("x", lambda row: number(row["x"])), ("time", lambda row: milliseconds(row["timing"]))]
    return BenchTable("one", "A | [/title]", rows, columns, "A note.")


def bench(name="made-up", figure=None, steps=1):
    def measure(tick):
        for i in range(steps):
            tick(f"step {i}")
        return Measured([table()], {"scene": 7}, figure)

    return Bench(name, ("one",), steps, measure)


def test_interleaved_runs_every_candidate_once_per_round_and_turns_round():
    calls = []
    times = interleaved({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=3, warmup=1)
    assert "".join(calls) == "ab" + "ab" + "ba" + "ab"
    assert times["a"].repeats == times["b"].repeats == 3
    with pytest.raises(ValueError, match="at least one run"):
        interleaved({"a": lambda: None}, rounds=0)


def test_timing_has_median_and_quartiles():
    assert timing_of([5.0, 1.0, 3.0, 2.0, 4.0]) == Timing(3.0, 2.0, 4.0, 5)


@pytest.mark.parametrize(
    "value, text",
    [
        (0, "0"),
        (None, "-"),
        (0.0004, "4.0e-04"),
        (0.06, "0.06"),
        (0.01234, "0.0123"),
        (1.234, "1.23"),
        (12.34, "12.3"),
        (1234.5, "1,234"),
        (3e7, "3.0e+07"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


def test_table_shows_the_same_cells_everywhere():
    shown = table()
    assert shown.markdown().splitlines() == ["| x | time |", "| --- | ---: |", "| 1.50 | 2.00 (1.00-3.00) |"]
    odd = BenchTable("odd", "", [{"name": "<b>x|`<y>`\n&"}], [("a<b", lambda row: row["name"])])
    assert odd.markdown().splitlines() == ["| a&lt;b |", "| --- |", r"| &lt;b>x\|`<y>` &amp; |"]
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(shown.rich())
    text = console.export_text()
    assert all(cell in text for cell in shown.cells()[0])
    assert shown.json()["rows"][0]["timing"] == {"median_ms": 2.0, "low_ms": 1.0, "high_ms": 3.0, "repeats": 5}
    assert (
        ratio(Timing(6.0, 1.0, 9.0, 3), Timing(2.0, 1.0, 3.0, 3)) == 3 and ratio(None, Timing(1.0, 1.0, 1.0, 1)) is None
    )


def test_power_law_is_recovered_and_the_flat_part_left_out():
    sizes = [10.0**k for k in range(7)]
    law = fit(sizes, [3 * x**1.25 for x in sizes])
    assert law.exponent == pytest.approx(1.25) and law.factor == pytest.approx(3) and law.worst < 1e-9
    assert law(100.0) == pytest.approx(3 * 100**1.25)
    # an overhead of 100 hides the law up to 10^2
    found = asymptotic(sizes, [100 + x for x in sizes])
    assert found is not None and found.first == 1e3 and found.points == 4
    assert found.exponent == pytest.approx(1, abs=0.03)
    flat = asymptotic(sizes, [7.0] * 7)
    assert flat is not None and flat.points == 3 and flat.exponent == pytest.approx(0, abs=1e-12)
    assert asymptotic(sizes[:2], [1.0, 2.0]) is None
    with pytest.raises(ValueError, match="two sizes"):
        fit([1.0, 1.0], [2.0, 3.0])


def test_workloads_are_the_seeded_ones():
    for name in NAMES:
        one, two = workload(name, quick=True), workload(name, quick=True)
        assert all(torch.equal(getattr(one.splats, leaf), getattr(two.splats, leaf)) for leaf in LEAVES)
        assert one.gradient.shape == (one.camera.height, one.camera.width, 3)
    medium, large = workload("medium"), workload("large")
    assert medium.size == "10,000 Gaussians, 400x300 px" and large.size == "100,000 Gaussians, 800x600 px"
    first = torch.tensor([1.89241958, 0.20301211, 3.98502636])
    torch.testing.assert_close(medium.splats.means[0], first)
    assert 0.01 <= float(medium.splats.scales.min()) and float(medium.splats.scales.max()) <= 0.08
    with pytest.raises(ValueError, match="choose one of: medium, large"):
        workload("huge")


def test_small_splats_share_their_depths():
    depths = workload("small splats").splats.means[:, 2]
    _, counts = depths.unique(return_counts=True)
    assert int(counts[counts > 1].sum()) > 0.9 * len(depths)


def test_detail_has_equal_levels_and_decays_in_range():
    gaussians = with_detail(workload("large", quick=True), 3)
    shares = torch.bincount(random_levels(30_000, 3).long())[1:] / 30_000
    torch.testing.assert_close(shares, torch.full((3,), 1 / 3), atol=0.02, rtol=0)
    assert gaussians.decay is not None
    assert 0.1 <= float(gaussians.decay.min()) and float(gaussians.decay.max()) <= 3.0


def test_gradients_go_to_every_leaf():
    of = workload("medium", quick=True)
    _, gradients = draw_and_differentiate(get_rasterizer("torch", "cpu"), of)
    assert set(gradients) == set(LEAVES) and all(bool(g.any()) for g in gradients.values())


def test_files_hold_circumstances_and_numbers(tmp_path):
    figure = Figure(figsize=(1, 1))
    figure.subplots().plot([1, 2])
    options = BenchOptions(tmp_path / "out", quick=True, rounds=3)
    run_bench(bench(figure=figure), options, quiet(), "--data", "SCENE")
    report = json.loads((tmp_path / "out" / "made-up.json").read_text())
    assert {"date", "hardware", "versions", "commit", "seconds", "load"} <= report.keys()
    assert report["hardware"]["threads"] == 1 and report["seeds"] == {"scene": 7} and report["quick"] is True
    assert report["command"] == "freqgs bench made-up --data SCENE --quick --rounds 3"
    assert report["tables"]["one"]["rows"][0]["x"] == 1.5
    text = (tmp_path / "out" / "made-up.md").read_text()
    assert "| 1.50 |" in text and "A note." in text and "![A | [/title]](made-up.png)" in text and "--quick" in text
    assert (tmp_path / "out" / "made-up.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["made-up.json", "made-up.md", "made-up.png"]


def test_the_page_is_filled_between_its_comments_again_and_again(tmp_path):
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("# Before\n<!-- one -->\nold\n<!-- end of one -->\nafter\n")
    for _ in range(2):
        run_bench(bench(figure=Figure()), BenchOptions(tmp_path / "out", page), quiet())
        text = page.read_text()
        assert text.startswith("# Before\n<!-- one -->\n*A | [/title].*") and text.endswith(
            "\n<!-- end of one -->\nafter\n"
        )
        assert "old" not in text and text.count("| 1.50 |") == 1
        assert "(images/bench_made-up.png)" in text
        assert (page.parent / "images" / "bench_made-up.png").is_file()


@pytest.mark.parametrize("text", ["", "<!-- one -->", "<!-- end of one -->\n<!-- one -->"])
def test_a_page_without_its_place_is_refused_before_measuring(tmp_path, text):
    page, called = tmp_path / "page.md", []
    page.write_text(text)

    def measure(tick):
        called.append(tick)
        return Measured([])

    refused = Bench("made-up", ("one",), 1, measure)
    with pytest.raises(BenchError, match="Add the two lines '<!-- one -->' and '<!-- end of one -->'"):
        run_bench(refused, BenchOptions(tmp_path / "out", page), quiet())
    assert called == [] and not (tmp_path / "out").exists() and page.read_text() == text


def test_fill_keeps_backslashes_and_other_places():
    page = "<!-- a -->\n<!-- end of a -->\n<!-- b -->\nkept\n<!-- end of b -->"
    check_places(page, ("a", "b"), "page")
    filled = fill(page, "a", r"\1 \g<0>")
    assert r"\1 \g<0>" in filled and "kept" in filled


def test_an_interrupt_writes_nothing_and_says_so(tmp_path):
    def measure(tick):
        tick("first")
        raise KeyboardInterrupt

    console = Console(width=100, record=True, file=io.StringIO())
    with pytest.raises(KeyboardInterrupt):
        run_bench(Bench("made-up", ("one",), 2, measure), BenchOptions(tmp_path / "out"), console)
    assert "Nothing was written" in console.export_text() and not (tmp_path / "out").exists()


def test_a_failing_write_leaves_the_old_files(tmp_path, monkeypatch):
    old, new = tmp_path / "a.json", tmp_path / "b.json"
    old.write_bytes(b"old")
    write = Path.write_bytes

    def failing(self, contents):
        if self.name.startswith("b"):
            raise KeyboardInterrupt
        return write(self, contents)

    monkeypatch.setattr(Path, "write_bytes", failing)
    with pytest.raises(KeyboardInterrupt):
        write_all({old: b"new", new: b"new"})
    assert old.read_bytes() == b"old" and [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_wrong_number_of_steps_is_our_own_mistake(tmp_path):
    wrong = Bench("made-up", ("one",), 3, bench(steps=2).measure)
    with pytest.raises(AssertionError, match="announced 3 steps and took 2"):
        run_bench(wrong, BenchOptions(tmp_path), quiet())


def test_threads_are_used_and_given_back():
    import numba

    before = torch.get_num_threads(), numba.get_num_threads()
    with use_threads(1):
        assert torch.get_num_threads() == numba.get_num_threads() == 1
    assert (torch.get_num_threads(), numba.get_num_threads()) == before
    with pytest.raises(BenchError, match="NUMBA_NUM_THREADS=100000"), use_threads(100_000):
        pass


def test_options_refuse_nonsense():
    with pytest.raises(BenchError, match="at least 1"):
        BenchOptions(rounds=0)
    assert command_line("raster", BenchOptions(threads=2)) == ["freqgs", "bench", "raster", "--threads", "2"]


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peak memory is Linux's high-water mark")
def test_peak_memory_counts_what_is_touched_and_freed():
    # a process of its own: allocators of a used one hold memory in reserve
    code = (
        "import numpy as np; from freqgs_plugin.reports.bench.memory import peak_mib\n"
        "import torch; print(peak_mib(lambda: np.ones(64 << 17)), peak_mib(lambda: None))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    touched, nothing = map(float, out.split())
    assert touched == pytest.approx(64, abs=2) and nothing < 1


def test_bench_commands_are_listed_and_refused_by_name(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(name in text for name in cli.COMMANDS["bench"])
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench"])
    assert stop.value.code != 0


def test_raster_from_the_command_line(tmp_path, capsys):
    page = tmp_path / "page.md"
    names = ("raster", "raster-prefixes", "raster-shares", "raster-threads")
    page.write_text("\n".join(f"<!-- {name} -->\n<!-- end of {name} -->" for name in names))
    cli.main(["bench", "raster", "--quick", "--rounds", "1", "--output-dir", str(tmp_path), "--docs", str(page)])
    tables = json.loads((tmp_path / "raster.json").read_text())["tables"]
    rows = tables["raster"]["rows"]
    assert {row["workload"] for row in rows} == set(NAMES)
    assert {"torch, cpu", "numba, cpu"} <= {row["backend"] for row in rows}
    assert all(row["forward_ratio"] == 1 for row in rows if row["backend"] == "torch, cpu")
    for row in rows:
        assert row["forward"]["median_ms"] > 0 and row["memory_mib"]["forward_backward"] >= 0
    assert all(row["forward_ratio"] == 1 for row in tables["raster-prefixes"]["rows"] if row["way"] == "one picture")
    shares = {row["way"]: row["drawn_share"] for row in tables["raster-shares"]["rows"]}
    assert shares["everything"] == 1 and shares["level 1 of 3"] < shares["levels 1-2 of 3"] < 1
    decays = [shares[f"distance decay, scale {s}"] for s in (1, 2, 5)]
    assert decays == sorted(decays, reverse=True) and decays[-1] < 0.5
    threads = tables["raster-threads"]["rows"]
    assert {row["workload"] for row in threads} == set(NAMES) and all(row["same_bits"] for row in threads)
    assert all(row["forward_backward_ratio"] == 1 for row in threads if row["threads"] == 1)
    assert page.read_text().count("| --- |") == 4
    assert "Rasterizers" in capsys.readouterr().out


def test_thread_counts_are_powers_of_two(monkeypatch):
    for most, expected in ((1, [1]), (2, [1, 2]), (6, [1, 2, 4]), (8, [1, 2, 4, 8])):
        monkeypatch.setattr(raster_threads.numba.config, "NUMBA_NUM_THREADS", most)
        assert raster_threads.thread_counts() == expected


def test_the_cuda_bench_needs_a_device(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit):
        cli.main(["bench", "cuda"])
    assert "needs a CUDA device" in capsys.readouterr().err


def test_the_cuda_table_holds_errors_beside_times():
    options, steps = BenchOptions(quick=True, rounds=1), []
    rows = cuda.with_errors(
        raster.backend_rows("medium", [("torch", "cpu"), ("numba", "cpu")], options, steps.append), options
    )
    assert len(steps) == 3 and [row["backend"] for row in rows] == ["torch, cpu", "numba, cpu"]
    assert rows[0]["forward_ratio"] == 1 and all(60 < row["errors"].psnr < 200 for row in rows)
    text = cuda.cuda_table(rows).markdown()
    assert "PSNR, dB" in text and "opacities" in text and text.count("medium") == 2


def test_prefixes_of_the_bench_agree_with_a_call_for_each():
    of = workload("medium", quick=True)
    rasterizer, level = get_rasterizer("numba", "cpu"), random_levels(len(of.splats), 3)
    assert isinstance(rasterizer, PrefixRasterizer)
    together = rasterizer.prefixes(of.splats, level, 3, of.camera)
    for k, picture in enumerate(together, start=1):
        alone = rasterizer(of.splats.select(level <= k), of.camera, depth=False)
        torch.testing.assert_close(picture.features, alone.features, atol=1e-5, rtol=1e-4)


def test_scaling_from_the_command_line(tmp_path):
    cli.main(["bench", "scaling", "--quick", "--rounds", "1", "--output-dir", str(tmp_path)])
    tables = json.loads((tmp_path / "scaling.json").read_text())["tables"]
    laws = tables["scaling"]["rows"]
    assert len(laws) == 8 and all(np.isfinite(row["law"]["exponent"]) for row in laws)
    points = tables["scaling-points"]["rows"]
    mine = [p for p in points if p["sweep"] == "pixels" and p["backend"] == "numba"]
    assert [p["size"] for p in mine] == [p["width"] * p["height"] for p in mine]
    law = next(
        row["law"] for row in laws if (row["sweep"], row["backend"], row["way"]) == ("pixels", "numba", "forward")
    )
    expected = asymptotic([p["size"] for p in mine], [p["forward"]["median_ms"] for p in mine])
    assert expected is not None and law["exponent"] == pytest.approx(expected.exponent)
    assert (tmp_path / "scaling.png").stat().st_size > 5000


def test_scaling_leaves_out_what_would_take_too_long(monkeypatch):
    from freqgs_plugin.reports.bench import scaling

    seconds = {"numba": 1e-6, "torch": 1e-2}

    def made_up(rasterizers, of, rounds, expected):
        n = len(of.splats)
        return {k: (timing_of([500 * seconds[k] * n]), timing_of([1000 * seconds[k] * n])) for k in rasterizers}

    monkeypatch.setattr(scaling, "_times", made_up)
    sweep = scaling.Sweep("Gaussians", "8x6 px", tuple((n, 8, 6) for n in (100, 1_000, 3_000, 10_000)))
    rows = scaling.sweep_rows(sweep, BenchOptions(), lambda what: None)
    measured = [row["size"] for row in rows if row["backend"] == "torch" and row["forward"] is not None]
    assert measured == [100, 1_000], "30 s are over the limit, and so is everything beyond"
    assert len([row for row in rows if row["backend"] == "numba" and row["forward"] is not None]) == 4
    laws = {(row["backend"], row["way"]): row["law"] for row in scaling.law_rows(rows)}
    assert laws["torch", "forward"] is None and laws["numba", "forward"].exponent == pytest.approx(1)
    assert scaling.point_table(rows).cells()[-1][-1] == "-"


def test_memory_failures_are_told(monkeypatch):
    from freqgs_plugin.reports.bench import memory

    assert "unknown workload" in str(memory.peak_memory("huge", "torch", "cpu", 1, True)["error"])
    monkeypatch.setattr(memory, "TIMEOUT", 0.01)
    assert "over 0.01 s" in str(memory.peak_memory("medium", "torch", "cpu", 1, True)["error"])
    assert runner.IMAGES == "images" and callable(peak_mib)
