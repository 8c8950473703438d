"""nerfstudio's own commands on a run that `ns-train` made."""

import gzip
import json
import re
import shutil
import sys

import numpy as np
import plyfile
import pytest
import torch
import yaml
from PIL import Image
from running import (
    DECAY_START,
    EVERY,
    SCALE,
    SIZE,
    STEPS,
    advance,
    command,
    gains_over_mean_colour,
    save,
    train_arguments,
)

pytestmark = pytest.mark.slow

STAGES = {1: 25, 2: 75, 3: 125}
"""a checkpoint of each stage"""


def checkpoints(config):
    return config.parent / "nerfstudio_models"


def load(config, step):
    return torch.load(checkpoints(config) / f"step-{step:09d}.ckpt", map_location="cpu")


def levels(checkpoint):
    return torch.bincount(checkpoint["pipeline"]["_model.level"].long())[1:].tolist()


def metrics_of(folder):
    """What nerfstudio wrote for tensorboard."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return events


class TestTraining:
    def test_stages_and_what_is_said(self, trained):
        text = re.sub(r"\s+", " ", (trained.parent / "log.txt").read_text())
        assert f"Step constants are multiplied by {SCALE}" in text
        for step, level, size in ((50, 2, "1/2"), (100, 3, "1/1")):
            assert re.search(rf"Step {step}: level {level} of 3 begins with [\d,]+ Gaussians, at {size} size", text)
        assert re.search(r"Step \d+: \d+ duplicated, [\d,]+ split, [\d,]+ pruned; now [\d,]+ Gaussians, by level", text)
        assert "9 views (6 to train on, 3 held out), 80x64 px, 300 points" in text

    def test_checkpoints_hold_each_stage(self, trained):
        for stage, step in STAGES.items():
            checkpoint = load(trained, step)
            state = checkpoint["pipeline"]["_model._extra_state"]
            assert (state["step"], state["stage"], state["num_levels"], state["steps_scale"]) == (step, stage, 3, SCALE)
            assert len(levels(checkpoint)) == stage and min(levels(checkpoint)) > 0
            assert all(bool(v.isfinite().all()) for v in checkpoint["pipeline"].values() if torch.is_tensor(v))

    def test_tensorboard(self, trained):
        events = metrics_of(trained.parent)
        tags = set(events.Tags()["scalars"])
        expected = {"Train Loss", "learning_rate/means"}
        expected |= {f"Train Loss Dict/{k}" for k in ("image_1", "image_2", "image_3", "dft")}
        names = ("psnr", "stage", "width", "height", "gaussian_count", "skipped_steps")
        expected |= {f"Train Metrics Dict/{k}" for k in (*names, *(f"gaussians_level_{k}" for k in (1, 2, 3)))}
        expected |= {f"Eval Images Metrics Dict (all images)/psnr_prefix_{k}" for k in (1, 2, 3)}
        assert expected <= tags, expected - tags
        stages = {e.step: e.value for e in events.Scalars("Train Metrics Dict/stage")}
        widths = {e.step: e.value for e in events.Scalars("Train Metrics Dict/width")}
        for step, stage in stages.items():
            assert stage == 1 + step // 50
            assert widths[step] == SIZE[0] // 2 ** (3 - stage)
        rates = {e.step: e.value for e in events.Scalars("learning_rate/means")}
        assert min(rates) < 50 and all(v > 0 for v in rates.values())

    def test_it_learns(self, trained):
        gains = gains_over_mean_colour(trained)
        assert min(gains) > 0 and np.mean(gains) > 1, gains

    def test_memory(self, trained):
        peak = float((trained.parent / "peak.txt").read_text())
        print(f"peak resident memory of ns-train: {peak:.2f} GB")
        if sys.platform == "linux":
            assert 0.3 < peak < 3


class TestEval:
    @pytest.fixture(scope="class")
    def report(self, trained, tmp_path_factory):
        folder = tmp_path_factory.mktemp("eval")
        done = command(
            *("ns-eval", "--load-config", trained, "--output-path", folder / "eval.json"),
            *("--render-output-path", folder / "images"),
        )
        assert done.code == 0, str(done)
        return folder, json.loads((folder / "eval.json").read_text())

    def test_numbers(self, report, trained):
        folder, text = report
        results = text["results"]
        assert text["method_name"] == "lapsplat" and text["checkpoint"].endswith(f"step-{STEPS - 1:09d}.ckpt")
        names = ["psnr", "ssim", "gaussians", "lpips_computed"]
        names += [f"{what}_{k}" for k in (1, 2, 3) for what in ("psnr_prefix", "gaussians_prefix", "gaussians_level")]
        assert set(names) <= set(results)
        assert all(np.isfinite(v) for v in results.values()), results
        counts = levels(load(trained, STEPS - 1))
        assert [results[f"gaussians_level_{k}"] for k in (1, 2, 3)] == counts
        assert [results[f"gaussians_prefix_{k}"] for k in (1, 2, 3)] == np.cumsum(counts).tolist()
        assert results["psnr_prefix_3"] == pytest.approx(results["psnr"], abs=1e-3)
        assert ("lpips" in results) == bool(results["lpips_computed"])
        assert len(list((folder / "images").iterdir())) == 3

    def test_the_numbers_are_those_of_the_pictures(self, report):
        """ns-eval saves truth and prediction side by side."""
        folder, text = report
        values = []
        for path in (folder / "images").iterdir():
            truth, predicted = np.split(np.asarray(Image.open(path), np.float64) / 255, 2, axis=1)
            values.append(-10 * np.log10(np.mean((truth - predicted) ** 2)))
        assert np.mean(values) == pytest.approx(text["results"]["psnr"], abs=0.02)


def pictures(folder):
    return {path.name: np.asarray(Image.open(path)).astype(int) for path in sorted(folder.iterdir())}


class TestRender:
    def test_dataset(self, trained, tmp_path):
        names = ["rgb", "prefix_1", "prefix_2", "prefix_3", "band_2", "levels", "depth", "gt-rgb", "raw-prefix_1"]
        done = command(
            *("ns-render", "dataset", "--load-config", trained, "--output-path", tmp_path, "--image-format", "png"),
            *("--rendered-output-names", *names),
        )
        assert done.code == 0, str(done)
        assert {p.name for p in (tmp_path / "test").iterdir()} == set(names)
        seen = {name: pictures(tmp_path / "test" / name) for name in names[:-1]}
        for name, images in seen.items():
            assert len(images) == 3, name
            assert all(image.shape == (SIZE[1], SIZE[0], 3) for image in images.values()), name
        for view, image in seen["rgb"].items():
            assert np.array_equal(image, seen["prefix_3"][view])
            assert not np.array_equal(image, seen["prefix_1"][view])
            assert not np.array_equal(image, seen["gt-rgb"][view])
            inside = (seen["prefix_1"][view] > 2) & (seen["prefix_2"][view] < 253)
            band = 127.5 + seen["prefix_2"][view] - seen["prefix_1"][view]
            close = np.abs(band.clip(0, 255) - seen["band_2"][view])[inside & (seen["prefix_1"][view] < 253)]
            assert np.quantile(close, 0.9) <= 2
        raw = next((tmp_path / "test" / "raw-prefix_1").glob("*.npy.gz"))
        with gzip.open(raw) as file:
            values = np.load(file)
        view = raw.name.replace(".npy.gz", ".png")
        assert np.abs(values * 255 - seen["prefix_1"][view]).max() <= 1

    def test_a_wrong_output_name(self, trained, tmp_path, capsys, render):
        with pytest.raises(SystemExit):
            render(
                *("dataset", "--load-config", trained, "--output-path", tmp_path),
                *("--rendered-output-names", "prefix_9"),
            )
        said = capsys.readouterr().out
        assert "Could not find prefix_9" in said and "'prefix_1'" in said and "'band_3'" in said

    def test_camera_path(self, trained, tmp_path, render):
        path = {
            "camera_type": "perspective",
            "render_height": 48,
            "render_width": 64,
            "seconds": 1,
            "fps": 3,
            "camera_path": [
                {"camera_to_world": pose(angle).flatten().tolist(), "fov": 50, "aspect": 4 / 3} for angle in (0, 1, 2)
            ],
        }
        (tmp_path / "path.json").write_text(json.dumps(path))
        render(
            *("camera-path", "--load-config", trained, "--camera-path-filename", tmp_path / "path.json"),
            *("--output-path", tmp_path / "out.mp4", "--output-format", "images", "--image-format", "png"),
            *("--rendered-output-names", "rgb", "prefix_1", "band_3"),
        )
        images = pictures(tmp_path / "out")
        assert len(images) == 3
        for image in images.values():
            assert image.shape == (48, 3 * 64, 3)
            assert not np.array_equal(image[:, :64], image[:, 64:128])

    def test_interpolate(self, trained, tmp_path, render):
        render(
            *("interpolate", "--load-config", trained, "--output-path", tmp_path / "out.mp4"),
            *("--output-format", "images", "--image-format", "png", "--interpolation-steps", 2),
            *("--rendered-output-names", "prefix_2"),
        )
        assert all(image.shape == (SIZE[1], SIZE[0], 3) for image in pictures(tmp_path / "out").values())


def pose(angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
    back = np.eye(4)
    back[2, 3] = 1.0
    return turn @ back


@pytest.fixture
def render(monkeypatch):
    """ns-render in this process, under the type checks. It asks for ffmpeg even where it writes images only."""
    import tyro
    from nerfstudio.scripts import render

    monkeypatch.setattr(render.install_checks, "check_ffmpeg_installed", lambda: None)
    return lambda *arguments: tyro.cli(render.Commands, args=[str(a) for a in arguments]).main()


def export(config, folder, *more):
    import tyro
    from nerfstudio.scripts.exporter import Commands

    arguments = ["gaussian-splat", "--load-config", config, "--output-dir", folder, *more]
    tyro.cli(Commands, args=[str(a) for a in arguments]).main()


class TestExport:
    def test_signed_residuals_are_refused_with_the_reason(self, trained, tmp_path):
        done = command("ns-export", "gaussian-splat", "--load-config", trained, "--output-dir", tmp_path)
        assert done.code != 0
        assert "3 levels with signed residual colours" in done.text, str(done)
        assert "--pipeline.model.signed-residuals False" in done.text
        assert not list(tmp_path.glob("*.ply"))

    def test_as_colours_too(self, trained, tmp_path):
        with pytest.raises(ValueError, match="signed residual colours"):
            export(trained, tmp_path, "--ply-color-mode", "rgb")

    @pytest.mark.parametrize("settings", [{"signed_residuals": False}, {"num_levels": 1}])
    def test_others_are_written_as_they_are(self, make_trainer, tmp_path, settings):
        trainer = make_trainer(steps_scale=0.004, least_refine_interval=EVERY, **settings)
        model = trainer.pipeline.model
        advance(trainer, 25)
        save(trainer)
        export(trainer.config.get_base_dir() / "config.yml", tmp_path)
        rows = plyfile.PlyData.read(tmp_path / "splat.ply")["vertex"].data
        kept = model.opacities.detach().flatten() >= -5.5373
        assert len(rows) == int(kept.sum()) > 0.5 * model.num_points

        def columns(*names):
            return np.stack([rows[name] for name in names], -1)

        def expect(parameter, *names):
            assert np.array_equal(columns(*names), parameter.detach()[kept].numpy()), names

        expect(model.means, "x", "y", "z")
        expect(model.features_dc, "f_dc_0", "f_dc_1", "f_dc_2")
        expect(model.features_rest.transpose(1, 2).flatten(1), *(f"f_rest_{i}" for i in range(45)))
        expect(model.opacities, "opacity")
        expect(model.scales, "scale_0", "scale_1", "scale_2")
        expect(model.quats, "rot_0", "rot_1", "rot_2", "rot_3")


class TestResume:
    @pytest.fixture
    def again(self, trained, scene, tmp_path):
        def run(stage, *more):
            arguments = train_arguments(
                *(scene, tmp_path, "--load-dir", checkpoints(trained), "--load-step", STAGES[stage]),
                *("--steps-per-save", 1, "--save-only-latest-checkpoint", False, *more),
                timestamp="resumed",
            )
            done = command("ns-train", *arguments)
            assert done.code == 0, str(done)
            return tmp_path / "small" / "lapsplat" / "resumed" / "config.yml", re.sub(r"\s+", " ", done.text)

        return run

    @pytest.mark.parametrize("stage", STAGES)
    def test_from_each_stage_to_the_end(self, trained, again, stage):
        steps = STEPS - 1 - STAGES[stage]
        config, text = again(stage, "--max-num-iterations", steps)
        begun = [int(k) for k in re.findall(r"level (\d) of 3 begins", text)]
        assert begun == [k for k in (2, 3) if k > stage]
        first = load(config, STAGES[stage] + 1)
        # nothing is refined between
        assert levels(first) == levels(load(trained, STAGES[stage]))
        last = load(config, STEPS - 1)
        state = last["pipeline"]["_model._extra_state"]
        assert (state["stage"], state["step"], state["steps_scale"]) == (3, STEPS - 1, SCALE)
        assert min(levels(last)) > 0 and len(levels(last)) == 3
        assert (
            last["schedulers"]["means"]["last_epoch"] == load(trained, STEPS - 1)["schedulers"]["means"]["last_epoch"]
        )
        assert f"Step constants are multiplied by {SCALE}" in text


def test_a_foreign_checkpoint_is_refused(trained, scene, make_trainer, tmp_path):
    """As `ns-train lapsplat --load-dir` of a splatfacto run would meet it."""
    checkpoint = load(trained, STAGES[1])
    for key in ("_model.level", "_model._extra_state"):
        del checkpoint["pipeline"][key]
    torch.save(checkpoint, tmp_path / "step-000000025.ckpt")
    with pytest.raises(ValueError, match=r"not made by this method. Load it with the method that made it"):
        make_trainer(load_dir=tmp_path)


def test_a_run_is_loaded_as_plain_gaussians(trained):
    from freqgs_plugin.studio.checkpoint import load_run

    run = load_run(trained)
    assert (run.step, run.num_levels, len(run.gaussians)) == (STEPS - 1, 3, sum(levels(load(trained, STEPS - 1))))
    views = run.cameras("test")
    assert [v.name for v in views] == ["view_000.png", "view_004.png", "view_008.png"]
    assert views[0].image.shape == (SIZE[1], SIZE[0], 3) and float(views[0].image.max()) <= 1
    assert len(run.cameras("train")) == 6
    with pytest.raises(FileNotFoundError, match="is no file"):
        load_run(trained.parent / "nothing.yml")


def test_a_run_is_loaded_from_where_it_lies(trained, tmp_path):
    """Not from where its config says that it was written: that may be relative to another folder, or gone."""
    from freqgs_plugin.studio.checkpoint import load_run

    moved = tmp_path / "moved" / "renamed" / trained.parents[1].name / "again" / trained.name
    shutil.copytree(trained.parent, moved.parent)
    run = load_run(moved)
    assert run.step == STEPS - 1 and run.config.load_dir == moved.parent / "nerfstudio_models"
    elsewhere = tmp_path / "moved" / "renamed" / "other" / "again" / trained.name
    shutil.copytree(trained.parent, elsewhere.parent)
    with pytest.raises(FileNotFoundError, match=r"is of method lapsplat, and no folder above it is called so"):
        load_run(elsewhere)


def test_a_run_without_checkpoints(trained, tmp_path):
    from freqgs_plugin.studio.checkpoint import load_run

    shutil.copy(trained, tmp_path / "config.yml")
    with pytest.raises(FileNotFoundError, match=r"holds no step-000000000\.ckpt"):
        load_run(tmp_path / "config.yml")


def test_config_is_readable(trained):
    config = yaml.load(trained.read_text(), Loader=yaml.Loader)
    assert config.method_name == "lapsplat" and config.pipeline.model.num_levels == 3


DETAILS = ("1", "1.5", "2", "3", "5", "7")


class TestClodsplat:
    """The same commands on a run of the other method."""

    def test_training(self, faded):
        text = re.sub(r"\s+", " ", (faded.parent / "log.txt").read_text())
        assert f"Step {DECAY_START}: opacities decay with distance from here on." in text
        before, after = (load(faded, step)["pipeline"] for step in (25, STEPS - 1))
        assert bool((before["_model.gauss_params.decay"] == 5).all()) and not before["_model._extra_state"]["decays"]
        assert after["_model._extra_state"]["decays"] and after["_model.gauss_params.decay"].std() > 0.01
        assert len(after["_model.gauss_params.decay"]) == len(after["_model.level"])
        events = metrics_of(faded.parent)
        tags = {f"Train Metrics Dict/{k}" for k in ("scale", "drawn_share", "decay_mean", "dead_decay")}
        assert tags | {"Train Loss Dict/count"} <= set(events.Tags()["scalars"])
        assert {e.step >= DECAY_START for e in events.Scalars("Train Metrics Dict/scale")} == {True}
        gains = gains_over_mean_colour(faded)
        assert min(gains) > 0 and np.mean(gains) > 1, gains

    def test_eval(self, faded, tmp_path):
        done = command("ns-eval", "--load-config", faded, "--output-path", tmp_path / "eval.json")
        assert done.code == 0, str(done)
        results = json.loads((tmp_path / "eval.json").read_text())["results"]
        kinds = ("psnr", "gaussians", "milliseconds")
        assert {f"{kind}_detail_{s}" for kind in kinds for s in DETAILS} | {"dead_decay"} <= set(results)
        assert all(np.isfinite(v) for v in results.values()), results
        counts = [results[f"gaussians_detail_{s}"] for s in DETAILS]
        assert counts == sorted(counts, reverse=True) and counts[0] <= results["gaussians"]
        assert results["psnr_detail_1"] == pytest.approx(results["psnr"], abs=1e-3)

    def test_render(self, faded, tmp_path):
        names = ["rgb", *(f"detail_{s}" for s in DETAILS), "drawn_share", "decay"]
        done = command(
            *("ns-render", "dataset", "--load-config", faded, "--output-path", tmp_path, "--image-format", "png"),
            *("--rendered-output-names", *names),
        )
        assert done.code == 0, str(done)
        seen = {name: pictures(tmp_path / "test" / name) for name in names}
        for name, images in seen.items():
            assert len(images) == 3, name
            assert all(image.shape == (SIZE[1], SIZE[0], 3) for image in images.values()), name
        for view, image in seen["rgb"].items():
            assert np.array_equal(image, seen["detail_1"][view])
            assert not np.array_equal(image, seen["detail_5"][view])

    def test_camera_path(self, faded, tmp_path, render):
        path = {
            "camera_type": "perspective", "render_height": 48, "render_width": 64, "seconds": 1, "fps": 2,
            "camera_path": [
                {"camera_to_world": pose(angle).flatten().tolist(), "fov": 50, "aspect": 4 / 3} for angle in (0, 1)
            ],
        }  # fmt: skip
        (tmp_path / "path.json").write_text(json.dumps(path))
        render(
            *("camera-path", "--load-config", faded, "--camera-path-filename", tmp_path / "path.json"),
            *("--output-path", tmp_path / "out.mp4", "--output-format", "images", "--image-format", "png"),
            *("--rendered-output-names", "detail_2"),
        )
        assert all(image.shape == (48, 64, 3) for image in pictures(tmp_path / "out").values())

    def test_export_says_from_where(self, faded, tmp_path):
        done = command("ns-export", "gaussian-splat", "--load-config", faded, "--output-dir", tmp_path)
        assert done.code == 0, str(done)
        assert "opacities are those seen from 0.6 of the scene's distance" in re.sub(r"\s+", " ", done.text)
        rows = plyfile.PlyData.read(tmp_path / "splat.ply")["vertex"].data
        state = load(faded, STEPS - 1)["pipeline"]
        sigma, logits = (state[f"_model.gauss_params.{name}"].flatten().double() for name in ("decay", "opacities"))
        faint = torch.sigmoid(logits) * torch.exp(-(0.6**2) / (2 * sigma.clamp_min(0) ** 2 + 1e-8))
        expected = torch.logit(faint.clamp_min(1e-30)).numpy()
        # nerfstudio leaves out what is under 1/255; rounding may decide for rows at the very threshold
        surely = -5.5373 + 1e-3
        written, expected = rows["opacity"][rows["opacity"] > surely], expected[expected > surely]
        assert len(written) > 0.5 * len(rows) > 0
        np.testing.assert_allclose(written, expected, atol=1e-4)

    @pytest.mark.parametrize("step", [25, 75])
    def test_resume(self, faded, scene, tmp_path, step):
        more = ["--load-dir", checkpoints(faded), "--load-step", step, "--max-num-iterations", STEPS - 1 - step]
        more += ["--pipeline.model.decay-start-step", round(DECAY_START / SCALE)]
        done = command("ns-train", *train_arguments(scene, tmp_path, *more, timestamp="again", method="clodsplat"))
        assert done.code == 0, str(done)
        text = re.sub(r"\s+", " ", done.text)
        assert (f"Step {DECAY_START}: opacities decay" in text) == (step < DECAY_START)
        state = load(tmp_path / "small" / "clodsplat" / "again" / "config.yml", STEPS - 1)["pipeline"]
        assert state["_model._extra_state"]["decays"] and len(state["_model.gauss_params.decay"]) > 1

    def test_as_plain_gaussians(self, faded):
        from freqgs_plugin.studio.checkpoint import load_run

        run = load_run(faded)
        assert run.gaussians.decay is not None and run.gaussians.decay.shape == (len(run.gaussians),)
        assert run.scene_distance == run.model.scene_distance and run.num_levels == 1
