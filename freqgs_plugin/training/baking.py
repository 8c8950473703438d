"""From signed Gaussians, or those that fade with distance, to plain ones that any 3DGS viewer draws the same way.

Signed residuals are colours in [-1, inf). Where such a colour is not negative, harmonics exist of which it is the plain
colour, exactly (`unsigned`); where it is, viewers draw 0. What then differs is optimised away against our own pictures
of the scene (`bake`), by opacities too: a black Gaussian darkens what is behind it, as a negative one does.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from freqgs_plugin.functional.harmonics import C0
from freqgs_plugin.functional.image_loss import image_distance, mean_square_as_shown
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.rendering.render import shade
from freqgs_plugin.types import Camera, Gaussians

Picture = Callable[[Camera], Float[Tensor, "h w 3"]]
"""our own picture of a view, not clamped"""
OnStep = Callable[[int, float], object]
"""called after each step with the number of steps done and the best PSNR so far, dB"""

_RATES = {"features_dc": 0.01, "features_rest": 0.002, "opacities": 0.025, "scales": 0.0025, "quats": 0.0005}
"""Adam's learning rates of raw parameters"""
_MEANS_RATE = 1.5e-4
"""the same for centres, as a share of the distance between neighbouring cameras"""
_WARM_UP = 20
_SMALL = 0.5
"""share of the steps, the first ones, that draw pictures of half the size"""
_CHECKS = 6
"""how often the best so far is looked for"""
_CHECK_VIEWS = 6
_SHIFT = 0.5
"""standard deviation of the jittered cameras' places, as a share of the distance between neighbours"""
_TURN = math.radians(3.0)
"""standard deviation of the jittered cameras' turns, radians"""


def signed_refusal(levels: int, kind: str = "ply") -> str:
    """Why a scene with signed residuals is not written as plain Gaussians, and what to do to have that format."""
    return (
        f"this scene has {levels} levels with signed residual colours (in [-1, inf)). A 3DGS PLY cannot hold them: "
        "viewers clamp each Gaussian's colour at 0, and the picture would be wrong. Bake them into plain colours with "
        f"`freqgs export --format {kind} --bake`, which states what that loses; or train with "
        "`--pipeline.model.signed-residuals False` to export a scene of several levels as it is."
    )


@dataclass(frozen=True)
class BakeOptions:
    """How plain Gaussians are optimised."""

    steps: int = 400
    seed: int = 0
    small: float = _SMALL
    """share of the steps, the first ones, that draw pictures of half the size"""


@dataclass(frozen=True)
class Baked:
    """Plain Gaussians and how they came about."""

    gaussians: Gaussians
    steps: int
    """steps taken"""
    best_step: int
    """the step whose result this is; 0: the start"""
    start_psnr: float
    """of the start against our own pictures of training views, dB"""
    psnr: float
    """the same of the result, dB"""
    seconds: float
    interrupted: bool
    """stopped by the user before all steps were taken"""


def unsigned(gaussians: Gaussians) -> Gaussians:
    """The same with plain colours, exact where a signed colour is in [0, inf): negative ones become 0.

    A colour above level 1 is 2 (SH + 0.5) - 1 = (2 SH - 0.5) + 0.5.
    """
    if not gaussians.signed_residuals:
        return gaussians
    residual = gaussians.level > 1
    dc, rest = gaussians.features_dc, gaussians.features_rest
    return replace(
        gaussians,
        features_dc=torch.where(residual[:, None], 2 * dc - 0.5 / C0, dc),
        features_rest=torch.where(residual[:, None, None], 2 * rest, rest),
        signed_residuals=False,
    )


