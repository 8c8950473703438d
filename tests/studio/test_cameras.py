import inspect

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.models import splatfacto

from freqgs_plugin.studio.cameras import to_camera

# nerfstudio compiles it, which takes longer than all of these tests
get_viewmat = inspect.unwrap(splatfacto.get_viewmat)


def random_pose(generator):
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    rotation = rotation * torch.linalg.det(rotation)
    return torch.cat([rotation, torch.randn(3, 1, generator=generator)], 1)[None]


def cameras(pose, width=61, height=47, kind=CameraType.PERSPECTIVE):
    return Cameras(pose, 50.5, 51.25, 31.0, 22.75, width, height, camera_type=kind)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("halvings", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [(61, 47), (64, 48), (9, 8)])
def test_as_nerfstudio_projects(seed, halvings, size):
    pose = random_pose(torch.Generator().manual_seed(seed))
    camera = cameras(pose, *size)
    ours = to_camera(camera, halvings=halvings)
    camera.rescale_output_resolution(1 / 2**halvings)
    torch.testing.assert_close(ours.viewmat, get_viewmat(pose)[0])
    torch.testing.assert_close(ours.K, camera.get_intrinsics_matrices()[0])
    assert (ours.width, ours.height) == (int(camera.width), int(camera.height))
    torch.testing.assert_close(ours.centre, pose[0, :, 3], atol=1e-5, rtol=1e-5)


def test_the_cameras_themselves_are_left_alone():
    camera = cameras(random_pose(torch.Generator().manual_seed(0)))
    before = [camera.fx.clone(), camera.width.clone(), camera.camera_to_worlds.clone()]
    to_camera(camera, halvings=2)
    assert all(map(torch.equal, before, [camera.fx, camera.width, camera.camera_to_worlds]))


def test_axes():
    """nerfstudio's cameras look along -z with y up, ours along +z with y down."""
    ours = to_camera(cameras(torch.eye(4)[None, :3]))
    ahead_right_up = torch.tensor([1.0, 2.0, -3.0, 1.0])
    torch.testing.assert_close(ours.viewmat @ ahead_right_up, torch.tensor([1.0, -2.0, 3.0, 1.0]))


def test_another_pose_takes_the_gradient():
    camera = cameras(torch.eye(4)[None, :3])
    pose = random_pose(torch.Generator().manual_seed(1)).requires_grad_()
    ours = to_camera(camera, pose)
    torch.testing.assert_close(ours.viewmat, get_viewmat(pose)[0])
    (ours.viewmat[:3] ** 2).sum().backward()
    assert torch.isfinite(pose.grad).all() and pose.grad.abs().sum() > 0


def test_a_single_pixel_stays_one():
    camera = to_camera(cameras(torch.eye(4)[None, :3], 1, 3), halvings=3)
    assert (camera.width, camera.height) == (1, 1)


def test_several_cameras_are_refused():
    pose = torch.eye(4)[None, :3].repeat(2, 1, 1)
    with pytest.raises(ValueError, match="got 2 cameras"):
        to_camera(cameras(pose))


@pytest.mark.parametrize("kind", [CameraType.FISHEYE, CameraType.EQUIRECTANGULAR, CameraType.ORTHOPHOTO])
def test_other_projections_are_refused(kind):
    with pytest.raises(ValueError, match=f"{kind.name} is not supported.*image_undistorter"):
        to_camera(cameras(torch.eye(4)[None, :3], kind=kind))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_autocast_leaves_poses_and_centres_in_float32(dtype):
    pose = random_pose(torch.Generator().manual_seed(0))
    expected = to_camera(cameras(pose))
    with torch.autocast("cpu", dtype=dtype):
        ours = to_camera(cameras(pose))
        centre = ours.centre
    assert torch.equal(ours.viewmat, expected.viewmat) and ours.viewmat.dtype == torch.float32
    assert torch.equal(centre, expected.centre) and centre.dtype == torch.float32
