"""Learned decays against a plain model at equal counts, and at full detail."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from freqgs_plugin.functional.budget import DecayBudget, LevelBudget, decay_scale, in_view
from freqgs_plugin.reports.bench.tables import BenchTable, Row
from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.reports.experiments.goals import Goal
from freqgs_plugin.reports.experiments.lab import Lab, LoadedRun
from freqgs_plugin.reports.experiments.measures import at_scale, quality
from freqgs_plugin.reports.experiments.options import TrialOptions
from freqgs_plugin.reports.experiments.plots import COLOURS, GREY, panels
from freqgs_plugin.reports.experiments.section import Part, Results
from freqgs_plugin.reports.experiments.seeds import mean, shown
from freqgs_plugin.reports.experiments.selection import MostOpaque, SharedDecay
from freqgs_plugin.reports.experiments.training import DEFAULT_SCALE, Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHARES = (1.0, 0.75, 0.5, 0.35, 0.25, 0.15, 0.1)
OURS = {"s_v": "clodsplat", "held": "clodsplat, s_v at most s_max"}
OTHERS = {"opacity": "plain, most opaque", "shared": "plain, shared sigma", "chosen": "plain, chosen by shared sigma"}
BESIDES = {"shows": "plain, those that show most"}
"""drawn for comparison; no goal asks for it"""
DECAYS = (1.25, 5.0, 20.0, 80.0, 320.0)
"""shared sigmas that are tried; the best one counts"""
GAIN_AT, GAIN = 0.25, 1.0
"""share at which both others are to be beaten by so many dB"""
LOSS, FEWER = 0.1, 0.75
"""dB that full detail may lose against the plain model, with at most this share of its Gaussians"""

INTRODUCTION = f"""\
One clodsplat model (s_max {DEFAULT_SCALE:g}) against a plain model of the same run length, at equal counts. For every
held-out view, 100 % is the smaller of the numbers of Gaussians that both models have in view; each column draws the
same number of Gaussians of that view.

* *clodsplat*: s_v is raised until so many are drawn, however far that is.
* *clodsplat, s_v at most s_max*: what a budget does in the viewer. Where s_max draws more, those that show most stay.
* *plain, most opaque*: the plain model's most opaque Gaussians in view.
* *plain, shared sigma*: the same attenuation with one sigma for all Gaussians, and s_v from the count. Of several
  sigmas (1.25 to 320) the one with the best PSNR on these views counts, at each share anew. The larger it is, the
  less distance matters: with the largest one it is *most opaque*, hardly dimmed.
* *plain, chosen by shared sigma*: Gaussians that are chosen so, with their own opacities; at small counts the formula
  dims the picture.
* *plain, those that show most*: by opacity times area on the screen, which is how *s_v at most s_max* chooses beyond
  s_max. It tells how much of that row's gain is the choice, and how much the training."""


