"""How much of each Gaussian is drawn: a weight in [0, 1] per row. Level of detail is one of these, passed to `render`.

Weights multiply opacities. Two attenuations combine by `Product`. Equation numbers are those of the paper on continuous
level of detail (CLoD-GS).
"""

import math
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.functional.projection import NEAR_PLANE, exact_centre
from freqgs_plugin.types import Camera, Gaussians

TAU = 1.0 / 255.0
"""τ: opacities at or below `TAU * scale` are not drawn. Rasterizers skip what is fainter than this anyway"""
EPSILON = 1e-8
"""ε of Eq. 2"""
Reference = Literal["frustum_max", "frustum_quantile", "scene"]
"""what distances are divided by: the largest distance of a Gaussian in the frustum (the paper), the 0.99 quantile of
those distances, or one number that belongs to the scene and does not change with the view"""
_QUANTILE = 0.99
LEAST_OPACITY = 1e-30
LARGEST_DECAY = 1e15
FARTHEST = 1e18
FAINTEST = -85.0
"""least exponent that is taken: exp of it is about the least normal number of float32"""
FADED = 100.0
"""a distance of more than this many sqrt(2) sigma counts as this many: exp(-1e4) is 0 in every dtype"""


@runtime_checkable
class Attenuation(Protocol):
    """Weight in [0, 1] of every Gaussian for one view."""

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]: ...


@dataclass(frozen=True)
class LevelCut:
    """The prefix of levels <= `level`; a fractional level k + t adds level k + 1 with its opacity times t.

    Continuous in `level`, and equal to the prefix at whole numbers. At or above the finest level everything is drawn.
    """

    level: float | int

    def __post_init__(self) -> None:
        if not self.level >= 0:
            raise ValueError(f"level is {self.level}; it must be a number >= 0 (0 draws nothing, 1 the base).")

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        whole = math.floor(min(self.level, 2**24))
        weight = (gaussians.level <= whole).to(gaussians.opacities.dtype)
        return weight + (self.level - whole if self.level < 2**24 else 0.0) * (gaussians.level == whole + 1)


@dataclass(frozen=True)
class SingleLevel:
    """The Gaussians of one level alone. This is no band image (that is the difference of two prefixes)."""

    level: int

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        return (gaussians.level == self.level).to(gaussians.opacities.dtype)


@dataclass(frozen=True)
class Product:
    """Several attenuations at once: the product of their weights; without any, 1."""

    parts: tuple[Attenuation, ...]

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        weight = torch.ones_like(gaussians.opacities)
        for part in self.parts:
            weight = weight * part(gaussians, camera)
        return weight


