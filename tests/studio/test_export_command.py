"""`freqgs export` and `freqgs import` on trained runs, as a user calls them."""

import json
import os
import re
import shutil
import stat

import numpy as np
import plyfile
import pytest
import torch

from freqgs_plugin.cli import main
from freqgs_plugin.commands import export_formats, export_plain
from freqgs_plugin.io.parameters import GROUPS
from freqgs_plugin.io.ply import SplatFileError, read_ply, write_ply
from freqgs_plugin.studio.checkpoint import load_run

pytestmark = pytest.mark.slow


@pytest.fixture
def freqgs(capsys):
    """`freqgs ...` in this process: what it printed."""

    def run(*arguments):
        main([str(a) for a in arguments])
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(capsys):
    """What `freqgs ...` says as it refuses."""

    def run(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main([str(a) for a in arguments])
        assert stopped.value.code == 1
        return capsys.readouterr().err

    return run


@pytest.fixture(scope="session")
def plain_run(trained, tmp_path_factory):
    """config.yml of the same Gaussians with unsigned colours, of three levels: what such a training leaves."""
    folder = tmp_path_factory.mktemp("plain") / "small" / "lapsplat" / "run"
    shutil.copytree(trained.parent, folder)
    config = folder / "config.yml"
    text = config.read_text()
    assert text.count("signed_residuals: true") == 1
    config.write_text(text.replace("signed_residuals: true", "signed_residuals: false"))
    return config


@pytest.fixture
def no_tool(monkeypatch):
    """A PATH without splat-transform."""
    for module in (export_formats,):
        monkeypatch.setattr(module, "find_tool", lambda: None)


def ns_export(config, folder):
    import tyro
    from nerfstudio.scripts.exporter import Commands

    tyro.cli(Commands, args=["gaussian-splat", "--load-config", str(config), "--output-dir", str(folder)]).main()


def rows(path):
    return plyfile.PlyData.read(path)["vertex"].data


def manifest(path):
    return json.loads(path.read_text())


def imported(folder, method="lapsplat"):
    found = list(folder.glob(f"*/{method}/import-*/config.yml"))
    assert len(found) == 1
    return found[0]


class TestPly:
    def test_unsigned_colours_are_exact_and_the_same_as_ns_export(self, plain_run, tmp_path, freqgs):
        said = freqgs("export", "--load-config", plain_run, "--output-dir", tmp_path)
        ns_export(plain_run, tmp_path / "ns")
        ours, theirs = rows(tmp_path / "splat.ply"), rows(tmp_path / "ns" / "splat.ply")
        assert len(ours) == len(theirs) > 100 and ours.dtype.names == theirs.dtype.names
        assert all(np.array_equal(ours[name], theirs[name]) for name in ours.dtype.names)
        assert "mip viewers: the same as our pictures, 0.00 dB lost" in said
        assert "SplatRenderMode: mip" in plyfile.PlyData.read(tmp_path / "splat.ply").comments
        content = manifest(tmp_path / "splat.ply.json")
        about = content["files"]["splat.ply"]
        assert about["gaussians"] == len(ours) and about["bytes"] == (tmp_path / "splat.ply").stat().st_size
        assert about["loss"]["mip_viewers"]["same_pictures"] and about["loss"]["views"] == 3
        # a viewer without compensation draws something else
        assert about["loss"]["classic_viewers"]["psnr_to_our_pictures"] < 60
        assert sorted(p.name for p in tmp_path.iterdir()) == ["ns", "splat.ply", "splat.ply.json"]

    def test_signed_residuals_are_refused_as_by_ns_export(self, trained, tmp_path, refused):
        said = refused("export", "--load-config", trained, "--output-dir", tmp_path / "out")
        with pytest.raises(ValueError, match="signed residual") as theirs:
            ns_export(trained, tmp_path)
        assert str(theirs.value) in said and "--bake" in said
        assert not (tmp_path / "out").exists()

    def test_baked(self, trained, tmp_path, freqgs):
        lost = {}
        for steps in (0, 40):
            folder = tmp_path / str(steps)
            freqgs("export", "--load-config", trained, "--output-dir", folder, "--bake", "--bake-steps", steps)
            loss = manifest(folder / "splat.ply.json")["files"]["splat.ply"]["loss"]
            lost[steps] = loss["mip_viewers"]["psnr_to_our_pictures"]
        assert 20 < lost[0] < lost[40]
        freqgs("export", "--load-config", trained, "--output-dir", tmp_path / "base", "--level", 1, "--extra", "level")
        raw, summary = read_ply(tmp_path / "base" / "splat.ply")
        assert summary.antialiased and raw.level is not None and bool((raw.level == 1).all())

    def test_for_classic_viewers(self, trained, tmp_path, freqgs, refused):
        more = ("--load-config", trained, "--output-dir", tmp_path, "--viewer", "classic", "--level", 1)
        assert "add --bake" in refused("export", *more)
        said = freqgs("export", *more, "--bake", "--bake-steps", 20)
        assert "baked for classic viewers, 20 steps" in said and "any viewer: " in said
        assert "SplatRenderMode: default" in plyfile.PlyData.read(tmp_path / "splat.ply").comments

    def test_an_interrupt_writes_the_best_so_far(self, trained, tmp_path, freqgs, monkeypatch):
        original = export_plain.bake

        def interrupted(*arguments, on_step, **more):
            def step(done, best):
                if done == 12:
                    raise KeyboardInterrupt

            return original(*arguments, on_step=step, **more)

        monkeypatch.setattr(export_plain, "bake", interrupted)
        said = freqgs("export", "--load-config", trained, "--output-dir", tmp_path, "--bake", "--bake-steps", 40)
        assert "stopped by the user after 12 steps" in said and len(rows(tmp_path / "splat.ply")) > 100

    def test_frame_of_the_data_set(self, plain_run, tmp_path, freqgs):
        freqgs("export", "--load-config", plain_run, "--output-dir", tmp_path, "--frame", "dataset")
        loss = manifest(tmp_path / "splat.ply.json")["files"]["splat.ply"]["loss"]["mip_viewers"]
        # rotated harmonics and moved cameras: float32 alone differs
        assert loss["same_pictures"] or loss["psnr_to_our_pictures"] > 70
        scene, _ = load_run(plain_run).raw, None
        assert np.abs(rows(tmp_path / "splat.ply")["x"][:50] - scene.means[:50, 0].numpy()).max() > 0.01
        freqgs("import", tmp_path / "splat.ply", "--output-dir", tmp_path / "runs")
        back = load_run(imported(tmp_path / "runs")).raw
        kept = scene.opacities[:, 0] >= export_plain.FAINTEST_LOGIT
        assert torch.allclose(back.means, scene.means[kept], atol=1e-5)
        assert torch.allclose(back.features_rest, scene.features_rest[kept], atol=1e-5)

    def test_crop(self, plain_run, tmp_path, freqgs, refused):
        more = ("--load-config", plain_run, "--output-dir", tmp_path)
        assert "nothing is left to export" in (said := refused("export", *more, "--crop", 90, 90, 90, 91, 91, 91))
        assert "Centres reach from" in said
        assert "must be under its greatest" in refused("export", *more, "--crop", 1, 0, 0, 0, 1, 1)
        raw = load_run(plain_run).raw
        fine = raw.means[raw.level == 3].double()
        near = [*(fine[0] - 1e-7).tolist(), *(fine[0] + 1e-7).tolist()]
        said = refused("export", *more, "--level", 1, "--crop", *near)
        assert "1 are of levels above 1" in said and "lie outside of the crop" in said
        said = freqgs("export", *more, "--crop", -0.5, -5, -5, 5, 5, 5)
        written = rows(tmp_path / "splat.ply")
        assert "lie outside of the crop" in said and written["x"].min() >= -0.5
        assert "the same as our pictures" in said


class TestDecay:
    def test_as_ns_export_and_farther_away(self, faded, tmp_path, freqgs):
        near = freqgs("export", "--load-config", faded, "--output-dir", tmp_path / "near")
        ns_export(faded, tmp_path / "ns")
        ours, theirs = rows(tmp_path / "near" / "splat.ply"), rows(tmp_path / "ns" / "splat.ply")
        assert all(np.array_equal(ours[name], theirs[name]) for name in theirs.dtype.names)
        assert "as seen from 0.6 of the scene's distance" in near and "dB to our pictures" in near
        far = ("--distance", 0.6, "--detail", 3)
        freqgs("export", "--load-config", faded, "--output-dir", tmp_path / "far", *far)
        thinner = rows(tmp_path / "far" / "splat.ply")
        assert len(thinner) <= len(ours) and thinner["opacity"].mean() < ours["opacity"].mean()

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            (("--detail", 1e9), "fainter than 1/255. Choose a smaller --detail 1e+09."),
            (("--distance", 1e9), "fainter than 1/255. Choose a smaller --distance 1e+09."),
            (("--detail", 0), "--detail 0: give a number above 0"),
            (("--distance", -1), "--distance -1: give a number of 0 or more"),
            (("--distance", 1e300, "--detail", 1e300), "--distance 1e+300 or --detail 1e+300: so far away is nothing"),
        ],
    )
    def test_refusals_name_what_was_given(self, faded, tmp_path, refused, given, message):
        said = " ".join(refused("export", "--load-config", faded, "--output-dir", tmp_path, *given).split())
        assert message in said and list(tmp_path.iterdir()) == []

    def test_baking_brings_them_closer(self, faded, tmp_path, freqgs):
        found = []
        for more in ((), ("--bake", "--bake-steps", 40)):
            freqgs("export", "--load-config", faded, "--output-dir", tmp_path, "--distance", 3, "--overwrite", *more)
            loss = manifest(tmp_path / "splat.ply.json")["files"]["splat.ply"]["loss"]
            found.append(loss["mip_viewers"]["psnr_to_our_pictures"])
        assert found[1] > found[0] + 1

    def test_decay_round_trip(self, faded, tmp_path, freqgs):
        freqgs("export", "--load-config", faded, "--output-dir", tmp_path, "--extra", "decay")
        freqgs("import", tmp_path / "splat.ply", "--output-dir", tmp_path / "runs")
        run, back = load_run(faded), load_run(imported(tmp_path / "runs", "clodsplat"))
        kept = run.raw.opacities[:, 0] >= export_plain.FAINTEST_LOGIT
        for name in (*GROUPS, "decay"):
            assert torch.equal(getattr(back.raw, name), getattr(run.raw, name)[kept]), name
        assert back.scene_distance == pytest.approx(run.scene_distance, rel=1e-6)


