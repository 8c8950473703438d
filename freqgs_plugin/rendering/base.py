"""The rasterizer seam: protocol, chooser and the compositing constants that every backend shares.

The constants are those of gsplat 1.4.0's CUDA kernels, so that a scene trained with one backend looks the same with
another.
"""

import importlib
import math
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from freqgs_plugin.types import Camera, Rendering, Splats

ALPHA_MAX = 0.999
"""cap of one Gaussian's opacity at a pixel (`rasterize_to_pixels_fwd.cu`)"""
ALPHA_MIN = 1.0 / 255.0
"""contributions below this are skipped"""
TRANSMITTANCE_MIN = 1e-4
"""a pixel is finished before the Gaussian that would bring its transmittance to this or less"""
NEAR_PLANE = 0.01
"""camera z at or below this is culled, world units"""
FOV_MARGIN = 0.15
"""the projection's Jacobian is taken at most this share of the image size outside of the image"""
BLUR = 0.3
"""variance added to the projected covariance, px^2"""
RADIUS_SIGMAS = 3.0
"""`info["radii"]` is this many standard deviations of the longer axis, rounded up, px"""

MAX_ENTRIES = 2**31 - 1
"""entries in the lists of Gaussians per tile: more take tens of gigabytes"""

Statistics = Literal["own", "full"]
"""which prefix feeds `info["means2d"].grad` and `.absgrad` of a prefix rendering:
`own`: for a Gaussian of level k the rendering of prefix k; `full`: the rendering of all levels for everyone"""


@runtime_checkable
class Rasterizer(Protocol):
    """Composites splats front to back for one camera.

    All backends share this module's constants, order equal depths by row, and never clamp.
    """

    name: str
    absgrad: bool
    """`info["means2d"].absgrad` exists after backward"""

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
        """Render `splats`, in the dtype and on the device of its tensors.

        Args:
            splats: n Gaussians with d features each.
            camera: the view.
            background: feature of what lies behind everything; zeros where None.
            blur: variance added to the projected covariance, px^2.
            antialiased: scale opacities by sqrt(det(cov) / det(cov + blur)) (Mip-Splatting's 2D filter).
            depth: also composite the expected depth; `Rendering.depth` is zero where this is False.

        Returns:
            features [h, w, d], alpha and expected depth [h, w, 1], and `info` with gsplat's keys: `means2d` [1, n, 2]
            px (after backward with `.grad`, and `.absgrad` where the backend has `absgrad`), `radii` [1, n] px (0: not
            drawn), `depths`, `conics`, `opacities` [1, n], `width`, `height`, `n_cameras`, `gaussian_ids`,
            `camera_ids`.
        """
        ...


@runtime_checkable
class PrefixRasterizer(Rasterizer, Protocol):
    """A rasterizer that composites all level prefixes in a single pass."""

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
        """One rendering per prefix k = 1..num_levels of all splats with `level <= k`, without depth.

        The last rendering's `info` describes all n splats; its `means2d` receives the gradients that `statistics`
        names.
        """
        ...


def check_inputs(splats: Splats, camera: Camera) -> None:
    """Refuse what no picture can be made of: every backend calls this first.

    Raises:
        ValueError: a shape that does not fit the others, a number that is not finite, an image without pixels, or a
            focal length that is not positive.
        TypeError: tensors of several dtypes, or a side that is no whole number.
    """
    _check_shapes(splats, camera)
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"camera is {camera.width}x{camera.height} px; both sides must be at least 1.")
    for name in ("viewmat", "K"):
        rows = getattr(camera, name).tolist()
        if not all(math.isfinite(x) for row in rows for x in row):
            raise ValueError(f"the camera's {name} is not finite: {rows}. Check the camera's pose and model.")
        if name == "viewmat" and _determinant(rows) == 0:
            raise ValueError(f"the camera's viewmat has no inverse: {rows}. Check the camera's pose.")
        if name == "K" and not min(rows[0][0], rows[1][1]) > 0:
            raise ValueError(f"focal lengths are {rows[0][0]:g} and {rows[1][1]:g} px; both must be > 0.")
    tensors: dict[str, Tensor] = {
        name: getattr(splats, name).detach() for name in ("means", "quats", "scales", "opacities", "features")
    }
    for name, values in tensors.items():
        if values.dtype != splats.means.dtype:
            raise TypeError(f"{name} are {values.dtype} but means are {splats.means.dtype}; give all one dtype.")
    # one pass without a mask; a finite sum has finite terms only. Read together: each read waits for a CUDA device
    sums = torch.stack([values.sum(dtype=_sum_dtype(values)) for values in tensors.values()]).tolist()
    for (name, values), total in zip(tensors.items(), sums, strict=True):
        if math.isfinite(total):
            continue
        bad = ~torch.isfinite(values).reshape(len(values), -1).all(-1)
        rows = torch.nonzero(bad).squeeze(1)
        if len(rows):
            first = int(rows[0])
            raise ValueError(
                f"{name} of {len(rows)} of {len(values)} Gaussians are not finite (first: row {first}, "
                f"{values[first].tolist()}). Remove these Gaussians; in training, lower the learning rates, or go back "
                "to a checkpoint before they appeared."
            )


