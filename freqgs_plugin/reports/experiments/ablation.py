"""The weight w_s and the loss on the count, each on and off, with each gradient (the paper's Table 3)."""

from collections.abc import Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.tables import BenchTable, Row
from freqgs_plugin.reports.experiments.goals import Goal
from freqgs_plugin.reports.experiments.lab import Lab, LoadedRun
from freqgs_plugin.reports.experiments.measures import at_scale, quality
from freqgs_plugin.reports.experiments.options import TrialOptions
from freqgs_plugin.reports.experiments.plots import COLOURS, panels
from freqgs_plugin.reports.experiments.section import Part, Results
from freqgs_plugin.reports.experiments.seeds import mean, shown
from freqgs_plugin.reports.experiments.training import ABLATION_SCALE, Training, Trial, Value

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GRADIENTS = ("off", "none", "ste", "soft")
"""of L_reg; off: it has weight 0"""
LEAST_EFFECT = 0.05
"""share by which the count at s_v = s_max has to fall for the loss to act"""
SCALES = (1.0, ABLATION_SCALE)

INTRODUCTION = f"""\
w_s of Eq. 5 on and off, and L_reg off and on with each of the gradients of its count: `none` is the paper's formula,
whose mask has no gradient; `ste` and `soft` are those of `reg-gradient`. All with s_max = {ABLATION_SCALE:g}, at full
detail and at s_v = {ABLATION_SCALE:g}, means over the held-out views. *Against off*: the count at that s_v, relative to
the row without L_reg. *without decay* is the same method with `use-decay False`."""


def settings(weigh: bool, gradient: str) -> dict[str, Value]:
    """Options of one cell of the table."""
    if gradient == "off":
        return {"weigh_scales": weigh, "reg_weight": 0.0}
    return {"weigh_scales": weigh, "reg_weight": 1.0, "reg_gradient": gradient}


def name_of(weigh: bool, gradient: str) -> str:
    return f"w_s {'on' if weigh else 'off'}, L_reg {gradient}"


def trainings(trial: Trial) -> dict[str, Training]:
    """Name -> run."""
    cells = {
        name_of(weigh, gradient): trial.clod(ABLATION_SCALE, more=settings(weigh, gradient))
        for weigh in (True, False)
        for gradient in GRADIENTS
    }
    return {**cells, "without decay": trial.clod(ABLATION_SCALE, more={"use_decay": False})}


def measure(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
    """Quality and counts of every cell at both scales."""
    return of_cells(lab, trial, trainings(trial))


def of_cells(lab: Lab, trial: Trial, names: Iterable[str]) -> dict[str, Any]:
    """The same of the cells with these names."""
    cells = trainings(trial)
    return {
        name: lab.step("ablation", [cells[name]], {"scales": SCALES}, lambda t=cells[name]: at_both(lab.run(t)))
        for name in names
    }


def at_both(run: LoadedRun) -> dict[str, Any]:
    """`full` and `reduced`; the second is None for a run without decay."""
    views, decays = run.cameras("test"), run.gaussians.decay is not None
    full, reduced = (
        asdict(quality(run, views, (lambda _, s=scale: at_scale(run, s)) if decays else (lambda _: None)))
        for scale in SCALES
    )
    return {"gaussians": len(run.gaussians), "full": full, "reduced": reduced if decays else None}


def effect(result: dict[str, Any], weigh: bool, gradient: str) -> float:
    """Count at s_v = s_max over that without L_reg."""
    return result[name_of(weigh, gradient)]["reduced"]["drawn"] / result[name_of(weigh, "off")]["reduced"]["drawn"]


def tables(scene: str, results: Results) -> list[BenchTable]:
    """One row per cell."""
    rows: list[Row] = []
    for weigh in (True, False):
        for gradient in GRADIENTS:
            seeds = [result[name_of(weigh, gradient)] for result in results]
            against = shown(results, lambda r, w=weigh, g=gradient: effect(r, w, g))
            rows.append({"w_s": "on" if weigh else "off", "L_reg": gradient, "seeds": seeds, "against": against})
    seeds = [result["without decay"] for result in results]
    rows.append({"w_s": "without decay", "L_reg": "-", "seeds": seeds, "against": "-"})

    def reduced(name: str) -> Any:
        return lambda s: None if s["reduced"] is None else s["reduced"][name]

    return [
        BenchTable(
            f"clod-ablation-{scene}",
            f"{scene}: w_s and L_reg",
            rows,
            [
                ("w_s", lambda row: row["w_s"]),
                ("L_reg", lambda row: row["L_reg"]),
                ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["gaussians"], ",.0f")),
                ("PSNR, full", lambda row: shown(row["seeds"], lambda s: s["full"]["psnr"])),
                ("drawn, full", lambda row: shown(row["seeds"], lambda s: s["full"]["drawn"], ",.0f")),
                (f"PSNR, s_v {ABLATION_SCALE:g}", lambda row: shown(row["seeds"], reduced("psnr"))),
                (f"drawn, s_v {ABLATION_SCALE:g}", lambda row: shown(row["seeds"], reduced("drawn"), ",.0f")),
                ("against off", lambda row: row["against"]),
            ],
        )
    ]


def goals(scene: str, results: Results) -> list[Goal]:
    """Does the regulariser act? Once for each gradient, with w_s on as in the paper."""
    found = []
    for gradient in GRADIENTS[1:]:
        change = mean(results, lambda r, g=gradient: effect(r, True, g)) - 1
        text = f"L_reg ({gradient}) acts: at least {100 * LEAST_EFFECT:.0f} % fewer drawn at s_v {ABLATION_SCALE:g}"
        found.append(Goal(scene, text, f"{100 * change:+.1f} %", change <= -LEAST_EFFECT))
    return found


def figures(scene: str, results: Results) -> "dict[str, Figure]":
    """Every cell from full detail to s_v = s_max."""
    figure, axes = panels(1, width=7.5, height=4.4)
    for weigh, style in ((True, "-"), (False, "--")):
        for gradient, colour in zip(GRADIENTS, (COLOURS[6], COLOURS[4], COLOURS[0], COLOURS[2]), strict=True):
            seeds = [result[name_of(weigh, gradient)] for result in results]
            x = [mean(seeds, lambda s, k=k: s[k]["drawn"]) / 1000 for k in ("full", "reduced")]
            y = [mean(seeds, lambda s, k=k: s[k]["psnr"]) for k in ("full", "reduced")]
            axes[0].plot(x, y, style, color=colour, marker="o", ms=4, label=name_of(weigh, gradient))
    axes[0].set(xlabel="Gaussians drawn, thousands", ylabel="PSNR, dB")
    axes[0].set_title(f"{scene}: full detail and s_v = {ABLATION_SCALE:g}")
    axes[0].legend(fontsize=7)
    return {"": figure}


PART = Part("ablation", "w_s and L_reg", INTRODUCTION, measure, tables, figures, goals)
