import json
import math

import pytest

from freqgs_plugin.studio.camera_path import read_camera_path

POSE = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]


def saved(folder, second=None, **changed):
    """A path of two views, as the viewer saves it."""
    views = [{"camera_to_world": POSE, "fov": 50.0, "aspect": 1}, {"camera_to_world": POSE, "fov": 50.0, "aspect": 1}]
    views[1].update(second or {})
    path = folder / "path.json"
    path.write_text(json.dumps({"render_width": 80, "render_height": 64, "fps": 8, "camera_path": views, **changed}))
    return path


def test_views_in_order(tmp_path):
    found = read_camera_path(saved(tmp_path))
    assert found.fps == 8 and [(c.width, c.height) for c in found.cameras] == [(80, 64)] * 2


@pytest.mark.parametrize("fov", [0, -5, 180, 400, math.nan, math.inf])
def test_a_field_of_view_that_no_camera_has(tmp_path, fov):
    with pytest.raises(ValueError, match=r"path\.json: view 2 has a field of view of .* between 0 and 180"):
        read_camera_path(saved(tmp_path, {"fov": fov}))


@pytest.mark.parametrize("pose", [[0.0] * 16, [math.nan] * 16, [math.inf, *POSE[1:]]])
def test_a_pose_that_no_camera_has(tmp_path, pose):
    with pytest.raises(ValueError, match=r"path\.json: view 2 has no pose that a camera can have"):
        read_camera_path(saved(tmp_path, {"camera_to_world": pose}))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"camera_path": []}, "has no views"),
        ({"camera_path": "x"}, "is no camera path"),
        ({"render_width": 0}, "must be above 0"),
        ({"fps": math.nan}, "must be above 0"),
        ({"camera_type": "fisheye"}, "make it perspective"),
    ],
)
def test_what_is_no_path(tmp_path, changed, message):
    with pytest.raises(ValueError, match=message):
        read_camera_path(saved(tmp_path, **changed))