class TestLevels:
    def test_signed_round_trip_is_exact(self, trained, tmp_path, freqgs, refused, no_tool):
        more = ("--load-config", trained, "--output-dir", tmp_path, "--format", "levels")
        assert "`freqgs export --format levels --bake`" in refused("export", *more)
        assert "--level 1 leave one level" in refused("export", *more, "--level", 1)
        said = freqgs("export", *more, "--bake", "--bake-steps", 20)
        content = manifest(tmp_path / "levels" / "manifest.json")
        names = ["prefix_1.ply", "prefix_2.ply", "prefix_3.ply", "level_1.ply", "level_2.ply", "level_3.ply"]
        assert list(content["files"]) == names and content["signed_residuals"] is True
        assert content["files"]["prefix_1.ply"]["loss"]["mip_viewers"]["same_pictures"]
        assert content["files"]["level_2.ply"]["loss"] is None
        assert content["streamed_sog"]["ran"] is False
        assert "prefix_3.ply -l 0 prefix_2.ply -l 1 prefix_1.ply -l 2" in said and "npm install" in said
        freqgs("import", tmp_path / "levels", "--output-dir", tmp_path / "runs")
        run, back = load_run(trained), load_run(imported(tmp_path / "runs"))
        order = torch.argsort(run.raw.level, stable=True)
        for name in (*GROUPS, "level"):
            assert torch.equal(getattr(back.raw, name), getattr(run.raw, name)[order]), name
        assert back.gaussians.signed_residuals and back.num_levels == 3 and back.antialiased == run.antialiased
        views, before = back.cameras("test"), run.cameras("test")
        assert [v.name for v in views] == [v.name for v in before]
        assert torch.equal(views[0].camera.viewmat, before[0].camera.viewmat)

    def test_one_level_only(self, faded, tmp_path, refused):
        said = refused("export", "--load-config", faded, "--output-dir", tmp_path, "--format", "levels")
        assert "this scene has one level" in said

    @pytest.mark.parametrize(
        ("failure", "said"),
        [(SplatFileError("out of [memory]"), "out of [memory]"), (KeyboardInterrupt(), "interrupted")],
    )
    def test_without_the_streamed_sog_all_else_stays(self, plain_run, tmp_path, freqgs, monkeypatch, failure, said):
        def fails(*arguments, folder):
            (folder / "sog").mkdir()
            (folder / "back.ply").write_bytes(b"half of it")
            raise failure

        monkeypatch.setattr(export_formats, "find_tool", lambda: "splat-transform")
        monkeypatch.setattr(export_formats, "tool_version", lambda: "3.0")
        monkeypatch.setattr(export_formats, "run_tool", fails)
        told = freqgs(
            "export", "--load-config", plain_run, "--output-dir", tmp_path, "--format", "levels", "--level", 2
        )
        assert f"The streamed SOG is left out ({said}). All else is written" in told and "splat-transform -w" in told
        content = manifest(tmp_path / "levels" / "manifest.json")
        assert content["streamed_sog"]["failed"] == said and content["streamed_sog"]["ran"] is False
        assert {path.name for path in (tmp_path / "levels").iterdir()} == {"manifest.json", *content["files"]}
        assert len(content["files"]) == 4

    def test_streamed_sog(self, plain_run, tmp_path, freqgs):
        if export_formats.find_tool() is None:
            pytest.skip("the program splat-transform (npm's @playcanvas/splat-transform) is not on the PATH")
        more = ("--load-config", plain_run, "--output-dir", tmp_path, "--format", "levels", "--level", 2)
        assert "splat-transform -w" in freqgs("export", *more, "--no-sog")
        freqgs("export", *more, "--overwrite")
        content = manifest(tmp_path / "levels" / "manifest.json")
        assert content["streamed_sog"]["ran"] and (tmp_path / "levels" / "sog" / "lod-meta.json").is_file()
        about = content["files"]["sog"]
        assert about["loss"]["mip_viewers"]["psnr_to_our_pictures"] > 25 and about["bytes"] > 1000
        described = manifest(tmp_path / "levels" / "sog" / "lod-meta.json")
        assert described["lodLevels"] == 2
        freqgs("import", tmp_path / "levels" / "sog" / "lod-meta.json", "--output-dir", tmp_path / "runs")
        run = load_run(imported(tmp_path / "runs"))
        assert len(run.gaussians) == content["files"]["prefix_2.ply"]["gaussians"]


