"""How many levels a scene needs: the default, chosen by band energy, and stopped early, side by side."""

from collections.abc import Mapping
from typing import Any

from freqgs_plugin.functional.cost import bytes_per_gaussian
from freqgs_plugin.reports.bench.tables import BenchTable, Row
from freqgs_plugin.reports.experiments.claims_measures import figures, speeds
from freqgs_plugin.reports.experiments.lab import Lab, LoadedRun
from freqgs_plugin.reports.experiments.options import TrialOptions
from freqgs_plugin.reports.experiments.section import Results
from freqgs_plugin.reports.experiments.seeds import shown
from freqgs_plugin.reports.experiments.training import Training, Trial
from freqgs_plugin.training.presets import Value

LEAST_GAIN = 0.5
"""dB on held-back views that the run which stops early asks of a new level"""
CHOICES: Mapping[str, Mapping[str, Value]] = {
    "3 (default)": {},
    "auto": {"num_levels": "auto"},
    "5": {"num_levels": 5},
    f"5, least-level-gain {LEAST_GAIN:g}": {"num_levels": 5, "least_level_gain": LEAST_GAIN},
}
"""`num-levels` -> options of lapsplat"""
NOTE = (
    "*MB*: float32 parameters of all Gaussians, 10^6 bytes. *ms*: median of 9 pictures of the first held-out view, the "
    "runs taking turns. PSNR and SSIM are of held-out views, which decide nothing."
)


def measure(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
    """Figures of each run, what it said about its levels, and milliseconds side by side."""
    trainings = {
        name: Training(trial.scene, "lapsplat", trial.steps, trial.seed, more) for name, more in CHOICES.items()
    }
    runs = {
        name: {
            **lab.step("claims-figures", [training], {}, lambda t=training: figures(lab.run(t))),
            **lab.step("claims-levels", [training], {}, lambda t=training: chosen(lab.run(t))),
        }
        for name, training in trainings.items()
    }
    times = lab.step(
        "claims-speeds",
        list(trainings.values()),
        {"names": list(trainings)},
        lambda: speeds({name: lab.load(t, lab.config_path(t)) for name, t in trainings.items()}),
    )
    return {"runs": runs, "times": times}


def chosen(run: LoadedRun) -> dict[str, Any]:
    """Bytes of the scene in memory, and what the run left out of its levels; empty where the number was given."""
    gaussians = run.gaussians
    degree = round((gaussians.features_rest.shape[1] + 1) ** 0.5) - 1
    each = bytes_per_gaussian("memory", degree, gaussians.decay is not None)
    return {"bytes": len(gaussians) * each, "said": run.levels_left_out()}


def table(scene: str, results: Results) -> BenchTable:
    """One row per choice."""
    rows: list[Row] = [
        {"name": name, "seeds": [{**r["runs"][name], "ms": r["times"][name]["median_ms"]} for r in results]}
        for name in CHOICES
    ]

    def by_level(row: Row) -> str:
        return "; ".join(" / ".join(f"{count:,}" for count in seed["counts"]) for seed in row["seeds"])

    columns = [
        ("num-levels", lambda row: row["name"]),
        ("PSNR, dB", lambda row: shown(row["seeds"], lambda s: s["psnr"])),
        ("SSIM", lambda row: shown(row["seeds"], lambda s: s["ssim"], ".3f")),
        ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["gaussians"], ",.0f")),
        ("MB", lambda row: shown(row["seeds"], lambda s: s["bytes"] / 1e6)),
        ("ms", lambda row: shown(row["seeds"], lambda s: s["ms"], ".1f")),
        ("by level", by_level),
    ]
    return BenchTable(f"levels-{scene}", scene, rows, columns, NOTE)


def text(scene: str, results: Results) -> str:
    """The table, and what the runs said."""
    shown_table = table(scene, results)
    said = dict.fromkeys(
        f"* {name}: {line}"
        for result in results
        for name, run in result["runs"].items()
        for line in run["said"]
    )  # fmt: skip
    return "\n\n".join([shown_table.markdown(), NOTE, *(["\n".join(said)] if said else [])])