def bake(
    start: Gaussians,
    picture: Picture,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    background: Float[Tensor, " 3"],
    *,
    antialiased: bool,
    options: BakeOptions = BakeOptions(),
    on_step: OnStep = lambda done, best: None,
) -> Baked:
    """Plain Gaussians whose pictures come close to `picture`, from `start` on.

    Seen are `cameras` and, every other step, copies of them that are moved and turned a little. An interrupt
    (KeyboardInterrupt) ends it early: the best so far is returned, and the start is one of those.

    Args:
        start: Gaussians with plain colours.
        picture: our own picture, which is to be matched.
        cameras: training views.
        rasterizer: differentiable.
        background: colour behind everything.
        antialiased: whether the viewer that draws the result compensates opacities.
        options: length, seed, what learns.
        on_step: for a progress bar.

    Raises:
        ValueError: signed Gaussians, no cameras, a negative number of steps, or values that are not finite.
    """
    _check(start, cameras, options)
    begun = time.perf_counter()
    scene = _Learning(start, _neighbour_distance(cameras), options)

    def shown(gaussians: Gaussians, camera: Camera) -> Tensor:
        splats = shade(gaussians, camera)
        return rasterizer(splats, camera, background=background, antialiased=antialiased, depth=False).features

    @torch.no_grad()
    def score(gaussians: Gaussians) -> float:
        squares = [mean_square_as_shown(shown(gaussians, c), picture(c).clamp(0, 1)) for c in _spread(cameras)]
        return sum(-10 * math.log10(max(float(square), 1e-12)) for square in squares) / len(squares)

    best, best_step = start, 0
    best_psnr = start_psnr = score(start)
    done, interrupted = 0, False
    try:
        for camera in _schedule(cameras, options):
            with torch.no_grad():
                target = picture(camera).clamp(0, 1)
            scene.step(done, lambda g, camera=camera, target=target: _distance(shown(g, camera), target))
            done += 1
            if done == options.steps or done % max(options.steps // _CHECKS, 1) == 0:
                found = score(scene.gaussians())
                if found > best_psnr:
                    best, best_step, best_psnr = scene.frozen(), done, found
            on_step(done, best_psnr)
    except KeyboardInterrupt:
        interrupted = True
    return Baked(best, done, best_step, start_psnr, best_psnr, time.perf_counter() - begun, interrupted)


class _Learning:
    """Raw parameters with an optimizer."""

    def __init__(self, start: Gaussians, near: float, options: BakeOptions):
        self._start, self._steps = start, options.steps
        opacities = start.opacities.clamp(1e-4, 1 - 1e-4)
        raw = {
            "means": start.means,
            "quats": start.quats,
            "scales": start.scales.log(),
            "opacities": opacities.logit(),
            "features_dc": start.features_dc,
            "features_rest": start.features_rest,
        }
        rates = {**_RATES, "means": _MEANS_RATE * near}
        self._raw = {name: value.detach().clone().requires_grad_(rates[name] > 0) for name, value in raw.items()}
        groups = [{"params": [self._raw[name]], "lr": 0.0, "rate": rate} for name, rate in rates.items() if rate > 0]
        self._optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)

    def gaussians(self) -> Gaussians:
        raw = self._raw
        return replace(
            self._start,
            means=raw["means"],
            quats=raw["quats"],
            scales=raw["scales"].exp(),
            opacities=raw["opacities"].sigmoid(),
            features_dc=raw["features_dc"],
            features_rest=raw["features_rest"],
        )

    def frozen(self) -> Gaussians:
        """A copy of what is learnt so far; what does not learn is the start's, bit for bit."""
        with torch.no_grad():
            now = self.gaussians()
        learnt = {name: getattr(now, name).detach().clone() for name, x in self._raw.items() if x.requires_grad}
        return replace(self._start, **learnt)

    def step(self, number: int, loss_of: Callable[[Gaussians], Tensor]) -> None:
        """One step of Adam; rates rise for a few steps, and fall along a cosine."""
        factor = min((number + 1) / _WARM_UP, 0.5 + 0.5 * math.cos(math.pi * number / self._steps))
        for group in self._optimizer.param_groups:
            group["lr"] = group["rate"] * factor
        loss = loss_of(self.gaussians())
        if not bool(torch.isfinite(loss)):
            raise ValueError(f"step {number} has a loss that is not finite; bake with another --seed.")
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()


def _distance(shown: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    return image_distance(shown.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])


def _check(start: Gaussians, cameras: Sequence[Camera], options: BakeOptions) -> None:
    if start.signed_residuals and bool((start.level > 1).any()):
        raise ValueError("baking starts from plain colours; call `unsigned` first.")
    if not cameras:
        raise ValueError("baking needs training views, and the run has none.")
    if options.steps < 0:
        raise ValueError(f"bake steps are {options.steps}; give 0 (only convert colours) or more.")
    for name in ("means", "quats", "scales", "opacities", "features_dc", "features_rest"):
        values = getattr(start, name)
        bad = int((~torch.isfinite(values)).reshape(len(values), -1).any(-1).sum())
        if bad:
            raise ValueError(f"{name} of {bad} of {len(values)} Gaussians are not finite; leave these Gaussians out.")


def _schedule(cameras: Sequence[Camera], options: BakeOptions):
    """The camera of each step: all in random order, again and again, every second one jittered; small ones first."""
    generator = torch.Generator().manual_seed(options.seed)
    shift, order = _SHIFT * _neighbour_distance(cameras), []
    for number in range(options.steps):
        order = order or torch.randperm(len(cameras), generator=generator).tolist()
        camera = cameras[order.pop()]
        if number % 2:
            camera = _jittered(camera, shift, generator)
        yield _halved(camera) if number < options.small * options.steps else camera


def _jittered(camera: Camera, shift: float, generator: torch.Generator) -> Camera:
    turn = _TURN * torch.randn(3, generator=generator)
    move = np.eye(4)
    move[:3, :3] = Rotation.from_rotvec(turn.numpy()).as_matrix()
    move[:3, 3] = shift * torch.randn(3, generator=generator).numpy()
    return replace(camera, viewmat=torch.from_numpy(move).to(camera.viewmat) @ camera.viewmat)


def _halved(camera: Camera) -> Camera:
    """The same view in about half as many rows and columns; at least 16 px."""
    width, height = max(camera.width // 2, 16), max(camera.height // 2, 16)
    factors = camera.K.new_tensor([width / camera.width, height / camera.height, 1.0])
    return Camera(camera.viewmat, camera.K * factors[:, None], width, height)


def _neighbour_distance(cameras: Sequence[Camera]) -> float:
    """World units: the median over all cameras of how far the next one is; of a single camera 0.1."""
    centres = torch.stack([camera.centre for camera in cameras]).double()
    if len(cameras) < 2:
        return 0.1
    distances = torch.cdist(centres, centres).fill_diagonal_(math.inf)
    return float(distances.min(1).values.median()) or 0.1


def _spread(cameras: Sequence[Camera]) -> list[Camera]:
    """A few, evenly spread over all."""
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(_CHECK_VIEWS, len(cameras))).round().astype(int))
    return [cameras[i] for i in chosen]