class TestSpz:
    def test_round_trip_states_its_loss(self, plain_run, tmp_path, freqgs):
        if export_formats.find_tool() is None:
            pytest.skip("the program splat-transform (npm's @playcanvas/splat-transform) is not on the PATH")
        freqgs("export", "--load-config", plain_run, "--output-dir", tmp_path, "--format", "spz")
        about = manifest(tmp_path / "splat.spz.json")["files"]["splat.spz"]
        assert 30 < about["loss"]["mip_viewers"]["psnr_to_our_pictures"] < 120
        freqgs("import", tmp_path / "splat.spz", "--output-dir", tmp_path / "runs")
        run = load_run(imported(tmp_path / "runs"))
        assert len(run.gaussians) == about["gaussians"] and run.antialiased

    def test_without_the_program(self, plain_run, tmp_path, refused, no_tool):
        said = refused("export", "--load-config", plain_run, "--output-dir", tmp_path, "--format", "spz")
        assert "npm install -g @playcanvas/splat-transform" in said

    def test_a_program_that_fails(self, plain_run, tmp_path, refused, monkeypatch):
        program = tmp_path / "bin" / "splat-transform"
        program.parent.mkdir()
        program.write_text("#!/bin/sh\necho no memory >&2\nexit 3\n")
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
        said = refused("export", "--load-config", plain_run, "--output-dir", tmp_path / "out", "--format", "spz")
        assert "failed with status 3: no memory" in said and not (tmp_path / "out").exists()


