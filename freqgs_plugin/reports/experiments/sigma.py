"""Distributions of the learned decay and of opacity for each s_max (the paper's Figure 8)."""

from typing import TYPE_CHECKING, Any

import numpy as np

from freqgs_plugin.reports.bench.tables import BenchTable, Row
from freqgs_plugin.reports.experiments.lab import Lab, LoadedRun
from freqgs_plugin.reports.experiments.measures import at_scale
from freqgs_plugin.reports.experiments.options import ClodOptions
from freqgs_plugin.reports.experiments.plots import COLOURS, panels
from freqgs_plugin.reports.experiments.section import Part, Results
from freqgs_plugin.reports.experiments.seeds import shown
from freqgs_plugin.reports.experiments.training import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
BINS = 60
LARGEST = 15.0
"""decays above count into the last bin"""

INTRODUCTION = """\
How the learned decays sigma and the opacities are distributed over the Gaussians of each model: the paper's Figure 8.
Sigma is in units of the reference distance; the larger it is, the longer a Gaussian stays. The paper finds larger ones
with larger s_max. *dead*: sigma <= 0, never drawn."""


def measure(lab: Lab, trial: Trial, options: ClodOptions) -> dict[str, Any]:
    """Quantiles and histograms per s_max."""
    found = {}
    for largest in options.s_max:
        training = trial.clod(largest)
        more = {"quantiles": QUANTILES, "bins": BINS, "largest": LARGEST}
        found[f"{largest:g}"] = lab.step("sigma", [training], more, lambda t=training: distribution(lab.run(t)))
    return found


def distribution(run: LoadedRun) -> dict[str, Any]:
    """Of σ (held at or above 0) and of opacity: quantiles, and shares per bin."""
    at_scale(run, 1.0)
    assert run.gaussians.decay is not None
    decay, opacity = (x.detach().double().cpu().numpy() for x in (run.gaussians.decay, run.gaussians.opacities))
    return {
        "gaussians": len(decay),
        "dead": float((decay <= 0).mean()),
        "decay": summary(decay.clip(0), LARGEST),
        "opacity": summary(opacity, 1.0),
    }


def summary(values: np.ndarray, largest: float) -> dict[str, Any]:
    """Quantiles, mean, and the share of the values in each of `BINS` bins from 0 to `largest`."""
    counts, _ = np.histogram(values.clip(0, largest), bins=BINS, range=(0, largest))
    return {
        "mean": float(values.mean()),
        "quantiles": np.quantile(values, QUANTILES).tolist(),
        "shares": (counts / len(values)).tolist(),
        "largest": largest,
    }


def tables(scene: str, results: Results) -> list[BenchTable]:
    """One row per s_max."""
    rows: list[Row] = [{"model": model, "seeds": [result[model] for result in results]} for model in results[0]]
    return [
        BenchTable(
            f"clod-sigma-{scene}",
            f"{scene}: learned decay",
            rows,
            [
                ("s_max", lambda row: row["model"]),
                ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["gaussians"], ",.0f")),
                ("mean sigma", lambda row: shown(row["seeds"], lambda s: s["decay"]["mean"])),
                *(
                    (f"{100 * q:.0f} %", lambda row, i=i: shown(row["seeds"], lambda s: s["decay"]["quantiles"][i]))
                    for i, q in enumerate(QUANTILES)
                ),
                ("dead", lambda row: shown(row["seeds"], lambda s: 100 * s["dead"], ".1f") + " %"),
                ("median opacity", lambda row: shown(row["seeds"], lambda s: s["opacity"]["quantiles"][2])),
            ],
        )
    ]


def figures(scene: str, results: Results) -> "dict[str, Figure]":
    """Densities and cumulative shares, of the first seed."""
    figure, axes = panels(2, 2)
    for i, (model, found) in enumerate(results[0].items()):
        for column, name in enumerate(("decay", "opacity")):
            largest, shares = found[name]["largest"], np.array(found[name]["shares"])
            edges = np.linspace(0, largest, BINS + 1)
            style = {"color": COLOURS[i % len(COLOURS)], "lw": 1.2, "label": f"s_max {model}"}
            axes[column].stairs(shares / (largest / BINS), edges, **style)
            axes[2 + column].plot(edges[1:], shares.cumsum(), **style)
    for column, label in enumerate(("sigma", "opacity")):
        axes[column].set(xlabel=label, ylabel="density")
        axes[2 + column].set(xlabel=label, ylabel="share of Gaussians at or below", ylim=(0, 1.02))
    axes[0].legend(fontsize=8)
    figure.suptitle(f"{scene}: decay and opacity", fontsize=11)
    return {"": figure}


PART = Part("sigma", "What is learned", INTRODUCTION, measure, tables, figures)
