import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from freqgs_plugin.demo.dataset import SceneOptions, write_scene
from freqgs_plugin.io import check_images
from freqgs_plugin.io.check_scene import SceneError, check_colmap_scene

SIZE = (40, 30)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    write_scene(
        folder, SceneOptions(num_views=9, width=SIZE[0], height=SIZE[1], num_points=50, samples=1), progress=False
    )
    return folder


@pytest.fixture
def scene(good, tmp_path):
    return shutil.copytree(good, tmp_path / "scene")


def check(scene, **settings):
    return check_colmap_scene(scene, **{"colmap_path": Path("sparse/0"), "images_path": Path("images"), **settings})


def refuse(scene, message, **settings):
    with pytest.raises(SceneError, match=message):
        check(scene, **settings)


def edit(scene, change):
    """Apply `change` to the model on disk."""
    folder = scene / "sparse" / "0"
    model = pycolmap.Reconstruction(str(folder))
    change(model)
    for file in folder.iterdir():
        file.unlink()
    model.write_binary(str(folder))


def repaint(scene, change, name="view_004.png"):
    path = scene / "images" / name
    change(Image.open(path)).save(path)


def test_a_good_scene_passes_without_warnings(scene):
    summary = check(scene)
    assert (summary.num_views, summary.num_train, summary.num_eval) == (9, 7, 2)
    assert summary.sizes == {SIZE: 9}
    assert (summary.num_points, summary.num_duplicate_points, summary.downscale_factor) == (50, 0, 1)
    assert summary.warnings == []


def test_nerfstudio_agrees_about_the_split(scene):
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    parser = ColmapDataParserConfig(data=scene, colmap_path=Path("sparse/0"), eval_interval=4).setup()
    counts = [len(parser.get_dataparser_outputs(split=split).image_filenames) for split in ("train", "test")]
    summary = check(scene, eval_interval=4)
    assert [summary.num_train, summary.num_eval] == counts


def test_text_models_are_read(scene):
    folder = scene / "sparse" / "0"
    model = pycolmap.Reconstruction(str(folder))
    for file in folder.iterdir():
        file.unlink()
    model.write_text(str(folder))
    assert check(scene).num_points == 50


def test_a_missing_folder(tmp_path):
    refuse(tmp_path / "nowhere", "nowhere does not exist")


def test_a_folder_without_a_model(tmp_path):
    refuse(tmp_path, "no COLMAP model .* Run COLMAP")


def test_a_model_elsewhere_is_pointed_out(scene):
    refuse(scene, "There is one in .*sparse/0: .* --colmap-path sparse/0", colmap_path=Path("colmap/sparse/0"))


def test_other_formats_are_pointed_out(tmp_path):
    (tmp_path / "transforms.json").write_text("{}")
    refuse(tmp_path, "nerfstudio-data")


def test_an_incomplete_model(scene):
    (scene / "sparse" / "0" / "points3D.bin").unlink()
    refuse(scene, r"points3D.bin is missing")


@pytest.mark.parametrize("part", ["images.bin", "points3D.bin"])
@pytest.mark.parametrize("kept", [0, 5, 200, -30, -1])
def test_a_truncated_model(scene, part, kept):
    path = scene / "sparse" / "0" / part
    path.write_bytes(path.read_bytes()[:kept])
    refuse(scene, f"sparse/0 is damaged .*{part}")


def test_missing_images_are_counted_and_named(scene):
    for i in (1, 2, 5, 7):
        (scene / "images" / f"view_00{i}.png").unlink()
    refuse(scene, r"4 of 9 images .* view_001.png, view_002.png, view_005.png and 1 more.*--images-path")


def test_a_missing_image_folder(scene):
    refuse(scene, "photos does not exist; set it with `colmap --images-path`", images_path=Path("photos"))


def test_images_of_another_size(scene):
    repaint(scene, lambda image: image.resize((20, 15)))
    refuse(scene, "view_004.png is 20x15, but its COLMAP camera is 40x30")


@pytest.mark.parametrize(("content", "message"), [(b"", r"empty \(0 bytes\)"), (b"hello", "cannot be read")])
def test_unreadable_images(scene, content, message):
    (scene / "images" / "view_003.png").write_bytes(content)
    refuse(scene, f"view_003.png.* {message}")


def test_truncated_images(scene):
    path = scene / "images" / "view_003.png"
    path.write_bytes(path.read_bytes()[:600])
    refuse(scene, "view_003.png is damaged")


def test_decoding_keeps_to_its_budget(scene, monkeypatch):
    path = scene / "images" / "view_003.png"
    path.write_bytes(path.read_bytes()[:600])
    monkeypatch.setattr(check_images, "DECODE_BUDGET", 2 * SIZE[0] * SIZE[1])
    check(scene)


@pytest.mark.parametrize(
    ("mode", "allowed"), [("L", True), ("RGBA", True), ("P", False), ("LA", False), ("1", False), ("I;16", False)]
)
def test_kinds_of_images(scene, mode, allowed):
    def change(image):
        return Image.fromarray(np.full((30, 40), 40000, np.uint16)) if mode == "I;16" else image.convert(mode)

    repaint(scene, change)
    if not allowed:
        refuse(scene, f"view_004.png has the Pillow mode {mode}.*Convert the images to 8-bit RGB")
    else:
        warnings = check(scene).warnings
        assert [w for w in warnings if "grey" in w] == warnings and len(warnings) == (mode == "L")


