"""`freqgs report` on trained runs, as a user calls it."""

import csv
import json
import shutil
from pathlib import Path

import pytest
import torch
from browsing import ARGUMENTS, CHROMIUM
from PIL import Image
from running import STEPS, advance, save

from freqgs_plugin.cli import main
from freqgs_plugin.io.images import read_image, write_image
from freqgs_plugin.studio.checkpoint import load_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def report(trained, faded, tmp_path_factory):
    """A report on runs of both methods, and its record."""
    out = tmp_path_factory.mktemp("report") / "out"
    main(["report", *configs(trained, faded), "--scales", "1", "4", "--rounds", "2", "--output-dir", str(out)])
    return out, json.loads((out / "report.json").read_text())


def configs(*paths):
    return [word for path in paths for word in ("--load-config", str(path))]


def test_both_methods_in_one_report(report, trained, faded):
    out, record = report
    lap, clod = record["runs"]
    assert (lap["name"], clod["name"]) == ("lapsplat", "clodsplat")
    assert sorted(record["files"]) == sorted(p.name for p in out.iterdir())
    assert [p.name for p in out.parent.iterdir()] == ["out"], "nothing is left beside it"
    points = lap["series"][0]["points"]
    counts = torch.bincount(load_run(trained).gaussians.level.long())[1:].cumsum(0).tolist()
    assert [p["drawn"] for p in points] == counts and [p["label"] for p in points] == ["1", "1-2", "1-3"]
    assert [p["label"] for p in clod["series"][0]["points"]] == ["s_v 1", "s_v 4"]
    for run in record["runs"]:
        # the part that is everything is the full picture, which ns-train evaluated at its last step
        ends = run["training"]["points"]
        assert [(p["step"], p["source"]) for p in ends] == [(STEPS - 1, "checkpoint")]
        assert 0 < ends[0]["seconds"] <= run["training"]["seconds"] + 1e-6
        assert run["health"]["training"]["skipped_steps"] == 0 and run["health"]["parameters"] == {}
        assert run["seeds"] == {"machine": 42, "model": 42}
    assert points[-1]["psnr"] == pytest.approx(lap["full"]["psnr"], abs=1e-4)
    assert clod["series"][0]["points"][0]["psnr"] == pytest.approx(clod["full"]["psnr"], abs=1e-4)
    assert clod["health"]["dead_decay"]["bound"] == 0.25 and lap["health"]["dead_decay"] is None
    rows = list(csv.DictReader((out / "report.csv").open()))
    assert len(rows) == 5 and all(row["date"] == record["date"] for row in rows)
    for name in ("error_time", "error_bytes", "error_count", "error_training"):
        with Image.open(out / f"{name}.png") as image:
            assert record["date"] in image.text["Description"]


def test_the_checkpoint_has_the_error_that_ns_train_measured(report, trained):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(trained.parent))
    log.Reload()
    tag = "Eval Images Metrics Dict (all images)/"
    full = report[1]["runs"][0]["full"]
    for name in ("psnr", "ssim"):
        (event,) = log.Scalars(tag + name)
        # ns-train evaluated before the last step's refinement at the latest
        assert full[name] == pytest.approx(event.value, rel=0.02)
    own = log.Scalars(tag + "psnr_prefix_1")[0].value
    assert report[1]["runs"][0]["series"][0]["points"][0]["own"]["psnr"] == pytest.approx(own, rel=0.02)


@pytest.mark.browser
def test_the_page_in_a_browser(report):
    if CHROMIUM is None:
        pytest.skip("no Chromium on the PATH")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page, asked, said = browser.new_page(), [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: said.append(message.text))
        page.goto((report[0] / "report.html").resolve().as_uri())
        widths = page.evaluate("[...document.images].map(image => image.complete ? image.naturalWidth : 0)")
        # four plots; per run a photograph and its parts
        assert len(widths) == 4 + (1 + 3) + (1 + 2) and all(width > 0 for width in widths)
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        assert [url for url in asked if not url.startswith(("data:", "file:"))] == [] and said == []
        assert "PSNR, own size" in page.inner_text("body")
        browser.close()


def test_a_plain_model_is_cut(make_trainer, trained, tmp_path, capsys):
    trainer = make_trainer(num_levels=1)
    advance(trainer, 3)
    plain = save(trainer).parent / "config.yml"
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("# Mine\n\n<!-- report -->\n<!-- end of report -->\n\nEnd.\n")
    more = ["--shares", "1", "0.5", "--rounds", "1", "--views", "2", "--docs", str(page)]
    main(["report", *configs(plain, trained), *more, "--output-dir", str(tmp_path / "out")])
    said = capsys.readouterr().out
    assert "No error against training time for plain: it has a tensorboard log in which nothing can be read" in said
    assert "--steps-per-eval-all-images" in said
    record = json.loads((tmp_path / "out" / "report.json").read_text())
    assert record["views"]["measured"] == 2 and "error_training" not in record["files"]
    opaque, shown = record["runs"][0]["series"]
    assert [p["drawn"] for s in (opaque, shown) for p in s["points"]] == [300, 150] * 2
    assert opaque["points"][0]["psnr"] == pytest.approx(shown["points"][0]["psnr"], abs=1e-2)
    text = page.read_text()
    assert text.startswith("# Mine") and text.endswith("End.\n") and "images/report_error_time.png" in text
    assert (page.parent / "images" / "report_error_time.png").is_file() and str(tmp_path) not in text


