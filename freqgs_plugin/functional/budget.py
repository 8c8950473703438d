"""How far to reduce detail so that one view draws at most so many Gaussians. For megabytes and time see `cost`.

In `clodsplat`, α'' = α exp(-a s^2) with a = d'^2 / (2 max(σ, 0)^2 + ε) is drawn where α'' > τ s. Both sides are
monotone in s, so each Gaussian has a cut-off s* at which it vanishes for good, and a budget of N is an order statistic
of the cut-offs. With b = ln(α / τ):

    b - a s*^2 = ln s*    <=>    s* = sqrt(W(2 a e^(2 b)) / (2 a)),   W Lambert's function.

`lapsplat` draws whole levels, and of the next one the Gaussians that show most.

Only Gaussians in view count, and budgets draw no others.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import (
    EPSILON,
    TAU,
    DistanceDecay,
    Reference,
    decay_of,
    normalised_distance,
)
from freqgs_plugin.functional.projection import FOV_MARGIN, NEAR_PLANE, RADIUS_SIGMAS
from freqgs_plugin.types import Camera, Gaussians

TIE = 2e-6
"""cut-offs that differ by a smaller share count as equal: float32 cannot tell on which side of them a scale is"""
_FEW = 256
_FADE = 0.25
"""Gaussians fade in between 1 and at most this much more than 1 times the measure at which they are left out"""
_WHOLE = 0.75
"""share of a budget that is drawn without fading, however near to each other the measures are"""
_BLUR = 0.3 + 0.1
"""px^2: the rasterizers' blur, and the floor of gsplat's eigenvalue"""


@dataclass(frozen=True)
class Fit:
    """What a budget allows in one view."""

    scale: float
    """s_v"""
    drawn: int
    """Gaussians in view that are drawn at this scale"""
    note: str = ""
    """why the budget is not met, where it is not"""


@dataclass(frozen=True)
class LevelFit:
    """What a budget allows of a scene of levels."""

    level: int
    """levels up to this one are drawn whole; 0: not even the base fits"""
    fraction: float
    """share of the next level's Gaussians (in view) that is drawn, [0, 1)"""
    drawn: int
    """Gaussians in view that are drawn"""


@dataclass(frozen=True)
class DecayBudget:
    """`DistanceDecay` at the smallest scale in `least`..`largest` that draws at most `count` Gaussians of a view.

    Where `largest` draws more than `count`, and where several vanish at once (see `decay_scale`), those that show most
    stay, as in `LevelBudget`. Gaussians out of view have weight 0.
    """

    count: float | int
    reference: Reference = "scene"
    scene_distance: float | int | None = None
    """world units, for the reference `scene`"""
    soft: bool = True
    """as in `DistanceDecay`"""
    least: float | int = 1.0
    """the scale is never smaller: what a detail slider asks for"""
    largest: float | int = math.inf
    """the scale is never larger, unless `least` is: what the scene was trained for. Beyond, all of it fades away"""

    def __post_init__(self) -> None:
        _whole(self.count)
        DistanceDecay(self.least, self.reference, self.scene_distance)
        if not self.largest > 0:
            raise ValueError(f"the largest scale is {self.largest}; it must be > 0 (inf: no bound).")

    def scale(self, gaussians: Gaussians, camera: Camera) -> float:
        """s_v for one view."""
        fit = decay_scale(gaussians, camera, self.count, self.reference, self.scene_distance, self.least)
        return max(min(fit.scale, float(self.largest)), float(self.least))

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        decay = DistanceDecay(self.scale(gaussians, camera), self.reference, self.scene_distance, self.soft)
        weight = decay(gaussians, camera) * in_view(gaussians, camera)
        return _most_visible(gaussians, weight, camera, int(self.count), self.soft)


