"""What lapsplat's own settings are to reach against plain models: of the whole, and of each prefix at its own size."""

import statistics
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.reports.drawing import draw
from freqgs_plugin.reports.experiments.claims import of_runs
from freqgs_plugin.reports.experiments.goals import Goal
from freqgs_plugin.reports.experiments.lab import Lab, LoadedRun
from freqgs_plugin.reports.experiments.options import TrialOptions
from freqgs_plugin.reports.experiments.section import Results
from freqgs_plugin.reports.experiments.seeds import mean, shown
from freqgs_plugin.reports.experiments.training import Training, Trial
from freqgs_plugin.reports.tables import psnr, reduced_psnr
from freqgs_plugin.training.presets import Value, plain_at
from freqgs_plugin.types import Camera

GAIN, FEWER = 0.5, 0.6
"""dB above the plain model, with at most this part of its Gaussians"""
BASE = 0.15
"""part of all Gaussians that the base level may have"""
NEAR = 1.0
"""dB that a prefix may be under a plain model that was trained at the prefix's size alone"""
OURS = ("lapsplat", "small base")
"""runs that are judged"""
LEVELS = 3
"""of lapsplat's default"""

INTRODUCTION = f"""\
`lapsplat` with its own settings, and the same with a bounded base (`base-share 0.2`: *small base*), against *plain*
after as many steps; and each prefix against a plain model that was trained for the prefix's size alone, for as many
steps. Of such a model the better of two figures counts: its picture drawn at that size against the photograph averaged
over blocks, as it was trained, or its full picture and the photograph reduced like the prefix's. Goals: {GAIN:g} dB
with at most {FEWER:g} of the Gaussians, a base level of at most {100 * BASE:g} % of them, no prefix more than
{NEAR:g} dB under its own model."""


def alone(trial: Trial, level: int) -> Training:
    """A plain model that is trained at the size of the prefix 1..level and at no other."""
    options: Mapping[str, Value] = plain_at(LEVELS - level)
    return Training(trial.scene, "lapsplat", trial.steps, trial.seed, options)


def measure(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
    """Figures of these runs, and PSNR of the models of one size."""
    names = ("plain", *OURS)
    models = {level: alone(trial, level) for level in range(1, LEVELS)}
    return {
        "runs": of_runs(*names)(lab, trial, options),
        "alone": [
            lab.step("claims-alone", [t], {}, lambda t=t, level=level: at_own_size(lab.run(t), LEVELS - level))
            for level, t in models.items()
        ],
    }


def at_own_size(run: LoadedRun, halvings: int) -> dict[str, Any]:
    """PSNR of the picture drawn `halvings` times smaller, and of the full one, reduced; means over held-out views."""
    small, reduced = [], []
    for view in run.cameras("test"):
        camera = _halved(view.camera, halvings)
        picture = draw(run, camera).features.clamp(0, 1)
        small.append(psnr(picture, _blocks(view.image.to(picture), camera, halvings)))
        full = draw(run, view.camera).features.clamp(0, 1)
        reduced.append(reduced_psnr(full, view.image.to(full), halvings))
    return {"gaussians": len(run.gaussians), "small": statistics.fmean(small), "reduced": statistics.fmean(reduced)}


def _halved(camera: Camera, times: int) -> Camera:
    """The camera of training images that are `times` times halved."""
    factor = 2**times
    scale = camera.K.new_tensor([1 / factor, 1 / factor, 1.0])
    size = (max(side // factor, 1) for side in (camera.width, camera.height))
    return replace(camera, K=camera.K * scale[:, None], **dict(zip(("width", "height"), size, strict=True)))


def _blocks(image: Float[Tensor, "h w 3"], camera: Camera, times: int) -> Float[Tensor, "h2 w2 3"]:
    """Means over blocks, as training images are made."""
    block = min(2**times, *image.shape[:2])
    small = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], block)[0].permute(1, 2, 0)
    return small[: camera.height, : camera.width]


def goals(scene: str, results: Results) -> list[Goal]:
    """Judged by means over seeds."""
    return [goal for name in OURS for goal in _goals_of_run(scene, results, name)]


def _goals_of_run(scene: str, results: Results, name: str) -> list[Goal]:
    def gain(r: Any) -> float:
        return r["runs"][name]["psnr"] - r["runs"]["plain"]["psnr"]

    def share(r: Any) -> float:
        return r["runs"][name]["gaussians"] / r["runs"]["plain"]["gaussians"]

    def base(r: Any) -> float:
        return 100 * r["runs"][name]["counts"][0] / r["runs"][name]["gaussians"]

    of_plain = shown(results, lambda r: base(r) * share(r), ".1f")
    in_base = f"{shown(results, base, '.0f')} % (of plain's {of_plain} %)"
    figures = f"{shown(results, gain, '+.2f')} dB with {shown(results, share)} of the Gaussians"
    better = mean(results, gain) >= GAIN and mean(results, share) <= FEWER
    whole = f"{name}: at least {GAIN:g} dB above plain with at most {FEWER:g} of its Gaussians"
    small = f"{name}: at most {100 * BASE:g} % of the Gaussians in the base"
    if any(len(result["runs"][name]["counts"]) < LEVELS for result in results):
        # photographs too small for levels: there is no base, and no prefix of these sizes
        return [Goal(scene, whole, figures, better)]
    return [
        Goal(scene, whole, figures, better),
        Goal(scene, small, in_base, mean(results, base) <= 100 * BASE),
        *(_prefix_goal(scene, results, name, level) for level in range(1, LEVELS)),
    ]


def _prefix_goal(scene: str, results: Results, name: str, level: int) -> Goal:
    def own(r: Any) -> float:
        return max(r["alone"][level - 1]["small"], r["alone"][level - 1]["reduced"])

    def above(r: Any) -> float:
        return r["runs"][name]["prefixes"][level - 1] - own(r)

    def count(r: Any) -> float:
        return sum(r["runs"][name]["counts"][:level]) / r["alone"][level - 1]["gaussians"]

    return Goal(
        scene,
        f"{name}, prefix {level}: at most {NEAR:g} dB under a plain model of its size",
        f"{shown(results, above, '+.2f')} dB (it has {shown(results, own)} dB) with {shown(results, count)} "
        "of its Gaussians",
        mean(results, above) >= -NEAR,
    )