def copied(config, folder):
    """The run elsewhere, to be spoilt."""
    target = folder / "copied" / config.parent.parent.name / "run"
    shutil.copytree(config.parent, target)
    return target / "config.yml"


def spoilt(name, trained, faded, folder):
    """config.yml of a run with which something is wrong."""
    if name == "nowhere":
        return folder / "nowhere.yml"
    config = copied(trained, folder)
    checkpoints = sorted((config.parent / "nerfstudio_models").glob("*.ckpt"))
    if name == "none":
        for path in checkpoints:
            path.unlink()
    elif name == "truncated":
        checkpoints[-1].write_bytes(checkpoints[-1].read_bytes()[:5000])
    elif name == "empty":
        checkpoints[-1].write_bytes(b"")
    elif name == "other method":
        other = faded.parent / "nerfstudio_models" / checkpoints[-1].name
        shutil.copy(other, checkpoints[-1])
    elif name == "older version":
        checkpoint = torch.load(checkpoints[-1], map_location="cpu", weights_only=False)
        del checkpoint["pipeline"]["_model._extra_state"]["strategy"]
        torch.save(checkpoint, checkpoints[-1])
    elif name == "config":
        config.write_text(config.read_text()[:2000])
    return config


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere", "nowhere.yml is no file"),
        ("none", "holds no step-000000000.ckpt"),
        ("truncated", "cannot be loaded: it is truncated or damaged"),
        ("empty", "cannot be loaded: it is truncated or damaged"),
        ("other method", "made by another method"),
        ("older version", "another version wrote it (KeyError: 'strategy')"),
        ("config", "damaged, or another version wrote it"),
    ],
)
def test_runs_that_cannot_be_loaded_are_named(trained, faded, tmp_path, capsys, name, message):
    config = spoilt(name, trained, faded, tmp_path)
    refused(["report", *configs(config), "--output-dir", str(tmp_path / "out")], capsys, message, str(config.parent))
    assert not (tmp_path / "out").exists()


def refused(arguments, capsys, *messages):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    error = capsys.readouterr().err
    assert ended.value.code == 1 and "Traceback" not in error
    assert all(message in error for message in messages), error


def test_other_data_is_refused(trained, own_scene, tmp_path, capsys):
    config = copied(trained, tmp_path)
    folder = str(load_run(trained).config.pipeline.datamanager.data)
    parts = "\n".join(f"- {part}" for part in Path(folder).parts)
    text = config.read_text()
    assert parts in text
    config.write_text(text.replace(parts, "\n".join(f"- {part}" for part in own_scene.parts)))
    for path in (own_scene / "images").iterdir():
        write_image(path, 255 - read_image(path))
    arguments = ["report", *configs(trained, config), "--output-dir", str(tmp_path / "out")]
    refused(arguments, capsys, "hold different views out", "3 of 80x64 px", "cannot be compared")


def test_places_that_cannot_be_written_are_refused_before_anything_is_loaded(trained, tmp_path, capsys):
    (tmp_path / "file").touch()
    arguments = ["report", *configs(trained), "--output-dir"]
    refused([*arguments, str(tmp_path / "file" / "out")], capsys, "nothing can be written there")
    refused([*arguments, str(tmp_path)], capsys, "no part of an earlier report (file)", "Nothing was changed")
    page = tmp_path / "page.md"
    page.write_text("no place")
    refused([*arguments, str(tmp_path / "out"), "--docs", str(page)], capsys, "no one place for the table 'report'")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "page.md"]


def test_an_interrupted_report_leaves_nothing(trained, tmp_path, monkeypatch, capsys):
    from freqgs_plugin.reports.report import measuring

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(measuring, "_times", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(["report", *configs(trained), "--output-dir", str(tmp_path / "out")])
    assert ended.value.code == 130 and "Nothing was written" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_after_the_last_file_does_not_deny_it(trained, tmp_path, monkeypatch, capsys):
    from freqgs_plugin.reports.report import runner

    write_folder = runner.write_folder

    def interrupted(*arguments):
        write_folder(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "write_folder", interrupted)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        main(["report", *configs(trained), "--rounds", "1", "--views", "1", "--output-dir", str(out)])
    said = capsys.readouterr().out
    assert ended.value.code == 130 and f"Stopped. {out} is complete" in said and "Nothing" not in said
    assert (out / "report.html").is_file()
