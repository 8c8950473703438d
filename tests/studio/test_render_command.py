"""`freqgs render` on trained runs, as a user calls it."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from running import SIZE, command

from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.apps.rescaled import render_rescaled
from freqgs_plugin.cli import main
from freqgs_plugin.commands.scene import open_scene, resized
from freqgs_plugin.functional.budget import DecayBudget
from freqgs_plugin.io.images import read_image, to_uint8, write_image
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.io.ply import write_ply
from freqgs_plugin.reports.contact_sheet import GAP, LABEL
from freqgs_plugin.studio.checkpoint import load_run
from freqgs_plugin.studio.clodsplat import ClodSplatModelConfig

pytestmark = pytest.mark.slow


@pytest.fixture
def render(capsys):
    """`freqgs render` in this process: what it printed."""

    def run(*arguments):
        main(["render", *map(str, arguments)])
        return capsys.readouterr().out

    return run


def frames(folder):
    return {r["name"]: r for r in json.loads((folder / "frames.json").read_text())["frames"]}


def camera_path(run, folder, count=3):
    """What the viewer saves: OpenGL poses by rows, vertical field of view in degrees."""
    views = []
    for view in run.cameras("test")[:count]:
        pose = torch.linalg.inv(view.camera.viewmat.double()) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        fov = 2 * np.degrees(np.arctan(view.camera.height / 2 / float(view.camera.K[1, 1])))
        views.append({"camera_to_world": pose.flatten().tolist(), "fov": fov, "aspect": 1})
    path = folder / "path.json"
    path.write_text(json.dumps({"render_width": 80, "render_height": 64, "fps": 8, "camera_path": views}))
    return path


def test_levels_of_held_out_views(trained, tmp_path, render):
    run = load_run(trained)
    base = tmp_path / "base"
    done = command("freqgs", "render", "--load-config", str(trained), "--output-dir", str(base), "--level", "1")
    assert done.code == 0, str(done)
    base = frames(tmp_path / "base")
    assert {r["drawn"] for r in base.values()} == {int((run.gaussians.level == 1).sum())}
    # what rich takes for markup is part of the name
    text = render("--load-config", trained, "--output-dir", tmp_path / "[" / "b]", "--video", "always")
    assert str(tmp_path / "[" / "b]" / "video.mp4") in text
    render("--load-config", trained, "--output-dir", tmp_path / "all")
    for view in run.cameras("test"):
        name = view.name.rsplit(".", 1)[0]
        with torch.no_grad():
            expected = run.model.draw(run.gaussians, view.camera, run.background).features
        shown = read_image(tmp_path / "all" / f"{name}.png")
        assert np.abs(shown.astype(int) - to_uint8(expected.numpy())).max() <= 1
        assert (shown != read_image(tmp_path / "base" / f"{name}.png")).mean() > 0.1
    assert not (tmp_path / "all" / "video.mp4").exists()
    # once more: nothing is drawn again
    before = (tmp_path / "all" / "frames.json").stat().st_mtime_ns
    render("--load-config", trained, "--output-dir", tmp_path / "all")
    assert (tmp_path / "all" / "frames.json").stat().st_mtime_ns == before


def test_a_path_with_budget_gaze_and_filter(trained, tmp_path, render):
    path = camera_path(load_run(trained), tmp_path)
    out = tmp_path / "out"
    more = ["--budget", 300, "--gaze", "auto", "--filter", "xray", "--size", 96, 64]
    text = render("--load-config", trained, "--path", path, "--output-dir", out, *more)
    records = frames(out)
    assert list(records) == ["frame_00000", "frame_00001", "frame_00002"]
    assert all(0 < r["drawn"] <= 300 and len(r["gaze"]) == 2 for r in records.values())
    assert read_image(out / "frame_00001.png").shape == (64, 96, 3)
    assert (out / "video.mp4").stat().st_size > 0
    assert "at most 300 Gaussians" in text


def test_a_gaze_with_fewer_pixels_is_the_rescaled_picture(trained, tmp_path, render):
    """That this is the plain one where one looks is tested on small Gaussians (tests/apps): the few of this run are
    large, and the projection holds some of them within the margin of the smaller image."""
    gaze = ["--gaze", "0.25,0.5", "--gaze-radius", 0.06, "--gaze-sigma", 0.05, "--size", 320, 256]
    for name, times in (("plain", []), ("fewer", ["--gaze-scale", 4])):
        render("--load-config", trained, "--output-dir", tmp_path / name, *gaze, *times)
    drawn = [[r["drawn"] for r in frames(tmp_path / name).values()] for name in ("plain", "fewer")]
    assert drawn[0] == drawn[1]
    run, look = load_run(trained), Foveation((0.25, 0.5), sigma=0.05, radius=0.06)
    options = {"rasterizer": run.rasterizer, "background": run.background, "antialiased": run.antialiased}
    for view, name in zip(run.cameras("test"), frames(tmp_path / "fewer"), strict=True):
        camera = resized(view.camera, 320, 256)
        with torch.no_grad():
            expected = to_uint8(
                render_rescaled(run.gaussians, camera, look, times=4, **options).features.clamp(0, 1).numpy()
            )
        plain, fewer = (read_image(tmp_path / d / f"{name}.png").astype(int) for d in ("plain", "fewer"))
        assert np.abs(fewer - expected).max() <= 1
        assert (plain != fewer)[:, 200:].any()


def test_a_path_shows_what_the_views_show(trained, tmp_path, render):
    run = load_run(trained)
    path = camera_path(run, tmp_path)
    render("--load-config", trained, "--path", path, "--output-dir", tmp_path / "p")
    for i, view in enumerate(run.cameras("test")):
        with torch.no_grad():
            expected = to_uint8(run.model.draw(run.gaussians, view.camera, run.background).features.numpy())
        shown = read_image(tmp_path / "p" / f"frame_{i:05d}.png").astype(int)
        assert shown.shape == (SIZE[1], SIZE[0], 3)
        assert np.abs(shown - expected).mean() < 0.2


def test_detail_and_time_of_a_scene_with_decay(faded, tmp_path, render):
    for name, more in (("far", ["--detail", 20]), ("all", []), ("quick", ["--budget", "1s"])):
        text = render("--load-config", faded, "--output-dir", tmp_path / name, *more)
    far, everything = frames(tmp_path / "far"), frames(tmp_path / "all")
    assert all(far[name]["drawn"] <= everything[name]["drawn"] for name in everything)
    for name in everything:
        change = read_image(tmp_path / "far" / f"{name}.png") != read_image(tmp_path / "all" / f"{name}.png")
        assert change.mean() > 0.1
    assert "measured here:" in text


def test_a_budget_of_time_is_measured_once_for_a_folder(faded, tmp_path, monkeypatch, render):
    arguments = ("--load-config", faded, "--output-dir", tmp_path / "out", "--budget", "1s")
    render(*arguments)
    before = frames(tmp_path / "out")
    next((tmp_path / "out").glob("*.png")).unlink()
    monkeypatch.setattr("freqgs_plugin.commands.render.calibrate", None)
    text = render(*arguments)
    assert "as in the frames that are there" in text and "measured here:" not in text
    assert {name: r["drawn"] for name, r in frames(tmp_path / "out").items()} == {
        name: r["drawn"] for name, r in before.items()
    }


def test_a_budget_holds_the_scale_that_decays_were_trained_for(faded, tmp_path, render):
    """Beyond it everything fades; what shows most stays instead, as in the viewer."""
    run = load_run(faded)
    view = run.cameras("test")[0]
    render("--load-config", faded, "--output-dir", tmp_path / "few", "--budget", 40)
    held = DecayBudget(40, "scene", run.scene_distance, largest=run.largest_scale)
    with torch.no_grad():
        expected = to_uint8(run.model.draw(run.gaussians, view.camera, run.background, held).features.numpy())
        free = to_uint8(
            run.model.draw(run.gaussians, view.camera, run.background, replace(held, largest=math.inf)).features.numpy()
        )
    shown = read_image(tmp_path / "few" / f"{Path(view.name).stem}.png").astype(int)
    assert np.abs(shown - expected).max() <= 1 < np.abs(shown - free).max()


def test_of_a_file_alone_the_default_is_the_largest_scale(faded):
    scene = open_scene(faded, None, "numba")
    assert scene.largest_scale == scene.run.largest_scale
    assert replace(scene, run=None).largest_scale == ClodSplatModelConfig().largest_scale


def test_a_ply_along_a_path(trained, tmp_path, render):
    run = load_run(trained)
    rows = run.gaussians.level == 1
    parameters = {name: run.model.gauss_params[name].detach()[rows] for name in GROUPS}
    write_ply(tmp_path / "base.ply", RawGaussians(**parameters), antialiased=run.antialiased)
    path = camera_path(run, tmp_path)
    render("--ply", tmp_path / "base.ply", "--path", path, "--output-dir", tmp_path / "out")
    assert {r["drawn"] for r in frames(tmp_path / "out").values()} == {int(rows.sum())}


def test_focus_from_masks_and_from_a_box(trained, tmp_path, render):
    run = load_run(trained)
    base = int((run.gaussians.level == 1).sum())
    (tmp_path / "masks").mkdir()
    for view in run.cameras("test"):
        mask = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        mask[20:50, 20:60] = 255
        write_image(tmp_path / "masks" / f"{view.name.rsplit('.', 1)[0]}.png", mask)
    text = render("--load-config", trained, "--focus", tmp_path / "masks", "--output-dir", tmp_path / "masked")
    assert "focus on" in text
    drawn = {r["drawn"] for r in frames(tmp_path / "masked").values()}
    assert all(base < count < len(run.gaussians) for count in drawn)
    view = run.cameras("train")[0].name.rsplit(".", 1)[0]
    alone = ["--focus", f"{view}:20,12,60,52", "--focus-outside", 0, "--output-dir", tmp_path / "alone"]
    render("--load-config", trained, *alone)
    assert all(0 < r["drawn"] < base for r in frames(tmp_path / "alone").values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "nothing to draw"),
        (("--load-config", "nowhere.yml"), "nowhere.yml is no file"),
        (("--load-config", "RUN", "--detail", "3"), "--detail 3: this scene has no decay"),
        (("--load-config", "FADED", "--detail", "-1"), "--detail -1: give a number above 0"),
        (("--level", "-1"), "level is -1"),
        (("--budget", "0"), "at least one"),
        (("--gaze", "2,2"), "outside of the image"),
        (("--gaze", "0.5,0.5", "--gaze-sigma", "0"), "sigma is 0"),
        (("--gaze", "0.5,0.5", "--gaze-scale", "0"), "0 times smaller: it must be"),
        (("--gaze", "0.5,0.5", "--gaze-scale", "100000"), "from 1 to 32"),
        (("--gaze-scale", "2"), "give --gaze"),
        (("--path", "nowhere.json", "--split", "train"), "--split train does nothing with --path"),
        (("--gaze-sigma", "0.2"), "--gaze-sigma does nothing without --gaze"),
        (("--focus", "nowhere", "--focus-outside", "-3"), "--focus-outside is -3"),
        (("--load-config", "RUN", "--focus", "text: "), "names nothing"),
        (("--focus-outside", "0"), "--focus-outside does nothing without --focus"),
        (("--load-config", "RUN", "--level", "3.5"), "--level 3.5: this scene has 3 levels; give at most 3"),
        (("--load-config", "FADED", "--level", "2"), "--level 2: this scene has no levels but a decay; use --detail"),
        (("--size", "0", "5"), "at least 1 px"),
        (("--size", "100000", "100000"), "at most 268 million"),
        (("--load-config", "RUN", "--video", "always", "--size", "16386", "8"), "or --video never"),
        (("--load-config", "RUN", "--output-dir", "RUN"), "nothing can be written there"),
        (("--fps", "0"), "fps is 0"),
        (("--filter", "pencil"), "filter is 'pencil'"),
        (("--load-config", "RUN", "--path", "nowhere.json"), "nowhere.json is no file"),
        (("--load-config", "RUN", "--path", "RUN"), "is no camera path"),
        (("--load-config", "RUN", "--focus", "nowhere"), "nowhere is no folder"),
        (("--load-config", "RUN", "--focus", "nowhere:1,2"), "the view 'nowhere'"),
        (("--load-config", "RUN", "--focus", "view_001:1,2,3"), "3 numbers"),
        (("--load-config", "RUN", "--focus", "view_001:900,2"), "lies outside of the 80x64 image"),
        (
            ("--load-config", "RUN", "--focus", "text:ball", "--segmenter-weights", "nowhere"),
            "with a saved model with --segmenter-weights",
        ),
    ],
)
def test_what_cannot_be_drawn_is_said(trained, faded, tmp_path, monkeypatch, capsys, arguments, message):
    given = [str({"RUN": trained, "FADED": faded}.get(a, a)) for a in arguments]
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["render", *given])
    assert ended.value.code == 1
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert not (tmp_path / "renders").exists()


def test_photographs_are_no_frames(trained, scene, tmp_path, capsys):
    photographs = Path(shutil.copytree(scene / "images", tmp_path / "images"))
    before = {path: path.read_bytes() for path in photographs.iterdir()}
    with pytest.raises(SystemExit):
        main(["render", "--load-config", str(trained), "--output-dir", str(photographs)])
    assert "view_000.png is there already" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in photographs.iterdir()} == before


def test_another_checkpoint_makes_other_frames(trained, tmp_path, capsys, render):
    own = Path(shutil.copytree(trained.parent, tmp_path / "small" / "lapsplat" / "run"))
    arguments = ("--load-config", own / "config.yml", "--output-dir", tmp_path / "out")
    render(*arguments)
    max((own / "nerfstudio_models").glob("step-*.ckpt")).unlink()
    with pytest.raises(SystemExit):
        main(["render", *map(str, arguments)])
    assert "frames of other settings" in capsys.readouterr().err


def test_stopped(trained, tmp_path, monkeypatch, capsys):
    def stop(*arguments, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("freqgs_plugin.commands.render.render", stop)
    with pytest.raises(SystemExit) as ended:
        main(["render", "--load-config", str(trained), "--output-dir", str(tmp_path / "out")])
    assert ended.value.code == 130 and "The same command draws what is missing" in capsys.readouterr().out


OWN = """
from dataclasses import replace