def measure(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
    """Both models, loaded together."""
    clod, plain = trial.clod(), trial.plain()
    return lab.step(
        "budget",
        [clod, plain],
        {"shares": SHARES, "decays": DECAYS, "ways": [*OURS, *OTHERS, *BESIDES]},
        lambda: compare(lab.run(clod), lab.run(plain), DEFAULT_SCALE),
    )


def compare(clod: LoadedRun, plain: LoadedRun, largest: float) -> dict[str, Any]:
    """PSNR, SSIM and counts at every share and at full detail."""
    views = clod.cameras("test")
    whole = [_common(clod, plain, view) for view in views]
    return {
        "full": {
            "clod": {"gaussians": len(clod.gaussians), **asdict(quality(clod, views, lambda _: at_scale(clod, 1.0)))},
            "plain": {"gaussians": len(plain.gaussians), **asdict(quality(plain, views))},
        },
        "shares": [_at_share(clod, plain, views, whole, share, largest) for share in SHARES],
    }


def _common(clod: LoadedRun, plain: LoadedRun, view: HeldOutView) -> int:
    """Gaussians in view of the model that has fewer of them."""
    everything = decay_scale(clod.gaussians, view.camera, len(clod.gaussians) + 1, "scene", clod.scene_distance).drawn
    return max(min(everything, int(in_view(plain.gaussians, view.camera).sum())), 1)


def _at_share(
    clod: LoadedRun, plain: LoadedRun, views: Sequence[HeldOutView], whole: list[int], share: float, largest: float
) -> dict[str, Any]:
    counts = [max(round(share * count), 1) for count in whole]
    distance = clod.scene_distance
    assert distance is not None
    free = [DecayBudget(count, scene_distance=distance) for count in counts]
    held = [DecayBudget(count, scene_distance=distance, largest=largest) for count in counts]
    opaque = [MostOpaque(count) for count in counts]
    most_shown = [LevelBudget(count, soft=False) for count in counts]
    ways = {"s_v": (clod, free), "held": (clod, held), "opacity": (plain, opaque), "shows": (plain, most_shown)}
    measured = {name: asdict(quality(run, views, each.__getitem__)) for name, (run, each) in ways.items()}
    for name, fade in (("shared", True), ("chosen", False)):
        tried = []
        for decay in DECAYS:
            shared = [SharedDecay(count, decay, distance, fade) for count in counts]
            tried.append({"decay": decay, **asdict(quality(plain, views, shared.__getitem__))})
        measured[name] = max(tried, key=lambda row: row["psnr"])
    scales = [budget.scale(clod.gaussians, view.camera) for budget, view in zip(free, views, strict=True)]
    return {"share": share, "count": statistics.fmean(counts), "scale": statistics.fmean(scales), **measured}


def margin(row: dict[str, Any], ours: str) -> float:
    """dB by which `ours` is above the best of the others."""
    return row[ours]["psnr"] - max(row[name]["psnr"] for name in OTHERS)


def tables(scene: str, results: Results) -> list[BenchTable]:
    """PSNR by share, and full detail."""
    rows: list[Row] = [
        {"share": share, "seeds": [result["shares"][i] for result in results]} for i, share in enumerate(SHARES)
    ]
    names = {**OURS, **OTHERS, **BESIDES}
    by_share = BenchTable(
        f"clod-budget-{scene}",
        f"{scene}: PSNR at equal counts, dB",
        rows,
        [
            ("share", lambda row: f"{100 * row['share']:.0f} %"),
            ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["count"], ",.0f")),
            ("s_v", lambda row: shown(row["seeds"], lambda s: s["scale"])),
            *((title, lambda row, n=n: shown(row["seeds"], lambda s: s[n]["psnr"])) for n, title in names.items()),
            ("shared sigma", lambda row: shown(row["seeds"], lambda s: s["shared"]["decay"], "g")),
            ("margin", lambda row: shown(row["seeds"], lambda s: margin(s, "s_v"), "+.2f")),
            ("margin, s_v at most s_max", lambda row: shown(row["seeds"], lambda s: margin(s, "held"), "+.2f")),
        ],
        "Gaussians and s_v (of *clodsplat*) are means over views. *Margin*: above the best of the first three plain "
        "columns.",
    )
    plain = [result["full"]["plain"]["gaussians"] for result in results]
    full: list[Row] = [
        {
            "model": name,
            "seeds": [
                {**result["full"][name], "share": result["full"][name]["gaussians"] / all_of_plain}
                for result, all_of_plain in zip(results, plain, strict=True)
            ],
        }
        for name in ("plain", "clod")
    ]
    at_full = BenchTable(
        f"clod-full-{scene}",
        f"{scene}: full detail",
        full,
        [
            ("model", lambda row: {"plain": "plain", "clod": f"clodsplat, s_max {DEFAULT_SCALE:g}"}[row["model"]]),
            ("PSNR, dB", lambda row: shown(row["seeds"], lambda s: s["psnr"])),
            ("SSIM", lambda row: shown(row["seeds"], lambda s: s["ssim"], ".4f")),
            ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["gaussians"], ",.0f")),
            ("of plain", lambda row: shown(row["seeds"], lambda s: s["share"], ".3f")),
        ],
    )
    return [by_share, at_full]


def goals(scene: str, results: Results) -> list[Goal]:
    """The gain at a quarter, no loss at any share, and full detail with fewer Gaussians."""
    found = []
    for ours, title in OURS.items():
        margins = [mean([r["shares"][i] for r in results], lambda s, o=ours: margin(s, o)) for i in range(len(SHARES))]
        at, worst = margins[SHARES.index(GAIN_AT)], min(margins)
        where = SHARES[margins.index(worst)]
        text = f"{title}: at least {GAIN:g} dB above both selections of a plain model at {100 * GAIN_AT:.0f} %"
        found.append(Goal(scene, text, f"{at:+.2f} dB", at >= GAIN))
        text = f"{title}: never below either at any share"
        found.append(Goal(scene, text, f"least {worst:+.2f} dB, at {100 * where:.0f} %", worst >= 0))
    found.append(full_detail_goal(scene, results))
    return found


def full_detail_goal(scene: str, results: Results) -> Goal:
    """At most `LOSS` dB under the plain model with at most `FEWER` of its Gaussians."""
    gain = mean(results, lambda r: r["full"]["clod"]["psnr"] - r["full"]["plain"]["psnr"])
    share = mean(results, lambda r: r["full"]["clod"]["gaussians"] / r["full"]["plain"]["gaussians"])
    reached = gain >= -LOSS and share <= FEWER and not math.isnan(share)
    return Goal(
        scene,
        f"full detail: at most {LOSS:g} dB under plain with at most {FEWER:g} of its Gaussians",
        f"{gain:+.2f} dB with {share:.3f}",
        reached,
    )


def figures(scene: str, results: Results) -> "dict[str, Figure]":
    """PSNR by share for all ways to choose."""
    figure, axes = panels(1, width=7.5, height=4.4)
    colours = {
        "s_v": COLOURS[0],
        "held": COLOURS[1],
        "opacity": COLOURS[6],
        "shared": GREY,
        "chosen": COLOURS[4],
        "shows": COLOURS[2],
    }
    for name, title in {**OURS, **OTHERS, **BESIDES}.items():
        y = [mean([r["shares"][i] for r in results], lambda s, n=name: s[n]["psnr"]) for i in range(len(SHARES))]
        dashed = "-" if name in OURS else "--"
        axes[0].plot([100 * s for s in SHARES], y, color=colours[name], marker="o", ms=4, ls=dashed, label=title)
    axes[0].set(xlabel="Gaussians of each view, %", ylabel="PSNR, dB", title=f"{scene}: equal counts")
    axes[0].legend(fontsize=8)
    return {"": figure}


PART = Part("budget", "Against a plain model at equal counts", INTRODUCTION, measure, tables, figures, goals)
