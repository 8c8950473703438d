import json
import os
import subprocess
import sys

import numpy as np
import pytest

from freqgs_plugin.demo.dataset import MANIFEST, SceneOptions, project, seed_points, write_scene
from freqgs_plugin.demo.raytrace import render_truth
from freqgs_plugin.demo.scene import build_world, orbit

TINY = SceneOptions(num_views=9, width=32, height=24, num_points=60, samples=1)


def _files(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_same_seed_gives_the_same_files_and_another_seed_others(tmp_path):
    for name, options in (("a", TINY), ("b", TINY), ("c", SceneOptions(9, 32, 24, 60, 1, seed=1))):
        write_scene(tmp_path / name, options, progress=False)
    first, second, third = (_files(tmp_path / name) for name in "abc")
    assert first == second
    assert first["images/view_003.png"] != third["images/view_003.png"]
    assert first["sparse/0/points3D.bin"] != third["sparse/0/points3D.bin"]


@pytest.mark.slow
def test_another_processors_matrix_products_give_the_same_files(tmp_path):
    """OpenBLAS can be told which processor to compute for; matrix products in float32 then differ."""
    write = (
        "import sys; from pathlib import Path; from freqgs_plugin.demo.dataset import SceneOptions, write_scene;"
        "write_scene(Path(sys.argv[1]), SceneOptions(9, 80, 64, 300, 1), progress=False)"
    )
    for kind in ("Haswell", "Nehalem"):
        environment = {**os.environ, "OPENBLAS_CORETYPE": kind}
        subprocess.run([sys.executable, "-c", write, str(tmp_path / kind)], env=environment, check=True)
    write_scene(tmp_path / "own", SceneOptions(9, 80, 64, 300, 1), progress=False)
    assert _files(tmp_path / "own") == _files(tmp_path / "Haswell") == _files(tmp_path / "Nehalem")


def test_a_scene_of_ours_is_replaced_and_leaves_no_old_views(tmp_path):
    write_scene(tmp_path / "s", TINY, progress=False)
    write_scene(tmp_path / "s", SceneOptions(4, 32, 24, 60, 1), progress=False)
    assert len(list((tmp_path / "s" / "images").iterdir())) == 4
    assert json.loads((tmp_path / "s" / MANIFEST).read_text())["num_views"] == 4


def test_a_foreign_folder_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(
        FileExistsError, match=r"not empty and was not written by freqgs demo.*Name another folder"
    ) as error:
        write_scene(tmp_path, TINY, progress=False)
    assert str(tmp_path) in str(error.value)
    assert _files(tmp_path) == {"thesis.txt": b"years of work"}


def test_foreign_files_inside_of_our_scene_are_refused(tmp_path):
    write_scene(tmp_path, TINY, progress=False)
    (tmp_path / "images" / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(FileExistsError, match="images also holds files"):
        write_scene(tmp_path, TINY, progress=False)
    assert (tmp_path / "images" / "holiday.jpg").exists()


@pytest.mark.parametrize("options", [SceneOptions(num_views=1), SceneOptions(width=0), SceneOptions(num_points=0)])
def test_impossible_options_are_refused_before_anything_is_written(tmp_path, options):
    with pytest.raises(ValueError, match="at least two views"):
        write_scene(tmp_path / "s", options, progress=False)
    assert not (tmp_path / "s").exists()


def test_an_empty_folder_is_taken(tmp_path):
    write_scene(tmp_path, TINY, progress=False)
    assert (tmp_path / "sparse" / "0" / "images.bin").is_file()


@pytest.fixture(scope="module")
def seen():
    world, cameras = build_world(), orbit(8, 160, 120)
    images = [render_truth(world, camera, 2) for camera in cameras]
    return cameras, images, seed_points(world, cameras, images, 400)


def test_seed_points_project_onto_their_own_colour(seen):
    cameras, images, points = seen
    errors = []
    for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        rows = points.point[points.view == i]
        xy, z = project(camera, points.xyz[rows])
        column, row = np.clip(xy.astype(int), 0, (camera.width - 1, camera.height - 1)).T
        errors.append(np.abs(image[row, column] - points.rgb[rows] / 255).mean(1))
        assert (z > 0).all()
    assert np.mean(np.concatenate(errors)) < 0.08
    mirrored = np.concatenate(
        [np.abs(images[i][::-1][tuple(points.xy[points.view == i].astype(int).clip(0, (159, 119)).T[::-1])]
                - points.rgb[points.point[points.view == i]] / 255).mean(1) for i in range(8)]
    )  # fmt: skip
    assert mirrored.mean() > 2 * np.mean(np.concatenate(errors)), "the test must notice a wrong projection"


def test_observations_lie_near_the_projection_and_tracks_have_two_views(seen):
    cameras, _, points = seen
    assert 380 < len(points.xyz) <= 400
    for i, camera in enumerate(cameras):
        rows = points.view == i
        error = np.linalg.norm(project(camera, points.xyz[points.point[rows]])[0] - points.xy[rows], axis=1)
        assert error.mean() < 0.6 and error.max() < 2
    assert np.bincount(points.point, minlength=len(points.xyz)).min() >= 2