def _determinant(rows: list[list[float]]) -> float:
    """Of the upper left 3 by 3 entries."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rows[:3])
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _check_shapes(splats: Splats, camera: Camera) -> None:
    """Compiled kernels read as far as the means tell them to."""
    n = len(splats.means)
    sides = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    for name, expected in sides.items():
        if tuple(getattr(splats, name).shape) != expected:
            found = list(getattr(splats, name).shape)
            raise ValueError(f"{name} have the shape {found}; with {n} means it must be {list(expected)}.")
    if splats.features.dim() != 2 or len(splats.features) != n:
        raise ValueError(f"features have the shape {list(splats.features.shape)}; with {n} means it must be [{n}, d].")
    for name, side in (("viewmat", 4), ("K", 3)):
        if tuple(getattr(camera, name).shape) != (side, side):
            raise ValueError(
                f"the camera's {name} has the shape {list(getattr(camera, name).shape)}, not [{side}, {side}]."
            )
    for name in ("width", "height"):
        if not isinstance(getattr(camera, name), int):
            raise TypeError(f"the camera's {name} is {getattr(camera, name)!r}; it must be a whole number of pixels.")


def check_levels(level: Int[Tensor, " n"], num_levels: int) -> None:
    """Refuse levels outside of 1..num_levels.

    Raises:
        ValueError: with the range there is.
    """
    if len(level) == 0:
        return
    low, high = torch.stack(torch.aminmax(level)).tolist()
    if not 1 <= low <= high <= num_levels:
        raise ValueError(
            f"levels run from {low} to {high}, outside of 1..{num_levels}; pass the number of levels of the model."
        )


def check_entries(entries: int, gaussians: int, camera: Camera) -> None:
    """Refuse lists of Gaussians per tile that would not fit into memory, before they are made.

    Raises:
        ValueError: there are more than `MAX_ENTRIES`.
    """
    if entries > MAX_ENTRIES:
        raise ValueError(
            f"{gaussians:,} Gaussians meet {entries:,} tiles of the {camera.width}x{camera.height} image, more than "
            f"{MAX_ENTRIES:,}. Render a smaller image, or remove Gaussians that cover all of it."
        )


def _sum_dtype(values: Tensor) -> torch.dtype:
    """Half precision would overflow."""
    return torch.float32 if values.dtype.itemsize < 4 else values.dtype


Factory = Callable[[bool], Rasterizer]
"""makes a rasterizer; the argument asks for `absgrad`"""

ENTRY_POINT_GROUP = "freqgs_plugin.rasterizers"
_BUILT_IN = {
    "torch": ("freqgs_plugin.rendering.torch_backend", "TorchRasterizer"),
    "numba": ("freqgs_plugin.rendering.numba_backend", "NumbaRasterizer"),
    "gsplat": ("freqgs_plugin.rendering.gsplat_backend", "GsplatRasterizer"),
}


def available_rasterizers() -> list[str]:
    """Names that `get_rasterizer` knows: built in and registered by entry point."""
    return [*_BUILT_IN, *(e.name for e in entry_points(group=ENTRY_POINT_GROUP) if e.name not in _BUILT_IN)]


def get_rasterizer(name: str, device: torch.device | str, *, absgrad: bool = True) -> Rasterizer:
    """The rasterizer called `name`; `auto` takes gsplat on CUDA, numba on the CPU and torch elsewhere.

    Third parties add theirs by an entry point in the group `freqgs_plugin.rasterizers` that names a callable
    `(absgrad: bool) -> Rasterizer`.

    Raises:
        ValueError: no such rasterizer, or it cannot run on `device`; the message names those that can.
    """
    kind = torch.device(device).type
    if name == "auto":
        name = {"cuda": "gsplat", "cpu": "numba"}.get(kind, "torch")
    fitting = ["torch", *(["numba"] if kind == "cpu" else []), *(["gsplat"] if kind == "cuda" else [])]
    if name == "gsplat" and kind != "cuda":
        raise ValueError(
            f"rasterizer 'gsplat' needs a CUDA device, but the tensors are on '{kind}'. "
            f"On this device choose one of: auto, {', '.join(fitting)}."
        )
    if name == "numba" and kind != "cpu":
        raise ValueError(
            f"rasterizer 'numba' runs on the CPU only, but the tensors are on '{kind}'. "
            f"Choose: auto, {', '.join(fitting)}."
        )
    if name in _BUILT_IN:
        module, attribute = _BUILT_IN[name]
        return getattr(importlib.import_module(module), attribute)(absgrad=absgrad)
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            factory: Factory = entry.load()
            return factory(absgrad)
    raise ValueError(f"unknown rasterizer '{name}'. Choose one of: auto, {', '.join(available_rasterizers())}.")