@dataclass(frozen=True)
class DistanceDecay:
    """Opacities that fall with distance, and a cut under which nothing is drawn (Eq. 2 and the mask M below it).

    α'' = α exp(-(d' s)^2 / (2 max(σ, 0)^2 + ε)), drawn only where α'' > τ s. The weight is α'' / α there and 0
    elsewhere; it falls with `scale` and with distance, and rises with σ. Computed in float32 at least, under autocast
    too. The distance has no gradient: fading must not move Gaussians.

    A dead decay (σ <= 0) has no gradient, and weight 0 except at the camera's centre (d' s under about 1e-4, where ε
    counts). A faint Gaussian (α <= τ s) has weight 0 at any distance.
    """

    scale: float | int = 1.0
    """s_v, the virtual distance scale, > 0: 1 is the scene as trained, 2 as if seen from twice as far"""
    reference: Reference = "scene"
    """what distances are divided by"""
    scene_distance: float | int | None = None
    """world units, for the reference `scene`"""
    soft: bool = True
    """fade between 1 and 2 times the threshold, so that nothing pops (ours); off: a step at the threshold (the paper).
    Which Gaussians have weight 0 is the same"""

    def __post_init__(self) -> None:
        if not 0 < self.scale < math.inf:
            raise ValueError(f"scale is {self.scale}; it must be a finite number > 0 (1 is the scene as trained).")
        _check_reference(self.reference, self.scene_distance)

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        if self.reference == "scene" and self.scene_distance is not None and _for_viewing(gaussians):
            from freqgs_plugin.functional import compiled_attenuation

            parts = gaussians.means, exact_centre(camera), gaussians.opacities, decay_of(gaussians)
            return compiled_attenuation.weights(*parts, float(self.scale), float(self.scene_distance), self.soft)
        distance = normalised_distance(gaussians, camera, self.reference, self.scene_distance)
        exponent = log_decay(distance, decay_of(gaussians), self.scale)
        margin = _log_opacity(gaussians.opacities).add_(exponent).sub_(math.log(TAU * self.scale))
        # what is fainter is not drawn: numbers under 1e-38 would be a hundred times slower
        weight = exponent.clamp_min(FAINTEST).exp_()
        if not self.soft:
            return weight * (margin > 0)
        # not expm1, which torch does not vectorise: where they differ, the fade is nothing
        fade = (margin.clamp(0.0, math.log(2.0)).exp_() - 1.0).clamp_max(1.0)
        return (weight * fade).mul_(fade).mul_((-2.0 * fade).add_(3.0))

    def margin(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        """ln α'' - ln(τ s) of every Gaussian: it is drawn where this is positive."""
        distance = normalised_distance(gaussians, camera, self.reference, self.scene_distance)
        log_alpha = log_attenuated(gaussians.opacities, distance, decay_of(gaussians), self.scale)
        return log_alpha - math.log(TAU * self.scale)


def log_decay(distance: Float[Tensor, " n"], decay: Float[Tensor, " n"], scale: float | int) -> Float[Tensor, " n"]:
    """-(d' s)^2 / (2 max(σ, 0)^2 + ε), at least -1e4: the exponent of Eq. 2, with finite gradients for any σ."""
    distance, decay = _at_least_float32(distance), _at_least_float32(decay)
    far = (distance * min(float(scale), FARTHEST)).clamp_max(FARTHEST)
    # in place where no derivative needs what was there: each array that is not made is one that need not be fetched
    reach = decay.clamp(0.0, LARGEST_DECAY).square().mul_(2.0).add_(EPSILON).sqrt_()
    # squared last: the quotient and its derivatives stay in range where the squares would not
    return (far / reach).clamp_max(FADED).square().neg_()


def log_attenuated(
    opacities: Float[Tensor, " n"], distance: Float[Tensor, " n"], decay: Float[Tensor, " n"], scale: float | int
) -> Float[Tensor, " n"]:
    """ln α'' (Eq. 2) from α in [0, 1], the normalised distance d', σ and s_v. Drawn where it is > ln(TAU * scale).

    α counts as at least 1e-30, so that the logarithm is finite; below, its gradient is 0.
    """
    return _log_opacity(opacities) + log_decay(distance, decay, scale)


def _log_opacity(opacities: Tensor) -> Tensor:
    return _at_least_float32(opacities).clamp_min(LEAST_OPACITY).log()


def normalised_distance(
    gaussians: Gaussians, camera: Camera, reference: Reference = "scene", scene_distance: float | int | None = None
) -> Float[Tensor, " n"]:
    """d': distance from the camera's centre to each mean, divided by the reference; without gradient.

    In the frustum are the Gaussians whose centres lie in front of the near plane and project into the image. Where
    there is none, all Gaussians stand in for them. Where all lie at the camera's centre, d' is 0.

    Raises:
        ValueError: the reference `scene` without a distance > 0.
    """
    _check_reference(reference, scene_distance)
    offsets = _offsets(gaussians, camera)
    distance = _lengths(offsets)
    if reference == "scene":
        assert scene_distance is not None
        return distance / scene_distance
    if not len(distance):
        return distance
    largest = _frustum_distance(distance, _in_frustum(offsets, camera), reference)
    return torch.where(largest > 0, distance / torch.where(largest > 0, largest, 1.0), 0.0)


def frustum_distance(
    gaussians: Gaussians, camera: Camera, reference: Literal["frustum_max", "frustum_quantile"] = "frustum_max"
) -> float:
    """The distance that `normalised_distance` divides by for one view, world units; 0 without Gaussians."""
    offsets = _offsets(gaussians, camera)
    distance = _lengths(offsets)
    return float(_frustum_distance(distance, _in_frustum(offsets, camera), reference)) if len(distance) else 0.0


@torch.no_grad()
def _offsets(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "3 n"]:
    """From the camera's centre to each mean, on the world's axes."""
    means = _at_least_float32(gaussians.means)
    centre = exact_centre(camera)
    # from a rounded centre, so that scenes far from the origin keep their digits; then what rounding took from it
    rounded = centre.to(means)
    rest = rounded.to(centre) - centre
    # axes first: what follows reads one axis at a time
    offsets = means.new_empty(3, len(means))
    return torch.sub(means.T, rounded[:, None], out=offsets).add_(rest.to(means)[:, None])


def _lengths(offsets: Float[Tensor, "3 n"]) -> Float[Tensor, " n"]:
    return torch.hypot(torch.hypot(offsets[0], offsets[1]), offsets[2])


@torch.no_grad()
def _in_frustum(offsets: Float[Tensor, "3 n"], camera: Camera) -> Bool[Tensor, " n"]:
    """Which means the image shows, by their offsets from the camera's centre."""
    # autocast would take this product at half precision
    with torch.autocast(offsets.device.type, enabled=False):
        x, y, z = camera.viewmat[:3, :3].to(offsets) @ offsets
    intrinsics = camera.K.to(offsets)
    front = z > NEAR_PLANE
    depth = torch.where(front, z, 1.0)
    u = x / depth * intrinsics[0, 0] + intrinsics[0, 2]
    v = y / depth * intrinsics[1, 1] + intrinsics[1, 2]
    return front & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)