def test_sixteen_bit_colour_is_a_warning(scene):
    import cv2

    cv2.imwrite(str(scene / "images" / "view_004.png"), np.full((30, 40, 3), 40000, np.uint16))
    (warning,) = check(scene).warnings
    assert "16 bits" in warning and "view_004.png" in warning


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "FULL_OPENCV", "FOV"])
def test_other_camera_models_are_refused(scene, model):
    def change(reconstruction):
        camera = pycolmap.Camera.create_from_model_name(1, model, 35.0, *SIZE)
        reconstruction.camera(1).model, reconstruction.camera(1).params = camera.model, camera.params

    edit(scene, change)
    refuse(scene, f"{model}, which does not become a pinhole.*image_undistorter")


def test_distorted_perspective_cameras_pass(scene):
    def change(reconstruction):
        camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 35.0, *SIZE)
        reconstruction.camera(1).model, reconstruction.camera(1).params = camera.model, camera.params

    edit(scene, change)
    assert check(scene).num_views == 9


def test_one_view_is_too_few(tmp_path):
    write_scene(tmp_path, SceneOptions(num_views=2, width=40, height=30, num_points=20, samples=1), progress=False)
    assert check(tmp_path).num_train == 1
    edit(tmp_path, lambda model: model.deregister_frame(2))
    refuse(tmp_path, r"holds 1 view\(s\); training needs at least two")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"eval_interval": 1}, "--eval-interval 1 leaves 0 of 9 views .* interval of 2 or more"),
        ({"eval_mode": "fraction", "train_split_fraction": 0.0}, "leaves 0 of 9 views"),
        ({"eval_mode": "filename"}, "view_000.png.* hold neither train nor eval"),
    ],
)
def test_splits_that_leave_nothing(scene, settings, message):
    refuse(scene, message, **settings)


def test_all_views_may_serve_for_both(scene):
    summary = check(scene, eval_mode="all")
    assert (summary.num_train, summary.num_eval) == (9, 9)


def test_no_view_held_out_is_a_warning(scene):
    summary = check(scene, eval_mode="fraction", train_split_fraction=1.0)
    assert (summary.num_train, summary.num_eval) == (9, 0)
    assert "no view" in summary.warnings[0]


def test_split_lists(scene):
    (scene / "train_list.txt").write_text("view_001.png\nview_002.png\n")
    refuse(scene, "val_list.txt is missing")
    for name in ("val", "test"):
        (scene / f"{name}_list.txt").write_text("view_000.png\n")
    assert check(scene).num_train == 2
    (scene / "train_list.txt").write_text("view_001.png\nview_099.png\n")
    refuse(scene, "train_list.txt names views .* view_099.png")
    (scene / "train_list.txt").write_text("")
    refuse(scene, "name 0 of 9 views .* to train on.*Edit these files")


def test_no_points(scene):
    edit(scene, lambda model: [model.delete_point3D(i) for i in list(model.points3D)])
    for load in (True, False):
        summary = check(scene, load_3D_points=load)
        assert summary.num_points == 0
        assert "random places" in summary.warnings[0]


def test_nerfstudio_fails_without_points_as_we_say(scene):
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    edit(scene, lambda model: [model.delete_point3D(i) for i in list(model.points3D)])
    config = ColmapDataParserConfig(data=scene, colmap_path=Path("sparse/0"))
    with pytest.raises(RuntimeError):
        config.setup().get_dataparser_outputs(split="train")
    config.load_3D_points = False
    config.setup().get_dataparser_outputs(split="train")


def test_duplicate_points_are_counted(scene):
    def change(model):
        points = list(model.points3D.values())
        points[0].xyz = points[1].xyz = points[2].xyz

    edit(scene, change)
    summary = check(scene)
    assert summary.num_duplicate_points == 2
    assert "2 of 50 points" in summary.warnings[0]


def test_points_that_are_not_finite(scene):
    def change(model):
        next(iter(model.points3D.values())).xyz = (np.nan, 0, 0)

    edit(scene, change)
    refuse(scene, "1 points of .* are not finite")


class TestDownscaling:
    @pytest.fixture
    def halved(self, scene):
        (scene / "images_2").mkdir()
        for path in (scene / "images").iterdir():
            Image.open(path).resize((20, 15)).save(scene / "images_2" / path.name)
        return scene

    def test_sizes_follow_the_factor(self, halved):
        summary = check(halved, downscale_factor=2)
        assert summary.sizes == {(20, 15): 9} and summary.downscale_factor == 2

    def test_the_full_images_may_be_absent_where_the_factor_is_given(self, halved):
        shutil.rmtree(halved / "images")
        assert check(halved, downscale_factor=2).num_views == 9

    def test_automatic_factor(self, halved, monkeypatch):
        monkeypatch.setattr(check_images, "MAX_AUTO_RESOLUTION", 30)
        assert check(halved).downscale_factor == 2

    def test_rounding(self, halved):
        for path in (halved / "images_2").iterdir():
            path.rename(halved / "images" / path.name)
        (halved / "images_2").rename(halved / "images_4")
        for path in (halved / "images").iterdir():
            Image.open(path).resize((10, 8)).save(halved / "images_4" / path.name)
        refuse(halved, "downscaled by 4, is 10x7.*--downscale-rounding-mode", downscale_factor=4)
        assert check(halved, downscale_factor=4, downscale_rounding_mode="ceil").sizes == {(10, 8): 9}

    def test_a_missing_folder_without_a_terminal(self, scene):
        refuse(scene, "images_2 does not exist.*--downscale-factor 1", downscale_factor=2)

    def test_a_missing_folder_in_a_terminal_with_ffmpeg(self, scene, monkeypatch):
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        monkeypatch.setattr(check_images.shutil, "which", lambda name: name)
        (warning,) = check(scene, downscale_factor=2).warnings
        assert "nerfstudio will ask" in warning

    def test_missing_small_images(self, halved):
        (halved / "images_2" / "view_008.png").unlink()
        refuse(halved, "missing in .*images_2: view_008.png", downscale_factor=2)
