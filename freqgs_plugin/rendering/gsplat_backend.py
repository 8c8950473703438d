"""gsplat on CUDA behind the rasterizer seam; the only file that knows how gsplat's versions differ.

Written against gsplat 1.4.0, which nerfstudio 1.1.5 pins. From 1.5, `radii` has one entry per image axis; here the
larger one is kept, as in 1.4. Newer kernels cap alpha at 0.99 instead of 0.999: that is compiled in, so pictures differ
by up to 0.01 where a single Gaussian is opaque.
"""

import importlib
from typing import Any

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from freqgs_plugin.functional.projection import QUATERNION_MIN, STD_MAX
from freqgs_plugin.rendering.base import BLUR, NEAR_PLANE, Statistics, check_inputs, check_levels
from freqgs_plugin.types import Camera, Rendering, Splats

TILE = 16
"""px, side of the kernels' tiles: gsplat's own choice"""
_INFO_KEYS = ("means2d", "depths", "conics", "opacities", "width", "height", "n_cameras", "gaussian_ids", "camera_ids")


class GsplatRasterizer:
    """Composites splats with gsplat's CUDA kernels, float32; gsplat is imported at the first picture."""

    name = "gsplat"

    def __init__(self, absgrad: bool = True) -> None:
        """`absgrad`: after backward, `info["means2d"].absgrad` holds absolute gradients summed per pixel."""
        self.absgrad = absgrad

    def __call__(
        self,
        splats: Splats,
        camera: Camera,
        *,
        background: Float[Tensor, " d"] | None = None,
        blur: float = BLUR,
        antialiased: bool = False,
        depth: bool = True,
    ) -> Rendering:
        """Render `splats`, float32 tensors on a CUDA device.

        Raises:
            RuntimeError: no CUDA device, no gsplat, or no compiled kernels; the message names what is missing.
        """
        gsplat = _gsplat(splats.means)
        check_inputs(splats, camera)
        if len(splats) == 0:
            return _empty(splats, camera, background)
        image, alpha, meta = gsplat.rasterization(
            **_geometry(splats, camera),
            opacities=splats.opacities,
            colors=splats.features,
            width=camera.width,
            height=camera.height,
            near_plane=NEAR_PLANE,
            eps2d=blur,
            sh_degree=None,
            packed=False,
            backgrounds=None if background is None else background.to(splats.means)[None],
            render_mode="RGB+ED" if depth else "RGB",
            absgrad=self.absgrad,
            rasterize_mode="antialiased" if antialiased else "classic",
        )
        d = splats.features.shape[1]
        expected = image[0, ..., d:].detach() if depth else torch.zeros_like(alpha[0])
        info = {**{key: meta[key] for key in _INFO_KEYS}, "radii": _larger_radii(meta["radii"])}
        return Rendering(image[0, ..., :d], alpha[0], expected, info)

    def prefixes(
        self,
        splats: Splats,
        level: Int[Tensor, " n"],
        num_levels: int,
        camera: Camera,
        *,
        background: Float[Tensor, " d"] | None = None,
        blur: float = BLUR,
        antialiased: bool = False,
        statistics: Statistics = "full",
    ) -> list[Rendering]:
        """All prefixes as one batch of pictures: projected once, and each kernel is launched once.

        Raises:
            ValueError: a level outside of 1..num_levels.
            RuntimeError: as for one picture.
        """
        gsplat = _gsplat(splats.means)
        check_inputs(splats, camera)
        check_levels(level, num_levels)
        if len(splats) == 0:
            return [_empty(splats, camera, background)] * num_levels
        radii, means2d, depths, conics, compensations = gsplat.fully_fused_projection(
            covars=None,
            **_geometry(splats, camera),
            width=camera.width,
            height=camera.height,
            eps2d=blur,
            near_plane=NEAR_PLANE,
            packed=False,
            calc_compensations=antialiased,
        )
        opacities = splats.opacities[None] if compensations is None else splats.opacities[None] * compensations
        present = level[None] <= torch.arange(1, num_levels + 1, device=level.device)[:, None]
        drawn = torch.where(present if radii.dim() == 2 else present[..., None], radii, 0)

        def batch(tensor: Tensor) -> Tensor:
            return tensor.expand(num_levels, *tensor.shape[1:]).contiguous()

        centres, tiles = batch(means2d), (-(-camera.width // TILE), -(-camera.height // TILE))
        _, entries, order = gsplat.isect_tiles(
            centres, drawn, batch(depths), TILE, *tiles, packed=False, n_cameras=num_levels
        )
        image, alpha = gsplat.rasterize_to_pixels(
            centres,
            batch(conics),
            batch(splats.features[None]),
            batch(opacities),
            camera.width,
            camera.height,
            TILE,
            gsplat.isect_offset_encode(entries, num_levels, *tiles),
            order,
            backgrounds=None if background is None else batch(background.to(splats.means)[None]),
            packed=False,
            absgrad=self.absgrad,
        )
        collected = _collected(centres, level if statistics == "own" else None, self.absgrad)
        info = _info(collected, _larger_radii(radii), depths, conics, opacities, camera)
        no_depth = torch.zeros_like(alpha[0])
        return [Rendering(image[k], alpha[k], no_depth, info) for k in range(num_levels)]


def _collected(
    centres: Float[Tensor, "prefixes n 2"], level: Int[Tensor, " n"] | None, absgrad: bool
) -> Float[Tensor, "1 n 2"]:
    """Centres of the last prefix that receive, in backward, the gradients of each Gaussian's own prefix, or, without
    levels, of the last one."""
    means2d = centres[-1:].detach().clone()
    if not centres.requires_grad:
        return means2d
    means2d.requires_grad_()
    rows = torch.arange(len(means2d[0]), device=means2d.device)
    prefix = torch.full_like(rows, len(centres) - 1) if level is None else level.long() - 1

    def collect(grad: Tensor) -> None:
        means2d.grad = grad[prefix, rows][None]
        if absgrad:
            means2d.absgrad = centres.absgrad[prefix, rows][None]  # pyright: ignore

    centres.register_hook(collect)
    return means2d


def _geometry(splats: Splats, camera: Camera) -> dict[str, Tensor]:
    """Shapes and view as the kernels' float32 can take them."""
    means, turn = _beside_the_camera(splats.means, camera)
    intrinsics = camera.K.to(means)
    return {
        "means": means,
        "quats": _directions(splats.quats),
        "scales": _drawable_scales(splats.scales, means, turn, intrinsics),
        "viewmats": turn[None],
        "Ks": intrinsics[None],
    }


def _beside_the_camera(
    means: Float[Tensor, "n 3"], camera: Camera
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "4 4"]]:
    """Means from the camera's centre, and the view matrix that only turns: the kernels' float32 has no digits left for
    a scene far from the origin, so the centre is subtracted in float64."""
    viewmat = camera.viewmat.to(means.device, torch.float64)
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3:]
    # the inverse, not the transpose: a rotation in float32 is orthogonal to seven digits only, and a million units
    # away that is a tenth of one
    adjoint = torch.linalg.cross(rotation.roll(-1, 0), rotation.roll(-2, 0))
    centre = -(translation * adjoint).sum(0) / (rotation[0] * adjoint[0]).sum()
    turn = viewmat.clone()
    turn[:3, 3] = 0
    return (means - centre).to(means.dtype), turn.to(means.dtype)


