"""Changes between neighbouring frames as s_v rises, and as the camera goes away."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, DistanceDecay, Reference
from freqgs_plugin.reports.drawing import HeldOutView, TrainedRun, draw
from freqgs_plugin.reports.experiments.lab import LoadedRun
from freqgs_plugin.reports.experiments.measures import Changes, at_scale, changes, neighbours
from freqgs_plugin.reports.experiments.training import DEFAULT_SCALE
from freqgs_plugin.reports.tables import psnr
from freqgs_plugin.types import Camera, Gaussians

REFERENCES: tuple[Reference, ...] = ("scene", "frustum_max", "frustum_quantile")
DEFAULT = "soft, scene"
SWITCH = "two models, switched halfway"
CAMERA = "nothing fades"
HELD_SCALE = (1 + DEFAULT_SCALE) / 2
"""s_v along the dolly"""
PATHS = {
    "sweep": f"s_v from 1 to {DEFAULT_SCALE:g}, fixed camera",
    "dolly": f"dolly at s_v {HELD_SCALE:g}",
    "fading": f"dolly at s_v {HELD_SCALE:g}, fading alone",
}


@dataclass(frozen=True)
class Given:
    """Weights that are known already."""

    weight: Tensor

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        return self.weight


def variants(run: LoadedRun) -> dict[str, Callable[[float], DistanceDecay]]:
    """Name -> attenuation at a scale, for both cuts and all references."""
    distance = at_scale(run, 1.0).scene_distance
    return {
        f"{'soft' if soft else 'hard'}, {reference}": lambda s, soft=soft, reference=reference: DistanceDecay(
            s, reference, distance if reference == "scene" else None, soft
        )
        for soft in (True, False)
        for reference in REFERENCES
    }


def jumps(
    run: LoadedRun,
    models: Sequence[TrainedRun],
    view: HeldOutView,
    cameras: Sequence[Camera],
    steps: int,
    advance: Callable[[int], object] = lambda done: None,
) -> dict[str, Any]:
    """Path -> variant -> changes; PSNR along the sweep; `models` are the finer and the coarser one."""
    scales = torch.linspace(1, DEFAULT_SCALE, steps + 1).tolist()
    target = view.image.to(run.background)
    found: dict[str, Any] = {path: {} for path in PATHS}
    curves: dict[str, list[float]] = {}
    for done, (name, at) in enumerate(variants(run).items(), 1):
        found["sweep"][name], curves[name] = _sweep((_shown(run, view.camera, at(scale)) for scale in scales), target)
        found["dolly"][name] = _record(changes(neighbours(_shown(run, camera, at(HELD_SCALE)) for camera in cameras)))
        found["fading"][name] = _record(changes(fading_alone(run, cameras, at(HELD_SCALE))))
        advance(done)
    found["dolly"][CAMERA] = _record(changes(neighbours(_shown(run, camera) for camera in cameras)))
    fixed = [_shown(model, view.camera) for model in models]
    found["sweep"][SWITCH], curves[SWITCH] = _sweep((fixed[_model(i, len(scales))] for i in range(len(scales))), target)
    found["dolly"][SWITCH], found["fading"][SWITCH] = _switched(models, cameras)
    return {
        "paths": found,
        "psnr": curves,
        "scales": scales,
        "gaussians": {"clodsplat": len(run.gaussians), "models": [len(model.gaussians) for model in models]},
    }


def _switched(models: Sequence[TrainedRun], cameras: Sequence[Camera]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Changes along the camera's way with one model and then the other, and those of the switch alone."""
    which = [models[_model(i, len(cameras))] for i in range(len(cameras))]
    frames = (_shown(model, camera) for model, camera in zip(which, cameras, strict=True))
    alone = (
        (_shown(before, camera), _shown(after, camera)) if before is not after else _still(camera)
        for before, after, camera in zip(which, which[1:], cameras[1:], strict=False)
    )
    return _record(changes(neighbours(frames))), _record(changes(alone))


def fading_alone(
    run: TrainedRun, cameras: Sequence[Camera], attenuation: Attenuation
) -> Iterable[tuple[Tensor, Tensor]]:
    """Each frame with the weights of the frame before, and with its own."""
    weights = [attenuation(run.gaussians, camera) for camera in cameras[:1]]
    for camera in cameras[1:]:
        weights = [weights[-1], attenuation(run.gaussians, camera)]
        before, after = (_shown(run, camera, Given(weight)) for weight in weights)
        yield before, after


def _model(frame: int, count: int) -> int:
    """0 in the first half of the frames, 1 in the second."""
    return int(frame >= count // 2)


def _still(camera: Camera) -> tuple[Tensor, Tensor]:
    """Two frames without a difference."""
    nothing = camera.K.new_zeros(camera.height, camera.width, 3)
    return nothing, nothing


@torch.no_grad()
def _shown(run: TrainedRun, camera: Camera, attenuation: Attenuation | None = None) -> Tensor:
    return draw(run, camera, attenuation).features.clamp(0, 1)


def _sweep(frames: Iterable[Tensor], target: Tensor) -> tuple[dict[str, Any], list[float]]:
    """Changes, and PSNR of every frame."""
    curve: list[float] = []

    def noted() -> Iterable[Tensor]:
        for frame in frames:
            curve.append(psnr(frame, target))
            yield frame

    return _record(changes(neighbours(noted()))), curve


def _record(found: Changes) -> dict[str, Any]:
    names = ("largest", "mean", "median", "largest_by_median", "sudden")
    return {**asdict(found), **{name: getattr(found, name) for name in names}}
