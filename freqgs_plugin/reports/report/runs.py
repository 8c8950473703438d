"""The runs of a report: loaded, named, and known to show the same held-out views."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from freqgs_plugin.functional.cost import bytes_per_gaussian
from freqgs_plugin.reports.bench.options import BenchError
from freqgs_plugin.reports.bench.trained import load, views_of_split
from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.reports.report.options import ReportError

Kind = Literal["prefixes", "scales", "shares"]
"""what is measured of a run: prefixes of its levels, a sweep of s_v, or cuts of a model of one level"""


@dataclass(frozen=True)
class ReportedRun:
    """A loaded run, and what is measured of it."""

    name: str
    run: Any
    """`studio.checkpoint.Run`"""
    config: Path
    views: list[HeldOutView]
    """held out, those that are measured"""
    held_out: int
    """views in all"""
    kind: Kind

    @property
    def bytes_each(self) -> int:
        """Bytes of one Gaussian's float32 parameters, as budgets count them."""
        g = self.run.gaussians
        return bytes_per_gaussian("memory", round((g.features_rest.shape[1] + 1) ** 0.5) - 1, g.decay is not None)

    def facts(self) -> dict[str, Any]:
        """What the run is, for the record."""
        config, model = self.run.config, self.run.config.pipeline.model
        return {
            "name": self.name,
            "kind": self.kind,
            "method": config.method_name,
            "config": str(self.config.resolve()),
            "steps": config.max_num_iterations,
            "checkpoint_step": self.run.step,
            "seeds": {"machine": config.machine.seed, "model": model.seed},
            "levels": self.run.num_levels,
            "gaussians": len(self.run.gaussians),
            "bytes_each": self.bytes_each,
            "rasterizer": self.run.rasterizer.name,
        }


def open_runs(
    paths: Sequence[Path], names: Sequence[str], most_views: int | None
) -> tuple[list[ReportedRun], list[str]]:
    """Load every run; also what a reader must be warned of.

    Raises:
        ReportError: one cannot be loaded, holds no view out, or shows other views than the first.
        OSError: a file is not there.
    """
    loaded = [_open(path) for path in paths]
    held_out = [_held_out(run, path) for run, path in zip(loaded, paths, strict=True)]
    _check_same(held_out, paths)
    warnings = _trained_on(loaded, held_out, paths)
    kinds: list[Kind] = [_kind(run) for run in loaded]
    names = names or _names(loaded, kinds, paths)
    count = len(held_out[0])
    kept = spread(count, count if most_views is None else most_views)
    runs = [
        ReportedRun(name, run, path, [views[i] for i in kept], count, kind)
        for name, run, path, views, kind in zip(names, loaded, paths, held_out, kinds, strict=True)
    ]
    if len({item.run.config.max_num_iterations for item in runs}) > 1:
        lengths = ", ".join(f"{item.name} {item.run.config.max_num_iterations:,}" for item in runs)
        warnings.append(f"The runs were trained for different numbers of steps: {lengths}.")
    for item in runs:
        if getattr(item.run.config.pipeline.model, "use_decay", False) and item.kind == "shares":
            warnings.append(f"{item.name} ended before its opacities began to decay; it is measured as a plain model.")
    return runs, warnings


def spread(count: int, most: int) -> list[int]:
    """At most `most` numbers of 0..count - 1, evenly spread; the first is among them."""
    if most >= count:
        return list(range(count))
    return sorted({round(i * (count - 1) / max(most - 1, 1)) for i in range(most)})


def _open(path: Path) -> Any:
    try:
        run = load(path)
        with torch.no_grad():
            if len(run.gaussians) == 0:
                raise ReportError(f"the run {path} has no Gaussians left; there is nothing to report on.")
        return run
    except BenchError as error:
        known = str(path) in str(error) or str(path.parent) in str(error)
        raise ReportError(str(error) if known else f"the run {path} cannot be loaded: {error}") from error


def _held_out(run: Any, path: Path) -> list[HeldOutView]:
    views = views_of_split(run, "test")
    if not views:
        raise ReportError(
            f"the run {path} holds no view out, so no error can be told. Train with a split that does, for example "
            "`colmap --eval-mode interval --eval-interval 8`."
        )
    return views


def _check_same(held_out: Sequence[Sequence[HeldOutView]], paths: Sequence[Path]) -> None:
    """Errors compare only over the same photographs at the same size."""
    first = [_fingerprint(view) for view in held_out[0]]
    for views, path in zip(held_out[1:], paths[1:], strict=True):
        if [_fingerprint(view) for view in views] != first:
            raise ReportError(
                f"{path} and {paths[0]} hold different views out ({_described(views)}; {_described(held_out[0])}): "
                "errors over different pictures cannot be compared. Report on each by itself, or train both on the "
                "same scene with the same split and image size."
            )


def _fingerprint(view: HeldOutView) -> str:
    """Changes with the photograph: size and 8-bit colours."""
    picture = (view.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    return hashlib.sha256(repr(picture.shape).encode() + np.ascontiguousarray(picture).tobytes()).hexdigest()


def _described(views: Sequence[HeldOutView]) -> str:
    names = ", ".join(view.name for view in views[:3]) + (" ..." if len(views) > 3 else "")
    return f"{len(views)} of {views[0].camera.width}x{views[0].camera.height} px: {names}"


def _trained_on(runs: Sequence[Any], held_out: Sequence[Sequence[HeldOutView]], paths: Sequence[Path]) -> list[str]:
    """Warnings about runs that were trained on what they are measured on, or on other views than the first."""
    warnings, first = [], None
    for run, views, path in zip(runs, held_out, paths, strict=True):
        trained = {_fingerprint(view) for view in views_of_split(run, "train")}
        both = sum(_fingerprint(view) in trained for view in views)
        if both:
            warnings.append(
                f"{path.parent.name}: {both} of its {len(views)} evaluation views were trained on; errors there are "
                "errors of fitting, not held-out ones."
            )
        if first is not None and trained != first:
            warnings.append(f"{path.parent.name} was trained on other views than {paths[0].parent.name}.")
        first = trained if first is None else first
    return warnings


def _kind(run: Any) -> Kind:
    if run.gaussians.decay is not None and run.scene_distance is not None:
        return "scales"
    return "prefixes" if run.num_levels > 1 else "shares"


def _names(runs: Sequence[Any], kinds: Sequence[Kind], paths: Sequence[Path]) -> list[str]:
    """The method, or plain; with the run's folder where that is not enough."""
    short = ["plain" if kind == "shares" else run.config.method_name for run, kind in zip(runs, kinds, strict=True)]
    often = Counter(short)
    named = [s if often[s] == 1 else f"{s} {path.resolve().parent.name}" for s, path in zip(short, paths, strict=True)]
    often = Counter(named)
    return [n if often[n] == 1 else f"{n} ({i})" for i, n in enumerate(named, start=1)]
