"""Bad scenes fail before training starts, and say what to do."""

import shutil

import pycolmap
import pytest
from PIL import Image
from running import advance, command, train_arguments

from freqgs_plugin.io.check_scene import SceneError


def edit_model(scene, change):
    folder = scene / "sparse" / "0"
    model = pycolmap.Reconstruction(str(folder))
    change(model)
    for file in folder.iterdir():
        file.unlink()
    model.write_binary(str(folder))


def drop_points(model):
    for key in list(model.points3D):
        model.delete_point3D(key)


def remove_model(scene):
    shutil.rmtree(scene / "sparse")


def remove_images(scene):
    for name in ("view_001.png", "view_003.png"):
        (scene / "images" / name).unlink()


def shrink_image(scene):
    path = scene / "images" / "view_002.png"
    Image.open(path).resize((40, 32)).save(path)


def empty_image(scene):
    (scene / "images" / "view_002.png").write_bytes(b"")


def sixteen_bits(scene):
    path = scene / "images" / "view_002.png"
    Image.new("I;16", Image.open(path).size).save(path)


def damage_model(scene):
    path = scene / "sparse" / "0" / "points3D.bin"
    path.write_bytes(path.read_bytes()[:50])


def fisheye(scene):
    def change(model):
        for key in list(model.cameras):
            camera = model.cameras[key]
            other = pycolmap.Camera.create_from_model_name(key, "OPENCV_FISHEYE", 60.0, camera.width, camera.height)
            camera.model, camera.params = other.model, other.params

    edit_model(scene, change)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (shutil.rmtree, "scene does not exist"),
        (remove_model, "no COLMAP model .* Run COLMAP"),
        (remove_images, "2 of 9 images .*view_001.png, view_003.png.*--images-path"),
        (shrink_image, "view_002.png is 40x32, but its COLMAP camera is 80x64"),
        (empty_image, "view_002.png is empty"),
        (sixteen_bits, "view_002.png .*I;16.*Convert the images to 8-bit RGB"),
        (damage_model, "sparse/0 is damaged"),
        (fisheye, "OPENCV_FISHEYE.*image_undistorter"),
    ],
)
def test_bad_scenes(make_trainer, own_scene, spoil, message):
    spoil(own_scene)
    with pytest.raises(SceneError, match=message):
        make_trainer(data=own_scene)


@pytest.mark.parametrize(
    ("parser", "message"),
    [
        ({"eval_interval": 1}, "leaves 0 of 9 views"),
        ({"eval_mode": "fraction", "train_split_fraction": 0.0}, "leaves 0 of 9 views"),
        ({"eval_mode": "filename"}, "hold neither train nor eval"),
    ],
)
def test_splits_without_training_views(make_trainer, parser, message):
    with pytest.raises(SceneError, match=message):
        make_trainer(parser=parser)


def test_the_model_is_found_where_it_is(make_config, scene, said):
    config = make_config()
    assert str(config.pipeline.datamanager.dataparser.colmap_path) == "colmap/sparse/0"
    manager = config.pipeline.datamanager.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    assert (len(manager.train_dataset), len(manager.eval_dataset)) == (6, 3)
    assert str(config.pipeline.datamanager.dataparser.colmap_path) == "sparse/0"
    assert any("using the one in" in line and str(scene / "sparse/0") in line for line in said)
    assert any(line.startswith("9 views (6 to train on, 3 held out), 80x64 px, 300 points") for line in said)


def test_a_model_in_the_expected_place_is_left_alone(make_config, own_scene, said):
    shutil.copytree(own_scene / "sparse", own_scene / "colmap" / "sparse")
    config = make_config(data=own_scene)
    config.pipeline.datamanager.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    assert str(config.pipeline.datamanager.dataparser.colmap_path) == "colmap/sparse/0"
    assert not any("using the one in" in line for line in said)


def other_parser(make_config, data):
    from nerfstudio.configs.method_configs import all_methods

    config = make_config(data=data)
    config.pipeline.datamanager.dataparser = all_methods["lapsplat"].pipeline.datamanager.dataparser
    return config.pipeline.datamanager


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (lambda scene: scene, "holds no transforms.json. There is a COLMAP model in .*sparse/0: end the .* `colmap`"),
        (lambda scene: scene / "images", "holds no transforms.json. Run `ns-process-data images`"),
        (lambda scene: scene / "missing", "missing does not exist"),
        (lambda scene: scene / "missing.json", "missing.json does not exist"),
    ],
)
def test_without_transforms_json(make_config, scene, place, message):
    with pytest.raises(SceneError, match=message):
        other_parser(make_config, place(scene)).setup(device="cpu", test_mode="val", world_size=1, local_rank=0)


def test_no_points_means_random_ones(make_trainer, own_scene, said):
    edit_model(own_scene, drop_points)
    trainer = make_trainer(data=own_scene, num_random=400)
    assert trainer.pipeline.model.num_points == 400
    assert any("random places" in line for line in said)
    assert any(line.startswith("No seed points in use: 400 random ones in a cube of side 10") for line in said)
    advance(trainer, 3)


def test_grey_images_train(make_trainer, own_scene, said):
    for path in (own_scene / "images").iterdir():
        Image.open(path).convert("L").save(path)
    trainer = make_trainer(data=own_scene)
    assert any("grey" in line for line in said)
    advance(trainer, 3)


def test_duplicate_points_are_said_and_stay_finite(make_trainer, own_scene, said):
    def change(model):
        points = list(model.points3D.values())
        for point in points[1:20]:
            point.xyz = points[0].xyz

    edit_model(own_scene, change)
    trainer = make_trainer(data=own_scene)
    assert any("19 of 300 points" in line for line in said)
    model = trainer.pipeline.model
    assert bool(model.scales.isfinite().all()) and float(model.scales.detach().exp().min()) > 1e-5
    advance(trainer, 3)


@pytest.mark.slow
def test_the_command_ends_with_the_message(own_scene, tmp_path):
    remove_images(own_scene)
    done = command("ns-train", *train_arguments(own_scene, tmp_path / "runs", "--max-num-iterations", 5))
    assert done.code != 0
    assert "2 of 9 images" in done.text and "view_001.png, view_003.png" in done.text, str(done)
    assert "Step (% Done)" not in done.text and not list(tmp_path.rglob("*.ckpt"))
