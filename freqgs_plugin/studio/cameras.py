"""nerfstudio cameras to ours: the one place where axes are flipped."""

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from freqgs_plugin.types import Camera

_READ = ("camera_type", "width", "height", "fx", "fy", "cx", "cy")


def to_camera(camera: Cameras, camera_to_world: Float[Tensor, "1 3 4"] | None = None, *, halvings: int = 0) -> Camera:
    """The pinhole view of a single nerfstudio camera (OpenGL axes: x right, y up, z backward).

    Args:
        camera: one camera.
        camera_to_world: used instead of the camera's own pose, for example one that is being optimised.
        halvings: how often width and height are halved (rounded down), with the intrinsics.

    Raises:
        ValueError: several cameras, or one that is no pinhole.
    """
    if camera.shape[0] != 1:
        raise ValueError(f"got {camera.shape[0]} cameras; a splat model renders one at a time.")
    # read together: on CUDA each read waits for the device
    read = torch.cat([getattr(camera, name).flatten()[:1].double() for name in _READ]).tolist()
    kind, width, height = (int(value) for value in read[:3])
    if kind != CameraType.PERSPECTIVE.value:
        name = next((t.name for t in CameraType if t.value == kind), str(kind))
        raise ValueError(
            f"camera type {name} is not supported: Gaussians are projected by a pinhole camera. "
            "Undistort the images first (for COLMAP models: `colmap image_undistorter`)."
        )
    pose = camera.camera_to_worlds if camera_to_world is None else camera_to_world
    rotation = pose[0, :3, :3] * pose.new_tensor([1.0, -1.0, -1.0])
    # no matrix product: autocast would take it in half precision
    translation = -(rotation * pose[0, :3, 3:4]).sum(0)
    viewmat = torch.cat([rotation.T, translation[:, None]], 1)
    viewmat = torch.cat([viewmat, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])
    factor = 2**halvings
    fx, fy, cx, cy = (value / factor for value in read[3:])
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=pose.dtype, device=pose.device)
    return Camera(viewmat, K, max(width // factor, 1), max(height // factor, 1))