@dataclass(frozen=True)
class LevelBudget:
    """Whole levels as long as they fit into `count` Gaussians of a view, then the part of the next one that shows most.

    `LevelCut` at a fraction would draw all of the next level, faded; a budget has to leave some out. Those with the
    largest opacity times area on the screen stay. The last quarter of them at most fades, between 1 and 1.25 times the
    measure at which they are left out, so that nothing pops as the camera moves; of equal ones the first stay. Where
    not even level 1 fits, it is drawn in part. Gaussians out of view have weight 0.
    """

    count: float | int
    soft: bool = True
    """fade; off: a step"""

    def __post_init__(self) -> None:
        _whole(self.count)

    def fit(self, gaussians: Gaussians, camera: Camera) -> LevelFit:
        """Which levels the view gets."""
        seen = in_view(gaussians, camera)
        level, left, total = self._whole_levels(gaussians, seen)
        if total == 0:
            return LevelFit(level, 0.0, int(self.count) - left)
        drawn = int((self._part(gaussians, camera, seen, level + 1, left) > 0).sum())
        return LevelFit(level, drawn / total, int(self.count) - left + drawn)

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
        seen = in_view(gaussians, camera)
        level, left, total = self._whole_levels(gaussians, seen)
        weight = (seen & (gaussians.level <= level)).to(gaussians.opacities.dtype)
        if total == 0 or left == 0:
            return weight
        return weight + self._part(gaussians, camera, seen, level + 1, left)

    def _whole_levels(self, gaussians: Gaussians, seen: Bool[Tensor, " n"]) -> tuple[int, int, int]:
        """How many levels fit, how much of the budget is left, and how many Gaussians the next level has in view."""
        counts = torch.bincount(gaussians.level[seen].long())[1:].tolist()
        left = int(self.count)
        for level, size in enumerate(counts):
            if size > left:
                return level, left, size
            left -= size
        return max(int(gaussians.level.max()), len(counts)) if len(gaussians) else 0, left, 0

    def _part(
        self, gaussians: Gaussians, camera: Camera, seen: Bool[Tensor, " n"], level: int, count: int
    ) -> Float[Tensor, " n"]:
        """Weights of the `count` Gaussians of `level` in view that show most."""
        weight = (seen & (gaussians.level == level)).to(gaussians.opacities.dtype)
        return _most_visible(gaussians, weight, camera, count, self.soft)


def decay_scale(
    gaussians: Gaussians,
    camera: Camera,
    count: float | int,
    reference: Reference = "scene",
    scene_distance: float | int | None = None,
    least: float | int = 1.0,
) -> Fit:
    """The scale s_v at which at most `count` Gaussians in view are drawn: exactly `count`, apart from ties.

    Never under `least` (1 is full detail): a budget above what that draws is met by it. s_v falls as `count` grows. It
    lies between the cut-offs of the last Gaussian that is drawn and the first that is not, in the middle where they are
    far enough apart. Gaussians whose cut-offs agree to `TIE` are dropped together, and then fewer than `count` are
    drawn. Where that would leave none, they are all drawn, and the note says so.

    Raises:
        ValueError: a count under 1 or not finite; Gaussians without decay; a reference without its distance; a scale
            that is not positive.
    """
    count = _whole(count)
    if not 0 < least < math.inf:
        raise ValueError(f"the least scale is {least}; it must be a finite number > 0 (1 is the scene as trained).")
    log_least = math.log(least)
    distance = normalised_distance(gaussians, camera, reference, scene_distance)
    a, b = _exponents_above(gaussians, distance, in_view(gaussians, camera), log_least)
    if len(a) <= count:
        return Fit(float(least), len(a))
    kept, dropped = _two_cutoffs(a, b, count, log_least)
    log_scale = max((kept + dropped) / 2, dropped + TIE)
    drawn = _count_above(a, b, log_scale)
    if drawn == 0:
        log_scale = max(kept - TIE, log_least)
        drawn = _count_above(a, b, log_scale)
        return Fit(math.exp(log_scale), drawn, f"{drawn:,} Gaussians vanish at the same scale; fewer would be none.")
    return Fit(math.exp(log_scale), drawn)


