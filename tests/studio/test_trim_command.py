"""`freqgs trim` on trained runs, as a user calls it."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from running import command

from freqgs_plugin.cli import main
from freqgs_plugin.io.init_source import read_init_source
from freqgs_plugin.reports.trim import trimmer
from freqgs_plugin.studio.checkpoint import load_run
from freqgs_plugin.studio.viewing import psnr, show

pytestmark = pytest.mark.slow


@pytest.fixture
def trim(capsys):
    """`freqgs trim` in this process: what it printed."""

    def run(*arguments):
        main(["trim", *map(str, arguments)])
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(capsys):
    """The error of a `freqgs trim` that is refused."""

    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(["trim", *map(str, arguments)])
        assert ended.value.code == 1
        error = capsys.readouterr().err
        assert error.startswith("freqgs: ") and "Traceback" not in error
        return error

    return run


@pytest.fixture(scope="module")
def small(trained, tmp_path_factory):
    """config.yml of the run of three levels, trimmed; and what was there before."""
    before = contents(trained.parent)
    out = tmp_path_factory.mktemp("trimmed") / "small" / "lapsplat" / "less"
    main(["trim", "--load-config", str(trained), "--output-dir", str(out), "--max-loss-db", "0.5"])
    assert contents(trained.parent) == before, "the old run is as it was"
    return out / "config.yml"


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def mean_psnr(run, split, gaussians=None, attenuation=None):
    values = []
    for view in run.cameras(split):
        with torch.no_grad():
            picture = run.model.draw(gaussians or run.gaussians, view.camera, run.background, attenuation).features
        values.append(float(psnr(show(picture), view.image)))
    return sum(values) / len(values)


def test_the_new_run_holds_less_and_shows_as_much(trained, small):
    old, new = load_run(trained), load_run(small)
    assert len(new.gaussians) < len(old.gaussians)
    assert old.step == new.step and new.config.timestamp == "less"
    assert mean_psnr(new, "train") >= mean_psnr(old, "train") - 0.5
    sizes = [max((c.parent / "nerfstudio_models").glob("*")).stat().st_size for c in (trained, small)]
    assert sizes[1] < 0.4 * sizes[0]
    assert (small.parent / "dataparser_transforms.json").read_bytes() == (
        trained.parent / "dataparser_transforms.json"
    ).read_bytes()
    record = json.loads((small.parent / "trim.json").read_text())
    assert record["steps"][0]["gaussians"] == len(old.gaussians)
    last = record["steps"][-1]
    assert last["gaussians"] == len(new.gaussians) and last["bytes"] == pytest.approx(sizes[1], rel=0.01)
    assert last["loss"] <= 0.5 and last["train"] == pytest.approx(mean_psnr(new, "train"), abs=1e-3)
    assert last["test"] == pytest.approx(mean_psnr(new, "test"), abs=1e-3)
    assert "hardly drawn" in (small.parent / "trim.md").read_text()


def test_ns_eval_reads_it(small, tmp_path):
    done = command("ns-eval", "--load-config", small, "--output-path", tmp_path / "eval.json")
    assert done.code == 0, str(done)
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert results["psnr"] == pytest.approx(mean_psnr(load_run(small), "test"), abs=1e-2)


def test_other_runs_start_from_it(small):
    source = read_init_source(small, signed_residuals=False).gaussians
    held = load_run(small).model
    assert torch.equal(source.features_rest, held.gauss_params["features_rest"]) and torch.equal(
        source.level, held.level
    )


def test_training_does_not_go_on(small, make_trainer):
    def as_there(config):
        config.pipeline.model.sh_degree = load_run(small).config.pipeline.model.sh_degree

    with pytest.raises(ValueError, match="Resume the run that it was made from"):
        make_trainer(load_dir=small.parent / "nerfstudio_models", edit=as_there)


@pytest.fixture
def spoilt(tmp_path):
    """`spoilt(config, change)`: config.yml of a copy, after `change` had its checkpoint's pipeline."""

    def copy(config, change):
        own = Path(shutil.copytree(config.parent, tmp_path / "small" / config.parents[1].name / "run"))
        for other in sorted((own / "nerfstudio_models").glob("*"))[:-1]:
            other.unlink()
        (path,) = (own / "nerfstudio_models").glob("*")
        content = torch.load(path, weights_only=False)
        change({name.removeprefix("_model."): value for name, value in content["pipeline"].items()})
        torch.save(content, path)
        return own / "config.yml"

    return copy


def test_decays_scales_and_a_page(faded, spoilt, tmp_path, trim):
    run = spoilt(faded, lambda state: state["gauss_params.decay"][::2].fill_(0.3))
    page = tmp_path / "page.md"
    page.write_text("# T\n<!-- trim clodsplat scene -->\n<!-- end of trim clodsplat scene -->\nend\n")
    out = tmp_path / "new" / "clodsplat" / "less"
    text = trim("--load-config", run, "--output-dir", out, "--max-loss-db", 0.3, "--docs", page)
    assert str(out / "config.yml") in text and "held-out views, by which nothing was chosen" in text
    old, new = load_run(run), load_run(out / "config.yml")
    for scale in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0):
        pair = [mean_psnr(run, "train", attenuation=run.model.attenuation(scale)) for run in (old, new)]
        assert pair[1] >= pair[0] - 0.3, scale
    written = page.read_text()
    assert written.startswith("# T\n") and written.endswith("end\n") and "| as trained |" in written
    assert "decay: kept: up to s_v = 7" in written