class TestImport:
    def test_every_command_takes_the_run(self, plain_run, tmp_path, freqgs):
        freqgs("export", "--load-config", plain_run, "--output-dir", tmp_path, "--extra", "level")
        freqgs("import", tmp_path / "splat.ply", "--output-dir", tmp_path / "runs", "--experiment-name", "again")
        config = imported(tmp_path / "runs")
        assert config.parts[-4] == "again"
        before, after = load_run(plain_run), load_run(config)
        kept = before.raw.opacities[:, 0] >= export_plain.FAINTEST_LOGIT
        for name in (*GROUPS, "level"):
            assert torch.equal(getattr(after.raw, name), getattr(before.raw, name)[kept]), name
        ns_export(config, tmp_path / "ns")
        ours = rows(tmp_path / "splat.ply")
        assert all(np.array_equal(ours[n], rows(tmp_path / "ns" / "splat.ply")[n]) for n in ours.dtype.names[:-1])
        said = freqgs("render", "--load-config", config, "--output-dir", tmp_path / "pictures", "--level", 1)
        assert "3 frames" in said

    def test_there_is_nothing_to_resume(self, plain_run, tmp_path, freqgs, make_trainer):
        freqgs("export", "--load-config", plain_run, "--output-dir", tmp_path)
        freqgs("import", tmp_path / "splat.ply", "--output-dir", tmp_path / "runs")
        folder = imported(tmp_path / "runs").parent
        with pytest.raises(ValueError, match=r"written by `freqgs import`.*init-from"):
            make_trainer(load_dir=folder / "nerfstudio_models", num_levels=1)
        started = make_trainer(method="clodsplat", init_from=folder)
        assert started.pipeline.model.num_points == load_run(folder / "config.yml").model.num_points

    def test_a_path_is_no_name(self, plain_run, scene, tmp_path, refused):
        write_ply(tmp_path / "theirs.ply", load_run(plain_run).raw)
        for name in ("../../elsewhere", "/elsewhere", ".."):
            more = ("--output-dir", tmp_path / "runs" / "deep", "--data", scene, f"--experiment-name={name}")
            assert "give the name of a folder" in refused("import", tmp_path / "theirs.ply", *more)
        assert not (tmp_path / "runs").exists()

    def test_a_file_of_others_needs_the_photographs(self, plain_run, scene, tmp_path, freqgs, refused):
        raw = load_run(plain_run).raw
        write_ply(tmp_path / "theirs.ply", raw)
        assert "add --data FOLDER" in refused("import", tmp_path / "theirs.ply", "--output-dir", tmp_path / "runs")
        freqgs("import", tmp_path / "theirs.ply", "--output-dir", tmp_path / "runs", "--data", scene)
        assert load_run(imported(tmp_path / "runs")).model.config.rasterize_mode == "classic"

    def test_what_is_no_export(self, tmp_path, refused):
        (tmp_path / "notes.ply").write_text("hello")
        assert "is no PLY file" in refused("import", tmp_path / "notes.ply")
        assert "does not exist" in refused("import", tmp_path / "missing.ply")
        assert "holds no manifest.json" in refused("import", tmp_path)
        (tmp_path / "manifest.json").write_text('{"format": "something"}')
        assert "is no manifest of `freqgs export`" in refused("import", tmp_path)
        (tmp_path / "manifest.json").write_text("{")
        assert "is damaged" in refused("import", tmp_path)

    def test_a_folder_without_a_scene(self, plain_run, tmp_path, refused):
        write_ply(tmp_path / "theirs.ply", load_run(plain_run).raw)
        (tmp_path / "empty").mkdir()
        said = refused("import", tmp_path / "theirs.ply", "--data", tmp_path / "empty", "--output-dir", tmp_path / "r")
        assert str(tmp_path / "empty") in said and not list(tmp_path.glob("r/*/*/*/config.yml"))


