"""Does anything jump as detail falls? Changes from frame to frame, beside a switch between two models (Figure 6)."""

import math
import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from freqgs_plugin.io.init_source import TRANSFORMS, read_frame
from freqgs_plugin.reports.bench.tables import BenchTable, Row
from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.reports.experiments import dolly
from freqgs_plugin.reports.experiments.goals import Goal
from freqgs_plugin.reports.experiments.jumps import CAMERA, DEFAULT, HELD_SCALE, PATHS, SWITCH, jumps, variants
from freqgs_plugin.reports.experiments.lab import Lab, LoadedRun
from freqgs_plugin.reports.experiments.measures import at_scale
from freqgs_plugin.reports.experiments.options import TrialOptions
from freqgs_plugin.reports.experiments.plots import COLOURS, GREY, panels
from freqgs_plugin.reports.experiments.section import Part, Results
from freqgs_plugin.reports.experiments.seeds import mean, shown
from freqgs_plugin.reports.experiments.training import DEFAULT_SCALE, Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BY_MEDIAN, BY_SWITCH = 3.0, 0.1
"""the largest change may be so many times the median one, and this part of the switch's"""
INTRODUCTION = f"""\
Neighbouring frames, compared: the mean absolute difference over pixels and colours, in grey levels of 255. *Sudden* is
the largest excess of a change over the median of the eleven around it, *worst pixel* the largest change of any pixel.
One clodsplat model (s_max {DEFAULT_SCALE:g}), with the soft and the hard cut and the three distance references, beside
two discrete models that are switched halfway: a plain model, and a second one that grew no further once it had as
many Gaussians as clodsplat draws at s_v = {DEFAULT_SCALE:g} (its last growth may go beyond them).

* *sweep*: s_v rises from 1 to {DEFAULT_SCALE:g} in equal steps, seen from the middle held-out view.
* *dolly*: the camera goes away in a straight line, distance growing more than tenfold by equal factors, at s_v =
  {HELD_SCALE:g}. In the demo scene away from the dice; elsewhere on the line through the middle held-out view and what
  it looks at. The camera's own motion changes every frame: *{CAMERA}* shows how much. Where that jumps, too, the camera
  goes through Gaussians: no work of the level of detail.
* *fading alone*: each frame of the dolly against the same frame with the weights of the frame before, so without the
  camera's motion."""


