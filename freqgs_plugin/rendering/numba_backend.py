"""The fast rasterizer for a CPU: float32, compiled by numba, all level prefixes in a single pass.

Agrees with the torch reference to float32 rounding (docs/backends.md has the figures). The same input gives the same
bits, with any number of threads: no two threads ever add to the same number.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from numba import get_num_threads
from torch import Tensor

from freqgs_plugin.functional.numba_threads import check_layer
from freqgs_plugin.rendering.base import BLUR, Statistics, check_entries, check_inputs, check_levels
from freqgs_plugin.rendering.freed_memory import keep_freed_memory
from freqgs_plugin.rendering.numba_binning import depth_order, tile_lists
from freqgs_plugin.rendering.numba_compositing import composite, composite_backward
from freqgs_plugin.rendering.numba_projection import COLUMNS, OPACITY, V_COLUMNS, project, project_backward
from freqgs_plugin.types import Camera, Rendering, Splats

_CHANNELS = 3
"""features composited per pass"""


@dataclass
class _View:
    """What forward leaves for backward: arrays that share memory with torch tensors."""

    pose: Any
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int
    blur: float
    antialiased: bool
    prefixes: int
    own: bool
    level: Any
    splats: Any
    lists: Any


def _array(tensor: Tensor) -> Any:
    return tensor.detach().contiguous().numpy()


def _check(splats: Splats, camera: Camera) -> None:
    for name in ("means", "quats", "scales", "opacities", "features"):
        tensor: Tensor = getattr(splats, name)
        if tensor.device.type != "cpu" or tensor.dtype != torch.float32:
            raise TypeError(
                f"the numba rasterizer takes float32 tensors on the CPU, but {name} is {tensor.dtype} on "
                f"{tensor.device}. Convert it, or use the torch rasterizer."
            )
    check_inputs(splats, camera)


def _feature_groups(features: Tensor) -> list[Any]:
    """Features [n, d] as arrays [n, 3], the last one padded with zeros."""
    d = features.shape[1]
    groups = []
    for start in range(0, d, _CHANNELS):
        group = features.detach()[:, start : start + _CHANNELS]
        missing = _CHANNELS - group.shape[1]
        groups.append(_array(torch.nn.functional.pad(group, (0, missing)) if missing else group))
    return groups


class _Composite(torch.autograd.Function):
    """(splats, means2d probe, view matrix, background [d]) -> planes [prefixes, d, h, w] over the background, alpha
    [prefixes, h, w], depth [h, w] (empty unless asked for).
    """

    @staticmethod
    def forward(
        ctx, means, quats, scales, opacities, features, means2d, viewmat, background, view: _View, depths, with_depth,
        probe,
    ):  # fmt: skip
        shape = (view.prefixes, view.height, view.width)
        alpha, depth = torch.empty(shape), torch.zeros(shape[1:] if with_depth else (0, 0))
        images = []
        backgrounds = _feature_groups(background[None])
        for number, group in enumerate(_feature_groups(features)):
            image = torch.empty(view.prefixes, _CHANNELS, view.height, view.width)
            composite(
                *view.lists[:2], view.splats, _array(depths), view.level, view.prefixes, group,
                backgrounds[number][0], with_depth and number == 0, view.width, view.height,
                image.numpy(), alpha.numpy(), depth.numpy(),
            )  # fmt: skip
            images.append(image)
        ctx.save_for_backward(means, quats, scales, opacities, features, alpha, *images)
        ctx.set_materialize_grads(False)
        ctx.view, ctx.probe = view, probe
        ctx.mark_non_differentiable(depth)
        planes = torch.cat(images, 1) if len(images) > 1 else images[0]
        return planes[:, : features.shape[1]], alpha, depth

    @staticmethod
    def backward(ctx, v_planes, v_alpha, _v_depth):
        means, quats, scales, opacities, features, alpha, *images = ctx.saved_tensors
        view: _View = ctx.view
        offsets, entries, first, count = view.lists
        n, d = features.shape
        if v_planes is None:
            v_planes = torch.zeros(len(alpha), d, *alpha.shape[1:])
        no_gradient = alpha[:0]
        partial = torch.empty(len(entries) * V_COLUMNS)
        moves, wants_pose = any(ctx.needs_input_grad[:4]) or ctx.needs_input_grad[6], ctx.needs_input_grad[6]
        total, v_feature_groups = {}, []
        for number, group in enumerate(_feature_groups(features)):
            v_image = v_planes[:, number * _CHANNELS : (number + 1) * _CHANNELS]
            missing = _CHANNELS - v_image.shape[1]
            if missing:
                v_image = torch.nn.functional.pad(v_image, (0, 0, 0, 0, 0, missing))
            composite_backward(
                offsets, entries, view.splats, view.level, view.prefixes, view.own, group,
                view.width, view.height, images[number].numpy(), alpha.numpy(), _array(v_image),
                _array(v_alpha if v_alpha is not None and number == 0 else no_gradient), partial.numpy(),
            )  # fmt: skip
            widths = {"means": 3, "quats": 4, "scales": 3, "opacity": 1, "features": 3, "xy": 2, "abs": 2}
            out = {name: torch.empty(n, width) for name, width in widths.items()}
            out["view"] = torch.zeros(n if wants_pose else 0, 12)
            project_backward(
                _array(means), _array(quats), _array(scales), _array(opacities), view.pose, view.intrinsics,
                view.width, view.height, view.blur, view.antialiased, moves, view.splats, first, count, partial.numpy(),
                out["means"].numpy(), out["quats"].numpy(), out["scales"].numpy(), out["opacity"].numpy()[:, 0],
                out["features"].numpy(), out["xy"].numpy(), out["abs"].numpy(), out["view"].numpy(),
            )  # fmt: skip
            v_feature_groups.append(out.pop("features"))
            total = {name: total[name] + out[name] for name in out} if total else out
        if ctx.probe is not None and d <= _CHANNELS:
            ctx.probe.absgrad = total["abs"][None]
        v_pose = None
        if ctx.needs_input_grad[6]:
            rows = total["view"].double().sum(0).float()
            v_pose = torch.cat([torch.cat([rows[:9].view(3, 3), rows[9:, None]], 1), torch.zeros(1, 4)])
        v_background = (v_planes * (1 - alpha)[:, None]).sum((0, 2, 3)) if ctx.needs_input_grad[7] else None
        v_all = torch.cat(v_feature_groups, 1) if len(v_feature_groups) > 1 else v_feature_groups[0]
        return (
            total["means"], total["quats"], total["scales"], total["opacity"][:, 0], v_all[:, :d], total["xy"][None],
            v_pose, v_background, None, None, None, None,
        )  # fmt: skip


class _Pictures(torch.autograd.Function):
    """[prefixes, ...] -> its parts. Their gradients are not copied where they lie one behind the other already.

    That of indexing one by one would be an image of zeros per prefix, that of `unbind` copies always.
    """

    @staticmethod
    def forward(ctx, planes):
        ctx.set_materialize_grads(False)
        ctx.shape = planes.shape
        return planes.unbind(0)

    @staticmethod
    def backward(ctx, *grads):
        first = grads[0]
        if first is None:
            given = next((grad for grad in grads if grad is not None), None)
            if given is None:
                return None
            first = torch.zeros_like(given)
        if all(_follows(grad, first, k) for k, grad in enumerate(grads)):
            return first.as_strided(ctx.shape, (first.numel(), *first.stride()))
        return torch.stack([torch.zeros_like(first) if grad is None else grad for grad in grads])


def _follows(part: Tensor | None, first: Tensor, k: int) -> bool:
    """Whether `part` lies in memory as the k-th after `first`."""
    return (
        part is not None
        and part.is_contiguous()
        and part.dtype == first.dtype
        and part.untyped_storage().data_ptr() == first.untyped_storage().data_ptr()
        and part.data_ptr() == first.data_ptr() + k * first.numel() * first.element_size()
    )


class NumbaRasterizer:
    """Renders float32 tensors on the CPU. Gradients: all of `Splats`, and the camera's view matrix.

    More than 3 features are composited three at a time. Absolute gradients do not add up over such groups, so
    `info["means2d"]` has an `absgrad` for up to 3 features only.
    """

    name = "numba"

    def __init__(self, absgrad: bool = True):
        self.absgrad = absgrad
        warm_up()

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
        """See `Rasterizer.__call__`."""
        return self._render(splats, None, 1, camera, background, blur, antialiased, False, depth)[0]

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
        """See `PrefixRasterizer.prefixes`."""
        check_levels(level, num_levels)
        own = statistics == "own"
        return self._render(splats, level.int(), num_levels, camera, background, blur, antialiased, own, False)

    def _render(
        self, splats: Splats, level: Tensor | None, prefixes: int, camera: Camera, background: Tensor | None,
        blur: float, antialiased: bool, own: bool, depth: bool,
    ) -> list[Rendering]:  # fmt: skip
        _check(splats, camera)
        n = len(splats)
        projected, conics, depths = torch.empty(n, COLUMNS), torch.empty(n, 3), torch.empty(n)
        radii = torch.empty(n, dtype=torch.int32)
        pose = camera.viewmat.detach().double().contiguous().numpy()
        K = camera.K
        intrinsics = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        geometry = tuple(_array(t) for t in (splats.means, splats.quats, splats.scales, splats.opacities))
        project(
            *geometry, pose, intrinsics, camera.width, camera.height, blur, antialiased,
            projected.numpy(), conics.numpy(), depths.numpy(), radii.numpy(),
        )  # fmt: skip
        order = depth_order(depths.numpy(), projected.numpy())
        lists = tile_lists(order, projected.numpy(), camera.width, camera.height, n, get_num_threads())
        check_entries(int(lists[0][-1]), len(order), camera)
        view = _View(
            pose, intrinsics, camera.width, camera.height, blur, antialiased, prefixes, own,
            None if level is None else _array(level), projected.numpy(), lists,
        )  # fmt: skip
        means2d = projected[None, :, :2].clone()
        wants_grad = torch.is_grad_enabled() and any(
            t.requires_grad for t in (splats.means, splats.quats, splats.scales, splats.opacities, splats.features)
        )
        means2d.requires_grad_(wants_grad)
        behind = splats.features.new_zeros(1) if background is None else background.to(splats.features)
        behind = behind.expand(splats.features.shape[1])
        planes, alpha, z = _Composite.apply(
            splats.means, splats.quats, splats.scales, splats.opacities, splats.features, means2d, camera.viewmat,
            behind, view, depths, depth, means2d if wants_grad and self.absgrad else None,
        )  # fmt: skip
        alpha = alpha[..., None]
        expected = alpha.new_zeros(()).expand(alpha.shape[1:])
        if depth:
            expected = torch.where(alpha[0] > 0, z[..., None] / alpha[0].clamp_min(1e-10), 0.0).detach()
        info = {
            "camera_ids": None,
            "gaussian_ids": None,
            "radii": radii[None],
            "means2d": means2d,
            "depths": depths[None],
            "conics": conics[None],
            "opacities": projected[None, :, OPACITY],
            "width": camera.width,
            "height": camera.height,
            "n_cameras": 1,
            "tile_size": 16,
        }
        # in memory the pictures stay planes, as losses want them
        pictures = zip(_Pictures.apply(planes), alpha.unbind(0), strict=True)
        return [
            Rendering(p.permute(1, 2, 0), a, expected, info if k == prefixes - 1 else {})
            for k, (p, a) in enumerate(pictures)
        ]


_warm = False


def warm_up() -> None:
    """Compile the kernels or load them from numba's cache, and check what they run on; once per process."""
    global _warm
    if _warm:
        return
    keep_freed_memory()
    try:
        _render_speck()
    except ValueError as error:
        raise RuntimeError(
            "numba found no thread-safe threading layer, which two threads that render (training and viewer) need. "
            "Install it with `pip install tbb`, or use --pipeline.model.rasterizer torch."
        ) from error
    check_layer()
    _warm = True


def _render_speck() -> None:
    """One Gaussian in one pixel, forward and backward, in every variant that is compiled separately."""
    rasterizer = object.__new__(NumbaRasterizer)
    rasterizer.absgrad = True
    leaves = [
        torch.tensor([[0.0, 0.0, 1.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.ones(1, 3),
        torch.full((1,), 0.5),
        torch.ones(1, 3),
    ]
    splats = Splats(*(leaf.requires_grad_() for leaf in leaves))
    camera = Camera(torch.eye(4), torch.eye(3), 1, 1)
    with torch.enable_grad():
        rasterizer(splats, camera).features.sum().backward()
        pictures = rasterizer.prefixes(splats, torch.ones(1, dtype=torch.int32), 2, camera)
        torch.stack([p.features for p in pictures]).sum().backward()
