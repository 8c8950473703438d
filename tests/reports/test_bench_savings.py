"""What is left out changes nothing: both ways of every saving agree."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from fake_run import fake_run, fake_views

from freqgs_plugin import cli
from freqgs_plugin.reports.bench import trained
from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.savings import saving_row, saving_table
from freqgs_plugin.reports.bench.savings_cases import Saving, savings_of, subject_of


def subject(levels=3, decay=False):
    run = fake_run(levels=levels, n=200)
    if decay:
        run.gaussians = replace(run.gaussians, decay=torch.linspace(0.05, 2.0, 200))
    return subject_of(run, fake_views(1, 64, 48)[0])


@pytest.mark.parametrize("levels, decay", [(3, False), (2, True), (1, True)])
def test_both_ways_of_every_saving_agree(levels, decay):
    found = savings_of(subject(levels, decay))
    for saving in found:
        with_it, without = saving.everything(), saving.left_out()
        assert bool(with_it.any()), saving.what
        # colour and position gradients are sums over pixels whose order may differ
        torch.testing.assert_close(with_it, without, rtol=1e-4, atol=1e-5 * float(with_it.abs().max()), msg=saving.what)
    names = [saving.what for saving in found]
    assert len(set(names)) == len(names)
    assert any("rows of weight 0, viewing level 1" in name for name in names) == (levels > 1)
    assert any("distance scale 5" in name for name in names) == decay
    assert any("empty level" in name for name in names) == (levels > 1)


def test_a_row_has_both_times_and_the_difference():
    saving = Saving("it", "this against that", lambda: torch.tensor([3.0, 4.0]), lambda: torch.tensor([3.0, 4.5]))
    row = saving_row(saving, BenchOptions(rounds=2))
    assert row["difference"] == pytest.approx(0.1) and row["ratio"] > 0 and row["used"] is True
    table = saving_table([row, {**row, "used": False}], subject())
    assert [cells[-1] for cells in table.cells()] == ["yes", "no"]
    assert table.note.startswith("200 Gaussians, 3 levels, 64x48 px")


def test_a_scene_without_detail_is_refused():
    run = fake_run(levels=1)
    with pytest.raises(BenchError, match="one level and no decay"):
        subject_of(run, fake_views(1)[0])


def test_savings_from_the_command_line(tmp_path, monkeypatch):
    run = fake_run()
    run.cameras = lambda split: fake_views(1)
    monkeypatch.setattr(trained, "load", lambda path: run)
    cli.main(["bench", "savings", "--load-config", "x.yml", "--rounds", "1", "--output-dir", str(tmp_path)])
    report = json.loads((tmp_path / "savings.json").read_text())
    rows = report["tables"]["savings"]["rows"]
    assert len(rows) == len(savings_of(subject_of(run, fake_views(1)[0])))
    assert all(row["difference"] < 1e-4 for row in rows)
    assert report["command"] == "freqgs bench savings --load-config RUN/config.yml --rounds 1"