def measure(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
    """All three paths."""
    clod, plain = trial.clod(), trial.plain()

    def do() -> dict[str, Any]:
        views = lab.run(clod).cameras("test")
        fewest = statistics.fmean(_drawn(lab.run(clod), view, DEFAULT_SCALE) for view in views)
        coarse = trial.plain(max_gaussians=max(round(fewest), 1))
        models = [lab.run(plain), lab.run(coarse)]
        run, view = lab.run(clod), views[len(views) // 2]
        if trial.scene.dolly is None:
            cameras = dolly.made_from(run, view.camera, options.frames + 1)
        else:
            frame = read_frame(lab.config_path(clod).parent / TRANSFORMS)
            cameras = [dolly.in_frame(camera, frame, run.background.device) for camera in trial.scene.dolly]
        with lab.progress.task(f"{trial.scene.name}: frames", len(variants(run))) as advance:
            return jumps(run, models, view, cameras, options.frames, advance)

    more: dict[str, Any] = {
        "frames": options.frames, "scale": HELD_SCALE, "coarse": "as many as are drawn at s_max"
    }  # fmt: skip
    if trial.scene.dolly is not None:
        more["way"] = [[round(float(x), 3) for x in camera.centre] for camera in trial.scene.dolly[:: options.frames]]
    return lab.step("pops", [clod, plain], more, do)


def _drawn(run: LoadedRun, view: HeldOutView, scale: float) -> int:
    return int((at_scale(run, scale)(run.gaussians, view.camera) > 0).sum())


def tables(scene: str, results: Results) -> list[BenchTable]:
    """One row per path and variant."""
    rows: list[Row] = []
    for path, title in PATHS.items():
        for name in results[0]["paths"][path]:
            seeds = [result["paths"][path][name] for result in results]
            rows.append({"path": title, "variant": name + (" (default)" if name == DEFAULT else ""), "seeds": seeds})

    def column(name: str, form: str) -> Callable[[Row], str]:
        return lambda row: shown(row["seeds"], lambda s: s[name], form)

    counts = [
        f"{mean(results, get):,.0f}"
        for get in (
            lambda r: r["gaussians"]["clodsplat"],
            lambda r: r["gaussians"]["models"][0],
            lambda r: r["gaussians"]["models"][1],
        )
    ]
    return [
        BenchTable(
            f"clod-pops-{scene}",
            f"{scene}: changes between neighbouring frames, grey levels of 255",
            rows,
            [
                ("path", lambda row: row["path"]),
                ("variant", lambda row: row["variant"]),
                ("largest", column("largest", ".3f")),
                ("median", column("median", ".3f")),
                ("mean", column("mean", ".3f")),
                ("largest / median", column("largest_by_median", ".1f")),
                ("sudden", column("sudden", ".3f")),
                ("worst pixel", column("worst_pixel", ".1f")),
            ],
            f"Gaussians: clodsplat {counts[0]}, the two models {counts[1]} and {counts[2]}. A dash: the median is 0.",
        )
    ]


def goals(scene: str, results: Results) -> list[Goal]:
    """On every path: the default's largest change against its median, and against the switch."""
    found = []
    for path, title in PATHS.items():
        ours = [result["paths"][path][DEFAULT] for result in results]
        largest, median = (mean(ours, lambda s, n=n: s[n]) for n in ("largest", "median"))
        switch = mean(results, lambda r, p=path: r["paths"][p][SWITCH]["largest"])
        found.append(
            change_goal(
                scene, f"{title}: largest change at most {BY_MEDIAN:g} x the median", largest, median, BY_MEDIAN
            )
        )
        text = f"{title}: largest change at most {BY_SWITCH:g} x that of switching models"
        goal = change_goal(scene, text, largest, switch, BY_SWITCH)
        if CAMERA in results[0]["paths"][path]:
            motion = mean(results, lambda r, p=path: r["paths"][p][CAMERA]["largest"])
            goal = replace(goal, figures=f"{goal.figures}; {motion:.3f} where {CAMERA}")
        found.append(goal)
    return found


def change_goal(scene: str, text: str, largest: float, against: float, bound: float) -> Goal:
    """`largest` <= `bound` * `against`; without any change at all the goal is reached."""
    ratio = largest / against if against > 0 else math.inf if largest > 0 else 0.0
    return Goal(scene, text, f"{ratio:.2f} x ({largest:.3f} against {against:.3f})", largest <= bound * against)


def figures(scene: str, results: Results) -> "dict[str, Figure]":
    """Changes and PSNR along the paths, of the first seed."""
    result = results[0]
    figure, axes = panels(2, 2)
    lines = {DEFAULT: (COLOURS[0], "-"), "hard, scene": (COLOURS[1], "--"), "soft, frustum_max": (COLOURS[2], "-")}
    lines |= {SWITCH: ("#000000", "--"), CAMERA: (GREY, ":")}
    for name, (colour, style) in lines.items():
        if name in result["psnr"]:
            axes[0].plot(result["scales"], result["psnr"][name], color=colour, ls=style, lw=1.2, label=name)
        for each, path in zip(axes[1:], PATHS, strict=True):
            if name in result["paths"][path]:
                each.plot(result["paths"][path][name]["each"], color=colour, ls=style, lw=1, label=name)
    axes[0].set(title=PATHS["sweep"], xlabel="s_v", ylabel="PSNR, dB")
    for each, title in zip(axes[1:], PATHS.values(), strict=True):
        each.set(title=title, xlabel="frame", ylabel="change, grey levels")
        each.set_yscale("symlog", linthresh=0.01)
        each.set_ylim(bottom=0)
    axes[2].legend(fontsize=7)
    figure.suptitle(f"{scene}: changes from frame to frame", fontsize=11)
    return {"": figure}


PART = Part("pops", "Does anything pop?", INTRODUCTION, measure, tables, figures, goals)
