"""gsplat on CUDA behind the rasterizer seam; the only file that knows how gsplat's versions differ.

Written against gsplat 1.4.0, which nerfstudio 1.1.5 pins. From 1.5, `radii` has one entry per image axis; here the
larger one is kept, as in 1.4. Newer kernels cap alpha at 0.99 instead of 0.999: that is compiled in, so pictures differ
by up to 0.01 where a single Gaussian is opaque.
"""

import importlib
from typing import Any

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from freqgs_plugin.rendering.base import BLUR, NEAR_PLANE, check_inputs
from freqgs_plugin.types import Camera, Rendering, Splats

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
        rasterization = _rasterization(splats.means)
        check_inputs(splats, camera)
        if len(splats) == 0:
            return _empty(splats, camera, background)
        image, alpha, meta = rasterization(
            means=splats.means,
            quats=splats.quats,
            scales=splats.scales,
            opacities=splats.opacities,
            colors=splats.features,
            viewmats=camera.viewmat.to(splats.means)[None],
            Ks=camera.K.to(splats.means)[None],
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


def _larger_radii(radii: Int32[Tensor, "1 n"] | Int32[Tensor, "1 n 2"]) -> Int32[Tensor, "1 n"]:
    """px; gsplat >= 1.5 reports one per image axis."""
    return radii if radii.dim() == 2 else radii.amax(dim=-1)


def _rasterization(like: Tensor) -> Any:
    """`gsplat.rasterization`, if it can run on tensors like this one."""
    reason = _missing(like.device)
    if reason is not None:
        elsewhere = "'torch', or 'numba' on the CPU" if like.device.type == "cpu" else "'torch' on this device"
        raise RuntimeError(f"rasterizer 'gsplat' cannot run: {reason}. These would work: {elsewhere}.")
    if like.dtype != torch.float32:
        raise TypeError(f"rasterizer 'gsplat' takes float32 tensors, got {like.dtype}; convert them, or use 'torch'.")
    import gsplat

    return gsplat.rasterization


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


def _empty(splats: Splats, camera: Camera, background: Float[Tensor, " d"] | None) -> Rendering:
    """The picture of nothing: the kernels are not made for it."""
    zero = splats.means.new_zeros(camera.height, camera.width, 1)
    features = zero.expand(-1, -1, splats.features.shape[1])
    info = {
        "means2d": splats.means[None, :, :2],
        "radii": torch.zeros(1, 0, dtype=torch.int32, device=zero.device),
        "depths": splats.means[None, :, 2],
        "conics": splats.means[None],
        "opacities": splats.opacities[None],
        "width": camera.width,
        "height": camera.height,
        "n_cameras": 1,
        "gaussian_ids": None,
        "camera_ids": None,
    }
    return Rendering(features if background is None else features + background, zero, zero, info)