def dim(gaussians):
    return replace(gaussians, opacities=gaussians.opacities * 0.5)
"""


def test_a_sheet_of_filters_with_ones_own(trained, tmp_path, monkeypatch, capsys, render):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OWN)
    main(["filters", "--load-config", str(trained), "--filters", "xray", "own.py:dim", "--output", "a/sheet.png"])
    out = capsys.readouterr().out
    assert "xray" in out and "dim" in out
    sheet = read_image(tmp_path / "a" / "sheet.png")
    assert sheet.shape[1] == 3 * (SIZE[0] + GAP) + GAP and sheet.shape[0] == 3 * (SIZE[1] + LABEL + GAP)
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["sheet.png"]
    render("--load-config", trained, "--filter", "own.py:dim", "--output-dir", tmp_path / "dim")
    name = next(iter(frames(tmp_path / "dim")))
    shown = read_image(tmp_path / "dim" / f"{name}.png")[:, :, :3]
    in_sheet = [
        sheet[LABEL + i * (SIZE[1] + LABEL + GAP) :, 2 * SIZE[0] + 3 * GAP :][: SIZE[1], : SIZE[0], :3]
        for i in range(3)
    ]
    assert min(np.abs(shown.astype(int) - picture).max() for picture in in_sheet) <= 1
    (tmp_path / "other.py").write_text(OWN)
    main(["filters", "--load-config", str(trained), "--filters", "own.py:dim", "other.py:dim", "--output", "both.png"])
    assert read_image(tmp_path / "both.png").shape == sheet.shape


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--filters", "pencil"), "filter is 'pencil'"),
        (("--filters", "nowhere.py:f"), "nowhere.py is no file"),
        (("--views", "0"), "--views is 0"),
        (("--views", "99"), "--views is 99, and the run has 9 views"),
        (("--output", "sheet.jpg"), "the ending .png"),
    ],
)
def test_a_sheet_that_cannot_be_made_is_said(trained, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["filters", "--load-config", str(trained), *arguments])
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())
