"""Where photographs are kept, and that disk and memory give the very same numbers."""

import copy
import json

import numpy as np
import pytest
import torch
from caching import equal, everything, files
from PIL import Image
from running import advance
from state import parameters, same

from freqgs_plugin.studio import disk_views, image_cache


def distorted(scene):
    """A transforms.json of the scene, with distortion, a mask per view, and transparent images."""
    frames = []
    (scene / "masks").mkdir()
    for number, path in enumerate(sorted((scene / "images").iterdir())):
        image = np.array(Image.open(path).convert("RGBA"))
        image[:, : 5 + number, 3] = 40 * number
        Image.fromarray(image).save(path)
        mask = np.full(image.shape[:2], 255, np.uint8)
        mask[: 3 * number] = 0
        Image.fromarray(mask).save(scene / "masks" / path.name)
        pose = np.eye(4)
        pose[:3, 3] = (number, number**2 / 7, 1)
        frames.append(
            {
                "file_path": f"images/{path.name}",
                "mask_path": f"masks/{path.name}",
                "transform_matrix": pose.tolist(),
                **{"fl_x": 70 + number, "fl_y": 71.5, "cx": 39.5, "cy": 33, "w": 80, "h": 64},
                **{"k1": 0.11, "k2": -0.03, "p1": 0.004, "p2": -0.002},
            }
        )
    (scene / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    return scene


def other_parser(make_config, data):
    from nerfstudio.configs.method_configs import all_methods

    config = make_config(data=data)
    config.pipeline.datamanager.dataparser = all_methods["lapsplat"].pipeline.datamanager.dataparser
    return config.pipeline.datamanager


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_batches_are_the_same_bits(manager, kind):
    memory = everything(manager(cache_images_where="memory", cache_images_type=kind))
    assert memory[0][0]["image"].dtype == getattr(torch, kind)
    for _ in ("written", "found"):
        assert equal(everything(manager(cache_images_type=kind)), memory)


def test_undistorted_images_masks_and_transparency_are_the_same_bits(make_config, own_scene, tmp_path):
    config = other_parser(make_config, distorted(own_scene))
    config.cache_images_dir = tmp_path / "cache"
    found = {}
    for where in ("memory", "disk", "disk"):
        config.cache_images_where = where
        made = copy.deepcopy(config).setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
        names, cameras = made.named_cameras()
        pairs = made.fixed_indices_eval_dataloader
        batches = [{**data, "size": camera.width} for camera, data in pairs] + [made.next_train(0)[1]]
        now = (names, [(c.K, c.viewmat, c.width, c.height) for c in cameras], everything(made), batches)
        found.setdefault("memory", now)
        assert equal(now, found["memory"])
    view = found["memory"][2][0][0]
    assert view["mask"].dtype == torch.bool and view["image"].shape[2] == 4
    # undistortion has cropped, and told the cameras
    assert view["image"].shape[:2] == view["mask"].shape[:2] != (64, 80)
    assert (found["memory"][1][0][3], found["memory"][1][0][2]) == tuple(view["image"].shape[:2])


@pytest.mark.slow
def test_training_gives_the_same_parameters(make_trainer, tmp_path):
    results = []
    for where in ("memory", "disk"):

        def edit(config, where=where):
            config.pipeline.datamanager.cache_images_where = where
            config.pipeline.datamanager.cache_images_dir = tmp_path / "cache"

        trainer = make_trainer(edit=edit, parser={"eval_interval": 9}, num_levels="auto", least_level_gain=0.1)
        advance(trainer, 52)
        metrics = trainer.pipeline.get_average_eval_image_metrics(step=52)
        model = trainer.pipeline.model
        assert model._gain.last is not None and model._level_choice
        results.append((parameters(model), metrics["psnr"], model._gain.last, model._level_choice))
    assert same(results[0][0], results[1][0]) and results[0][1:] == results[1][1:]
    assert len(files(tmp_path)) == 9


def test_a_second_run_reads_no_photograph(manager, monkeypatch, said):
    everything(manager())
    again = manager()
    monkeypatch.setattr(type(again.train_dataset), "get_data", None)
    said.clear()
    everything(again)
    assert any("6 views, 0.1 MB in " in line and "6 were there, 0 written (0.0 MB)" in line for line in said)


def test_the_log_tells_what_photographs_take_and_where_they_are(manager, monkeypatch, said):
    monkeypatch.setattr(image_cache, "available_memory", lambda: 1_000_000)
    for fields, expected in (
        ({"cache_images_where": "auto"}, "kept in memory (at most 50% of the 1.0 MB that are available)"),
        ({"cache_images_where": "memory"}, "kept in memory (as cache-images-where says; 1.0 MB of memory"),
        ({"cache_images_where": "auto", "cache_images_share": 0.1}, "kept on disk (more than 10% of the 1.0 MB"),
        ({}, "kept on disk (as cache-images-where says; 1.0 MB of memory are available); memory holds only"),
    ):
        said.clear()
        made = manager(**fields)
        assert isinstance(made.cached_train, disk_views.DiskViews) == ("on disk" in expected)
        assert any(line.startswith("9 photographs take 0.1 MB; ") and expected in line for line in said), said


def test_auto_counts_bytes_exactly(manager, monkeypatch):
    needed = 9 * 80 * 64 * 3
    for available, on_disk in ((2 * needed, False), (2 * needed - 2, True)):
        monkeypatch.setattr(image_cache, "available_memory", lambda value=available: value)
        assert manager(cache_images_where="auto").images_on_disk is on_disk


@pytest.mark.parametrize("share", [0.0, 1.5])
def test_a_share_must_be_one(manager, share):
    with pytest.raises(ValueError, match=rf"cache-images-share is {share}; .* in \(0, 1\]"):
        manager(cache_images_share=share)


def test_the_folder_is_the_users_cache_and_not_the_scene(manager, scene, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    before = sorted(scene.rglob("*"))
    assert len(manager(cache_images_dir=None).cached_train) == 6
    assert len(list((tmp_path / "xdg" / "freqgs" / "images").glob("scene-*/*.view"))) == 6
    assert sorted(scene.rglob("*")) == before
