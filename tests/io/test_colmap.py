import numpy as np
import pycolmap
import pytest

from freqgs_plugin.demo.dataset import project
from freqgs_plugin.demo.scene import orbit
from freqgs_plugin.io.colmap import Points, check_lengths, write_colmap


@pytest.fixture
def model():
    cameras = orbit(3, 64, 48)
    xyz = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)) + np.array([0, 0, 0.8])
    point, view = (x.ravel() for x in np.mgrid[0:20, 0:3])
    order = np.random.default_rng(1).permutation(60)
    point, view = point[order], view[order]
    xy = np.stack([project(camera, xyz)[0] for camera in cameras], 1)[point, view]
    return cameras, Points(xyz, np.arange(60, dtype=np.uint8).reshape(20, 3), point, view, xy)


def test_what_is_written_is_read_back(tmp_path, model):
    cameras, points = model
    write_colmap(tmp_path, cameras, ["a.png", "b.png", "c.png"], points)
    read = pycolmap.Reconstruction(str(tmp_path))
    assert [read.images[i].name for i in (1, 2, 3)] == ["a.png", "b.png", "c.png"]
    assert read.num_cameras() == 1 and read.cameras[1].model_name == "PINHOLE"
    for i, camera in enumerate(cameras, start=1):
        pose = read.images[i].cam_from_world()
        np.testing.assert_allclose(pose.matrix(), camera.viewmat[:3].numpy(), atol=1e-6)
    assert read.compute_mean_reprojection_error() < 1e-3
    assert read.compute_mean_track_length() == 3
    np.testing.assert_allclose([read.points3D[i + 1].xyz for i in range(20)], points.xyz)
    assert read.points3D[2].color.tolist() == [3, 4, 5]
    check_lengths(tmp_path)


def test_nerfstudio_reads_the_same_poses(tmp_path, model):
    from nerfstudio.data.utils.colmap_parsing_utils import qvec2rotmat, read_images_binary, read_points3D_binary

    cameras, points = model
    write_colmap(tmp_path, cameras, ["a.png", "b.png", "c.png"], points)
    images = read_images_binary(tmp_path / "images.bin")
    for i, camera in enumerate(cameras, start=1):
        np.testing.assert_allclose(qvec2rotmat(images[i].qvec), camera.viewmat[:3, :3].numpy(), atol=1e-6)
        np.testing.assert_allclose(images[i].tvec, camera.viewmat[:3, 3].numpy(), atol=1e-6)
    read = read_points3D_binary(tmp_path / "points3D.bin")
    np.testing.assert_allclose([read[i + 1].xyz for i in range(20)], points.xyz)
    for number, point in read.items():
        for image, index in zip(point.image_ids, point.point2D_idxs, strict=True):
            assert images[image].point3D_ids[index] == number


def test_different_intrinsics_become_different_cameras(tmp_path, model):
    cameras, points = model
    write_colmap(tmp_path, [*cameras[:2], orbit(3, 32, 24)[2]], ["a.png", "b.png", "c.png"], points)
    read = pycolmap.Reconstruction(str(tmp_path))
    assert sorted((c.width, c.height) for c in read.cameras.values()) == [(32, 24), (64, 48)]


@pytest.mark.parametrize("names", [["a.png", "b.png"], ["a.png", "a.png", "b.png"]])
def test_names_must_fit(tmp_path, model, names):
    with pytest.raises(ValueError, match="3 cameras need as many different names"):
        write_colmap(tmp_path / "m", model[0], names, model[1])
    assert not (tmp_path / "m").exists()