def _frustum_distance(
    distance: Float[Tensor, " n"], in_frustum: Bool[Tensor, " n"], reference: Reference
) -> Float[Tensor, ""]:
    if not bool(in_frustum.any()):
        in_frustum = torch.ones_like(in_frustum)
    if reference == "frustum_max":
        # distances are not negative
        return distance.masked_fill(~in_frustum, 0.0).max()
    shown = distance[in_frustum]
    return shown.kthvalue(math.ceil(_QUANTILE * len(shown))).values


def _check_reference(reference: str, scene_distance: float | None) -> None:
    if reference not in ("frustum_max", "frustum_quantile", "scene"):
        raise ValueError(f"reference is '{reference}'; choose frustum_max, frustum_quantile or scene.")
    if reference == "scene" and not (scene_distance is not None and 0 < scene_distance < math.inf):
        raise ValueError(
            f"scene_distance is {scene_distance}; the reference 'scene' needs a distance > 0 in world units, which a "
            "trained run holds. Without one, choose frustum_max or frustum_quantile."
        )


def decay_of(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """The Gaussians' decay; a ValueError where they have none."""
    if gaussians.decay is None:
        raise ValueError(
            "these Gaussians have no decay, so distance cannot fade them. Train them with clodsplat, or give them one "
            "(`dataclasses.replace(gaussians, decay=...)`)."
        )
    if gaussians.decay.shape != gaussians.opacities.shape:
        raise ValueError(
            f"decay has the shape {list(gaussians.decay.shape)}, and opacities {list(gaussians.opacities.shape)}; "
            "every Gaussian needs one of each."
        )
    return gaussians.decay


def _for_viewing(gaussians: Gaussians) -> bool:
    """Whether the compiled kernel applies: float32 on the CPU, and nobody wants a gradient."""
    taken = (gaussians.means, gaussians.opacities, decay_of(gaussians))
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in taken) and not (
        torch.is_grad_enabled() and any(t.requires_grad for t in taken[1:])
    )


def _at_least_float32(x: Tensor) -> Tensor:
    return x.to(torch.promote_types(x.dtype, torch.float32))