def test_a_decay_that_never_cuts_goes(faded, spoilt, trim):
    def change(state):
        state["gauss_params.decay"].fill_(1e4)
        state["gauss_params.opacities"].fill_(0.5)

    run = spoilt(faded, change)
    text = trim("--load-config", run, "--max-loss-db", 0)
    assert "never cuts: opacities do not decay any more" in text
    new = load_run(run.parent.with_name("run-trimmed") / "config.yml")
    assert new.gaussians.decay is None and (new.model.gauss_params["opacities"] == 0.5).all()
    assert mean_psnr(new, "train") == pytest.approx(mean_psnr(load_run(run), "train"), abs=1e-3)


def test_dead_gaussians_and_empty_levels_go(trained, spoilt, trim):
    rows = []

    def change(state):
        rows.append(state["level"] == 2)
        state["gauss_params.opacities"][rows[0]] = -9.0
        rows[0][0] = True
        state["gauss_params.means"][0] = torch.nan

    run = spoilt(trained, change)
    text = trim("--load-config", run, "--max-loss-db", 0)
    assert "level 2 of 3 holds nothing" in text
    faint = int(rows[0].sum()) - 1
    assert f"1 Gaussians that are not finite; {faint:,} Gaussians of opacity under 1/255, or with a dead decay" in text
    new = load_run(run.parent.with_name("run-trimmed") / "config.yml")
    assert new.num_levels == new.config.pipeline.model.num_levels == 2
    assert len(new.gaussians) <= int((~rows[0]).sum()) and set(new.gaussians.level.tolist()) == {1, 2}
    old = load_run(run)
    held = mean_psnr(old, "train", old.gaussians.select(~rows[0]))
    assert mean_psnr(new, "train") >= held - 1e-3


def test_a_dry_run_writes_nothing(trained, tmp_path, trim):
    before, page = contents(trained.parent), tmp_path / "page.md"
    page.write_text("<!-- trim lapsplat scene -->\n<!-- end of trim lapsplat scene -->\n")
    empty = page.read_text()
    more = ("--dry-run", "--max-loss-db", 0, "--docs", page)
    assert "Nothing was written" in trim("--load-config", trained, *more)
    assert contents(trained.parent) == before and not trained.parent.with_name("run-trimmed").exists()
    assert page.read_text() == empty


# -- what goes wrong ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["-1", "nan", "inf"])
def test_impossible_losses(trained, refused, value):
    assert "max-loss-db is" in refused("--load-config", trained, f"--max-loss-db={value}")


def test_folders_that_do_not_do(trained, tmp_path, refused):
    assert "is no file" in refused("--load-config", tmp_path / "config.yml")
    assert "nerfstudio finds runs as" in refused("--load-config", trained, "--output-dir", tmp_path / "out")
    there = tmp_path / "lapsplat" / "there"
    there.mkdir(parents=True)
    assert "is there already" in refused("--load-config", trained, "--output-dir", there)
    page = tmp_path / "page.md"
    page.write_text("nothing")
    # before anything is measured
    assert "nothing can be written there" in refused("--load-config", trained, "--output-dir", page / "lapsplat" / "x")
    assert "has no one place" in refused("--load-config", trained, "--dry-run", "--docs", page)


def test_damaged_runs(trained, tmp_path, refused):
    own = Path(shutil.copytree(trained.parent, tmp_path / "small" / "lapsplat" / "run"))
    path = max((own / "nerfstudio_models").glob("*"))
    path.write_bytes(path.read_bytes()[:5000])
    assert "truncated" in refused("--load-config", own / "config.yml")
    shutil.rmtree(own / "nerfstudio_models")
    assert "has not saved a checkpoint" in refused("--load-config", own / "config.yml")


def test_without_photographs(trained, scene, tmp_path, refused):
    own = Path(shutil.copytree(trained.parent, tmp_path / "small" / "lapsplat" / "run"))
    config = own / "config.yml"
    # every mention of the data set's folder
    text = config.read_text().replace("- scene\n", "- gone\n")
    config.write_text(text)
    said = refused("--load-config", config)
    assert "gone is not there" in said and "put one line `- /NEW/FOLDER` in place of" in said
    # as it says
    config.write_text(re.sub(r"(?<=PosixPath\n)(- .*\n)+(?=experiment_name)", f"- {scene}\n", text, count=1))
    assert load_run(config).num_views("train") == 6


def test_photographs_named_from_elsewhere(trained, tmp_path, monkeypatch, refused):
    own = Path(shutil.copytree(trained.parent, tmp_path / "small" / "lapsplat" / "run"))
    config = own / "config.yml"
    config.write_text(re.sub(r"(?<=PosixPath\n)(- .*\n)+(?=experiment_name)", "- scene\n", config.read_text(), count=1))
    monkeypatch.chdir(tmp_path)
    assert f"scene is not in {tmp_path}: the run names it from where ns-train" in refused("--load-config", config)


@pytest.mark.parametrize("failure", [RuntimeError("PytorchStreamWriter failed writing file"), KeyboardInterrupt()])
def test_a_full_disk_and_an_interrupt_leave_nothing(trained, tmp_path, monkeypatch, capsys, failure):
    out = tmp_path / "lapsplat" / "less"

    def fail(content, path):
        if isinstance(path, Path):
            path.write_bytes(b"half")
            raise failure

    monkeypatch.setattr(torch, "save", fail)
    monkeypatch.setattr(trimmer, "_RETRIES", 0)
    with pytest.raises(SystemExit) as ended:
        main(["trim", "--load-config", str(trained), "--output-dir", str(out)])
    interrupted, said = isinstance(failure, KeyboardInterrupt), capsys.readouterr()
    assert ended.value.code == (130 if interrupted else 1)
    assert ("Stopped. Nothing was written." in said.out) if interrupted else ("Make room" in said.err)
    assert list(tmp_path.iterdir()) == []