def _directions(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Quaternions whose squares neither overflow nor vanish in the kernels; one without direction is the identity."""
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    return torch.where(largest > QUATERNION_MIN, quats / largest.clamp_min(QUATERNION_MIN), identity)


def _drawable_scales(
    scales: Float[Tensor, "n 3"],
    means: Float[Tensor, "n 3"],
    turn: Float[Tensor, "4 4"],
    intrinsics: Float[Tensor, "3 3"],
) -> Float[Tensor, "n 3"]:
    """Scales of at most `STD_MAX` pixels on the image plane, beyond which the kernels' conics are not finite."""
    depths = (means.detach() @ turn[2, :3]).clamp_min(NEAR_PLANE)
    return torch.minimum(scales, (STD_MAX / intrinsics.diagonal()[:2].max() * depths)[:, None])


def _larger_radii(radii: Int32[Tensor, "1 n"] | Int32[Tensor, "1 n 2"]) -> Int32[Tensor, "1 n"]:
    """px; gsplat >= 1.5 reports one per image axis."""
    return radii if radii.dim() == 2 else radii.amax(dim=-1)


def _gsplat(like: Tensor) -> Any:
    """The package gsplat, if it can run on tensors like this one."""
    reason = _missing(like.device)
    if reason is not None:
        elsewhere = "'torch', or 'numba' on the CPU" if like.device.type == "cpu" else "'torch' on this device"
        raise RuntimeError(f"rasterizer 'gsplat' cannot run: {reason}. These would work: {elsewhere}.")
    if like.dtype != torch.float32:
        raise TypeError(f"rasterizer 'gsplat' takes float32 tensors, got {like.dtype}; convert them, or use 'torch'.")
    import gsplat

    return gsplat


def _missing(device: torch.device) -> str | None:
    """What keeps gsplat from running on `device`; None where nothing does."""
    if device.type != "cuda":
        return f"the tensors are on '{device}', and gsplat has CUDA kernels only"
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        return f"the package gsplat cannot be imported ({error}); install gsplat==1.4.0"
    remedy = "install the CUDA toolkit of torch's version, or a prebuilt wheel from https://docs.gsplat.studio/whl"
    try:
        kernels = importlib.import_module("gsplat.cuda._backend")._C
    except Exception as error:  # this import compiles, and a failing compiler raises anything
        return f"gsplat's CUDA kernels cannot be compiled ({type(error).__name__}: {error}); {remedy}"
    if kernels is None:
        return f"gsplat's CUDA kernels are not compiled and there is no nvcc to compile them; {remedy}"
    return None


def _info(
    means2d: Tensor, radii: Tensor, depths: Tensor, conics: Tensor, opacities: Tensor, camera: Camera
) -> dict[str, Any]:
    """What `gsplat.rasterization` would report of one camera."""
    return {
        "means2d": means2d,
        "radii": radii,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "width": camera.width,
        "height": camera.height,
        "n_cameras": 1,
        "gaussian_ids": None,
        "camera_ids": None,
    }


def _empty(splats: Splats, camera: Camera, background: Float[Tensor, " d"] | None) -> Rendering:
    """The picture of nothing: the kernels are not made for it."""
    zero = splats.means.new_zeros(camera.height, camera.width, 1)
    features = zero.expand(-1, -1, splats.features.shape[1])
    radii = torch.zeros(1, 0, dtype=torch.int32, device=zero.device)
    depths, opacities = splats.means[None, :, 2], splats.opacities[None]
    info = _info(splats.means[None, :, :2], radii, depths, splats.means[None], opacities, camera)
    return Rendering(features if background is None else features + background, zero, zero, info)