def log_cutoff(
    opacities: Float[Tensor, " n"], distance: Float[Tensor, " n"], decay: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """ln s*: the scale at and beyond which α'' <= τ s, float64. -inf for opacity 0; α / τ for d' = 0.

    Everything is a logarithm, so that nothing overflows: from y = 2 a s*^2 follows y + ln y = z = ln(2 a) + 2 b, which
    is solved for w = ln y by two of Halley's steps; then ln s* = b - y / 2.
    """
    return _solve(*_exponents(opacities, distance, decay))


def in_view(gaussians: Gaussians, camera: Camera) -> Bool[Tensor, " n"]:
    """What may show: in front of the near plane, and near enough to the image.

    Everything that a rasterizer draws is among them, and little else: a Gaussian counts as a sphere of its longest
    axis, 3 standard deviations in radius.
    """
    if _compiled(gaussians):
        from freqgs_plugin.functional import compiled_budget

        return compiled_budget.in_view(gaussians, camera, _BLUR)
    viewmat, intrinsics = camera.viewmat.to(gaussians.means).double(), camera.K.double()
    x, y, z = torch.addmm(viewmat[:3, 3:], viewmat[:3, :3], gaussians.means.detach().double().T)
    front = z > NEAR_PLANE
    inverse_z = 1 / torch.where(front, z, 1.0)
    fx, fy, cx, cy = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    u, v = x * inverse_z, y * inverse_z
    tangents = [
        t.clamp(-p / f - FOV_MARGIN * side / f, (side - p) / f + FOV_MARGIN * side / f)
        for t, f, p, side in ((u, fx, cx, camera.width), (v, fy, cy, camera.height))
    ]
    spread = 1 + tangents[0].square() + tangents[1].square()
    footprint = gaussians.scales.detach().double().amax(-1) * inverse_z * max(fx, fy)
    radius = torch.ceil(RADIUS_SIGMAS * (footprint.square() * spread + _BLUR).sqrt())
    px, py = u * fx + cx, v * fy + cy
    return (
        front
        & (px + radius > 0) & (px - radius < camera.width)
        & (py + radius > 0) & (py - radius < camera.height)
    )  # fmt: skip


def _exponents(
    opacities: Float[Tensor, " n"], distance: Float[Tensor, " n"], decay: Float[Tensor, " n"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """a = d'^2 / (2 max(σ, 0)^2 + ε) and b = ln(α / τ), float64."""
    a = distance.detach().double().square() / (2 * decay.detach().double().clamp_min(0).square() + EPSILON)
    return a, opacities.detach().double().log() - math.log(TAU)


def _exponents_above(
    gaussians: Gaussians, distance: Float[Tensor, " n"], seen: Bool[Tensor, " n"], log_scale: float
) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """a and b of the Gaussians in view that are drawn at a scale."""
    decay = decay_of(gaussians)
    if _compiled(gaussians):
        from freqgs_plugin.functional import compiled_budget

        return compiled_budget.exponents(gaussians.opacities, distance, decay, seen, log_scale)
    a, b = _exponents(gaussians.opacities, distance, decay)
    rows = seen & (torch.sub(b, a, alpha=math.exp(2 * log_scale)) > log_scale)
    return a[rows], b[rows]


def _solve(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """t with b - a e^(2 t) = t."""
    # below -40, y = e^z leaves t = b to the last bit
    z = ((2 * a).log() + 2 * b).clamp_min(-40.0)
    large = z.clamp_min(1.0)
    w = torch.where(z > 1, (large - large.log()).log(), torch.minimum(z, (z - 1) / 2))
    for _ in range(2):
        y = w.exp()
        error, slope = w + y - z, 1 + y
        w = w - error / (slope - error * y / (2 * slope))
    return b - w.exp() / 2


def _count_above(a: Float[Tensor, " n"], b: Float[Tensor, " n"], log_scale: float) -> int:
    """How many have a larger cut-off: neither exponential nor logarithm is needed for each."""
    if a.device.type == "cpu":
        from freqgs_plugin.functional import compiled_budget

        return compiled_budget.count_above(a, b, log_scale)
    return int(torch.count_nonzero(torch.sub(b, a, alpha=math.exp(2 * log_scale)) > log_scale))


def _between(a: Float[Tensor, " n"], b: Float[Tensor, " n"], low: float, high: float) -> Tensor:
    """Rows whose cut-offs lie above `low` and not above `high`."""
    if a.device.type == "cpu":
        from freqgs_plugin.functional import compiled_budget

        return compiled_budget.between(a, b, low, high)
    return (torch.sub(b, a, alpha=math.exp(2 * low)) > low) & (torch.sub(b, a, alpha=math.exp(2 * high)) <= high)


def _two_cutoffs(a: Float[Tensor, " n"], b: Float[Tensor, " n"], count: int, low: float) -> tuple[float, float]:
    """The `count`-th largest ln s* and the next one; all are above `low`, and there are more than `count`.

    The range of scales is halved until few Gaussians are left in it, or until it is a tie; those are solved for.
    """
    high = float(b.max())
    above_low, above_high = len(a), 0
    while above_low - above_high > _FEW and high - low > TIE:
        middle = (low + high) / 2
        above = _count_above(a, b, middle)
        if above > count:
            low, above_low = middle, above
        elif above < count:
            high, above_high = middle, above
        else:
            break
    rows = _between(a, b, low, high)
    cutoffs = _solve(a[rows], b[rows]).sort(descending=True).values
    return float(cutoffs[count - above_high - 1]), float(cutoffs[count - above_high])


def _most_visible(
    gaussians: Gaussians, weight: Float[Tensor, " n"], camera: Camera, count: int, soft: bool
) -> Float[Tensor, " n"]:
    """`weight` of the at most `count` Gaussians that show most, 0 of others; it is returned where so few have any."""
    rows = torch.where(weight > 0)[0]
    if len(rows) <= count:
        return weight
    out = torch.zeros_like(weight)
    if count == 0:
        return out
    shown = weight[rows]
    measure = _visibility(gaussians.select(rows), camera) * shown.detach()
    # of those that are left out, the one that shows most
    cut = measure.kthvalue(len(rows) - count).values
    whole = measure.kthvalue(len(rows) + 1 - math.ceil(_WHOLE * count)).values.minimum(cut * (1.0 + _FADE))
    if soft and whole > cut:
        fade = ((measure - cut) / (whole - cut)).clamp(0.0, 1.0)
        out[rows] = shown * fade * fade * (3.0 - 2.0 * fade)
    else:
        # of equal ones, the first
        above, equal = measure > cut, measure == cut
        out[rows] = shown * (above | (equal & (equal.cumsum(0) <= count - above.sum())))
    return out


def _visibility(gaussians: Gaussians, camera: Camera) -> Float[Tensor, " n"]:
    """Opacity times area on the screen, up to a constant: of the two longest axes, at the Gaussian's depth."""
    viewmat = camera.viewmat.to(gaussians.means)
    z = (gaussians.means @ viewmat[2, :3] + viewmat[2, 3]).clamp_min(NEAR_PLANE)
    longest = gaussians.scales.sort(-1).values
    return (gaussians.opacities * (longest[:, 2] / z) * (longest[:, 1] / z)).detach()


def _compiled(gaussians: Gaussians) -> bool:
    """Whether the compiled kernels apply."""
    tensors = (gaussians.means, gaussians.scales, gaussians.opacities, gaussians.decay)
    return all(t is None or (t.device.type == "cpu" and t.dtype == torch.float32) for t in tensors)


def _whole(count: float | int) -> int:
    if not (count >= 1 and count < math.inf and count == math.floor(count)):
        raise ValueError(f"the budget is {count} Gaussians; it must be a whole number of at least 1.")
    return int(count)