class TestBadInput:
    def test_refusals(self, plain_run, faded, tmp_path, refused):
        more = ("--load-config", plain_run, "--output-dir", tmp_path / "out")
        assert "unknown. Choose one of: ply, levels" in refused("export", *more, "--format", "fbx")
        assert "this scene has levels 1..3" in refused("export", *more, "--level", 7)
        assert "this one has none" in refused("export", *more, "--distance", 0.5)
        assert "this scene has no decay" in refused("export", *more, "--extra", "decay")
        assert "--variant small does nothing with --format ply, but with stream" in refused(
            "export", *more, "--variant", "small"
        )
        assert "--no-sog does nothing with --format ply" in refused("export", *more, "--no-sog")
        assert "--bake-steps 5 does nothing without --bake" in refused("export", *more, "--bake-steps", 5)
        assert "give --load-config" in refused("export", "--output-dir", tmp_path / "out")
        assert not (tmp_path / "out").exists()

    def test_what_exists_stays(self, plain_run, tmp_path, freqgs, refused):
        (tmp_path / "splat.ply").write_text("precious")
        more = ("--load-config", plain_run, "--output-dir", tmp_path, "--level", 1)
        assert "add --overwrite" in refused("export", *more)
        assert (tmp_path / "splat.ply").read_text() == "precious"
        freqgs("export", *more, "--overwrite")
        assert len(rows(tmp_path / "splat.ply")) > 10

    def test_a_full_disk(self, plain_run, tmp_path, refused, monkeypatch):
        def full(*_, **__):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(export_formats, "write_ply", full)
        assert "No space left" in refused("export", "--load-config", plain_run, "--output-dir", tmp_path / "out")
        assert not (tmp_path / "out").exists()

    def test_gaussians_that_are_not_finite(self, plain_run, tmp_path, freqgs):
        folder = shutil.copytree(plain_run.parent, tmp_path / "small" / "lapsplat" / "run")
        path = sorted((folder / "nerfstudio_models").glob("*.ckpt"))[-1]
        checkpoint = torch.load(path, map_location="cpu")
        checkpoint["pipeline"]["_model.gauss_params.scales"][:5, 1] = float("nan")
        torch.save(checkpoint, path)
        said = freqgs("export", "--load-config", folder / "config.yml", "--output-dir", tmp_path / "out", "--level", 1)
        assert "5 of" in said and "NaN or infinite" in said
        assert np.isfinite(rows(tmp_path / "out" / "splat.ply")["scale_1"]).all()

    def test_the_page(self, plain_run, tmp_path, freqgs, refused):
        page = tmp_path / "page.md"
        page.write_text("# Export\n")
        more = ("--load-config", plain_run, "--output-dir", tmp_path / "out", "--docs", page, "--level", 1)
        assert "<!-- export lapsplat small ply -->" in refused("export", *more)
        page.write_text("<!-- export lapsplat small ply -->\n<!-- end of export lapsplat small ply -->\n")
        freqgs("export", *more)
        assert "| splat.ply |" in page.read_text() and str(tmp_path) not in page.read_text()


def test_a_truncated_checkpoint_is_named(trained, tmp_path, refused):
    config = shutil.copytree(trained.parent, tmp_path / "small" / "lapsplat" / "cut") / "config.yml"
    (checkpoint,) = sorted((config.parent / "nerfstudio_models").glob("*.ckpt"))[-1:]
    checkpoint.write_bytes(checkpoint.read_bytes()[:5000])
    for command in ("export", "render"):
        said = re.sub(r"\s+", " ", refused(command, "--load-config", config, "--output-dir", tmp_path / "out"))
        assert "cannot be loaded" in said and "damaged" in said and not (tmp_path / "out").exists()
