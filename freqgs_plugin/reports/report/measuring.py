"""Measures all runs of a report into one record, from which tables, plots and pages are made."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from typing import Any

from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.reports.experiments.progress import Bars
from freqgs_plugin.reports.report.drawn import Subset, full_detail, subsets
from freqgs_plugin.reports.report.health import health
from freqgs_plugin.reports.report.left_out import left_out
from freqgs_plugin.reports.report.options import ReportOptions, command_line
from freqgs_plugin.reports.report.quality import Lpips, lpips_if_there, measure_quality, rmse_of
from freqgs_plugin.reports.report.runs import ReportedRun, spread
from freqgs_plugin.reports.report.training_log import TrainingLog, read_log
from freqgs_plugin.reports.timing import Timing, environment, interleaved

TIMED_VIEWS = 3
"""views, spread over all, that each timed drawing goes through"""
STAGES = 4
"""parts of the whole that the progress bar counts"""


def measure_report(
    runs: Sequence[ReportedRun], warnings: Sequence[str], options: ReportOptions, bars: Bars
) -> tuple[dict[str, Any], list[list[Subset]]]:
    """The record (JSON values but for infinite numbers) and, run by run, the subsets that it describes."""
    load = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
    # a damaged file is told before all the work
    missing = [left_out(of.run.model.level_choice(), of.config.resolve().parent) for of in runs]
    drawn = [_subsets(of, options, bars) for of in runs]
    bars.advance()
    lpips = lpips_if_there(runs[0].run.gaussians.means.device)
    measured = [_qualities(of, each, lpips, bars) for of, each in zip(runs, drawn, strict=True)]
    bars.advance()
    whole = [measure_quality(full_detail(of), of.views, lpips) for of in runs]
    logs = [read_log(of.config.resolve().parent, of.run.config.logging.max_buffer_size) for of in runs]
    bars.advance()
    times = _times([s for each in drawn for s in each], options.rounds, bars)
    bars.advance()
    pixels = _pixels(runs[0].views)
    for points, each in zip(measured, drawn, strict=True):
        for point, subset in zip(points, each, strict=True):
            point.update(_time_of(times[id(subset)], pixels))
    record = {
        **environment(),
        "command": command_line(options, tuple(of.name for of in runs)),
        "rounds": options.rounds,
        "load": load,
        "lpips": "computed" if lpips is not None else "not computed",
        "warnings": [*warnings, *_busy(load)],
        "views": _views(runs, pixels),
        "runs": [
            {
                **of.facts(),
                "series": _series(each, points),
                "full": full,
                "training": _training(of, full, log),
                "health": health(of.run, full["clamped"], log),
                "left_out": rows,
            }
            for of, each, points, full, log, rows in zip(runs, drawn, measured, whole, logs, missing, strict=True)
        ],
    }
    return record, drawn


def _busy(load: float | None) -> list[str]:
    cores = os.cpu_count() or 1
    if load is None or load <= cores:
        return []
    return [f"The machine was busy (load {load:g} on {cores} cores): milliseconds are too long, and compare badly."]


def _subsets(of: ReportedRun, options: ReportOptions, bars: Bars) -> list[Subset]:
    count = of.run.model.num_train_data if of.kind == "shares" else None
    with bars.task(f"{of.name}: choosing", count) as done:
        seen = [0]

        def tick() -> None:
            seen[0] += 1
            done(seen[0])

        return subsets(of, options, tick)


def _qualities(of: ReportedRun, each: Sequence[Subset], lpips: Lpips | None, bars: Bars) -> list[dict[str, Any]]:
    found = []
    with bars.task(f"{of.name}: errors", len(each)) as done:
        for number, subset in enumerate(each, start=1):
            found.append(measure_quality(subset, of.views, lpips))
            done(number)
    return found


def _times(each: Sequence[Subset], rounds: int, bars: Bars) -> dict[int, Timing]:
    """Milliseconds per picture: every round draws the timed views with each subset in turn."""

    def drawing(subset: Subset) -> Callable[[], object]:
        cameras = [subset.of.views[i].camera for i in _timed(subset.of.views)]
        return lambda: [subset.draw(camera) for camera in cameras]

    with bars.task("render times", rounds) as done:
        finished = [0]

        def on_round() -> None:
            finished[0] += 1
            done(finished[0])

        times = interleaved({str(id(s)): drawing(s) for s in each}, rounds, warmup=1, on_round=on_round)
    pictures = len(_timed(each[0].of.views))
    return {
        int(key): Timing(t.median_ms / pictures, t.low_ms / pictures, t.high_ms / pictures, t.repeats)
        for key, t in times.items()
    }


def _timed(views: Sequence[HeldOutView]) -> list[int]:
    return spread(len(views), TIMED_VIEWS)


def _pixels(views: Sequence[HeldOutView]) -> float:
    """Of a timed picture, mean."""
    sizes = [views[i].camera.width * views[i].camera.height for i in _timed(views)]
    return sum(sizes) / len(sizes)


def _time_of(timing: Timing, pixels: float) -> dict[str, Any]:
    return {"render": asdict(timing), "ms_per_megapixel": timing.median_ms / pixels * 1e6}


def _views(runs: Sequence[ReportedRun], pixels: float) -> dict[str, Any]:
    views = runs[0].views
    return {
        "names": [view.name for view in views],
        "held_out": runs[0].held_out,
        "measured": len(views),
        "timed": len(_timed(views)),
        "pixels": pixels,
        "sizes": sorted({(view.camera.width, view.camera.height) for view in views}),
    }


def _series(each: Sequence[Subset], points: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    pairs = zip(each, points, strict=True)
    return [
        {"name": name, "points": [dict(point) for _, point in group]}
        for name, group in groupby(pairs, key=lambda pair: pair[0].series)
    ]


def _training(of: ReportedRun, full: Mapping[str, Any], log: TrainingLog) -> dict[str, Any]:
    """Error against training time; the last point is the checkpoint, measured here, where the views are the same."""
    points = [{**vars(e), "source": "log"} for e in log.evaluations]
    every_view = len(of.views) == of.held_out
    if log.evaluations and every_view and log.seconds is not None and log.last_step == of.run.step:
        points = [point for point in points if point["step"] != of.run.step]
        end = {"psnr": full["psnr"], "ssim": full["ssim"], "source": "checkpoint"}
        points.append({"step": of.run.step, "seconds": log.seconds, **end})
    errors = [{**point, "rmse": rmse_of(point["psnr"]), "1-ssim": 1 - point["ssim"]} for point in points]
    return {"points": errors, "seconds": log.seconds, "missing": log.missing, "pauses": list(log.pauses)}
