"""`freqgs experiment claims`: trains what the papers' claims need, judges each, writes JSON and Markdown."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.runner import check_folder, write_all
from freqgs_plugin.reports.bench.tables import BenchTable, Row
from freqgs_plugin.reports.experiments import claims_goals
from freqgs_plugin.reports.experiments.claims import CLAIMS, RUNS, of_runs
from freqgs_plugin.reports.experiments.goals import Goal, goal_markdown, goal_table, summary
from freqgs_plugin.reports.experiments.lab import Lab, Missing, Tools
from freqgs_plugin.reports.experiments.options import ClaimsOptions, ExperimentError, TrialOptions, command_line
from freqgs_plugin.reports.experiments.page import circumstances
from freqgs_plugin.reports.experiments.progress import Bars, Silent
from freqgs_plugin.reports.experiments.runner import record_of, trials
from freqgs_plugin.reports.experiments.seeds import shown
from freqgs_plugin.reports.experiments.store import Store, alone
from freqgs_plugin.reports.experiments.training import ExperimentScene, Trial
from freqgs_plugin.reports.tables import finite_json

if TYPE_CHECKING:
    from rich.console import Console

Found = Mapping[str, Mapping[str, list[dict[str, Any]]]]
"""name in `MEASURED` -> scene -> what was measured, one per finished seed"""
MEASURED: Mapping[str, Callable[[Lab, Trial, TrialOptions], dict[str, Any]]] = {
    **{claim.name: claim.measure for claim in CLAIMS},
    "goals": claims_goals.measure,
    "runs": of_runs(*RUNS),
}
"""all that is measured for each scene and seed"""
INTRODUCTION = """\
What the two papers claim, each put to the test on the same scenes in the same run. *A* is the paper on frequency-aware
decomposition (`lapsplat`), *B* the one on continuous level of detail (`clodsplat`). *plain* is the same code with one
level and without decay: splatfacto's algorithm ([One level](methods.md#one-level)). It densifies over the same part of
the run as `lapsplat` and `clodsplat` do with our settings; with the paper's settings, `lapsplat` densifies to the end.

A claim *holds* if at least half of the paper's figure is found in its direction, or what the column *condition* says.
These are small scenes and short runs: a claim that does not hold here may hold on large scenes at 30,000 steps."""


def run_claims(options: ClaimsOptions, scenes: Sequence[ExperimentScene], tools: Tools, console: "Console") -> Found:
    """Do what is not done yet, scene by scene, and print the verdicts. A report is written after each scene.

    Raises:
        KeyboardInterrupt: passed on, after a message on how to go on.
        ExperimentError: `page_only`, and nothing is finished.
    """
    out = options.output_dir
    for folder in (out, *([options.docs.parent] if options.docs is not None else [])):
        check_folder(folder)
    out.mkdir(parents=True, exist_ok=True)
    store, log = Store(out / "steps"), out / "load.log"
    if not options.page_only:
        try:
            with (
                alone(out),
                Bars(console, "freqgs experiment claims", len(MEASURED) * len(scenes) * options.seeds) as bars,
            ):
                lab = Lab(store, tools, bars, log)
                for scene in scenes:
                    for trial in trials(options, scene):
                        for name, measure in MEASURED.items():
                            bars.part(f"{name}: {scene.name}, seed {trial.seed}")
                            measure(lab, trial, options)
                            bars.advance()
                    _report(options, scenes, Lab(store, tools, Silent(), log, only_finished=True))
        except KeyboardInterrupt:
            text = f"Stopped. What is finished is kept in {store.folder}; the same command goes on from there."
            console.print(text, soft_wrap=True, highlight=False, markup=False)
            raise
    found, files = _report(options, scenes, Lab(store, tools, Silent(), log, only_finished=True))
    console.print(verdict_table(found).rich())
    console.print(goal_table(goals_of(found)))
    for path in files:
        console.print(str(path), soft_wrap=True, highlight=False, markup=False)
    return found


def _report(options: ClaimsOptions, scenes: Sequence[ExperimentScene], lab: Lab) -> tuple[Found, list[Path]]:
    found = collect(options, scenes, lab)
    if not any(found.values()):
        raise ExperimentError(f"{options.output_dir} holds nothing finished of these scenes; leave out --page-only")
    record = record_of(options, lab, command_line(options, "claims"))
    verdicts = {
        claim.name: {scene: asdict(claim.judge(scene, results)) for scene, results in found[claim.name].items()}
        for claim in CLAIMS
    }
    goals = [asdict(goal) for goal in goals_of(found)]
    report = {**record, "verdicts": verdicts, "goals": goals, "measured": found}
    page = markdown_page(record, found).encode()
    files = {
        options.output_dir / "claims.json": json.dumps(finite_json(report), indent=1, allow_nan=False).encode() + b"\n",
        options.output_dir / "claims.md": page,
        **({options.docs: page} if options.docs is not None else {}),
    }
    write_all(files)
    return found, list(files)


def collect(options: ClaimsOptions, scenes: Sequence[ExperimentScene], lab: Lab) -> Found:
    """All that is finished; `lab` does nothing anew."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {name: {} for name in MEASURED}
    for name, measure in MEASURED.items():
        for scene in scenes:
            for trial in trials(options, scene):
                try:
                    result = measure(lab, trial, options)
                except Missing:
                    continue
                found[name].setdefault(scene.name, []).append(result)
    return found


def goals_of(found: Found) -> list[Goal]:
    """Of every scene that was measured for them."""
    return [goal for scene, results in found["goals"].items() for goal in claims_goals.goals(scene, results)]


def _judged(found: Found) -> list[Row]:
    """One row per claim and scene."""
    rows: list[Row] = []
    for claim in CLAIMS:
        for scene, results in found[claim.name].items():
            verdict = claim.judge(scene, results)
            rows.append({"claim": claim, "scene": scene, "seeds": len(results), **asdict(verdict)})
        if not found[claim.name]:
            rows.append({"claim": claim, "scene": "-", "seeds": 0, "found": "-", "holds": None})
    return rows


def _verdict(row: Row) -> str:
    return {True: "holds", False: "does not hold", None: "not measured"}[row["holds"]]


def claim_table(found: Found) -> BenchTable:
    """For the page: what is claimed, when it holds, and what was found."""
    return BenchTable(
        "claims",
        "The papers' claims",
        _judged(found),
        [
            ("", lambda row: row["claim"].name),
            ("claim", lambda row: row["claim"].text),
            ("the paper", lambda row: row["claim"].paper),
            ("condition", lambda row: row["claim"].condition),
            ("scene", lambda row: row["scene"]),
            ("found", lambda row: row["found"]),
            ("seeds", lambda row: str(row["seeds"])),
            ("", _verdict),
        ],
    )


def verdict_table(found: Found) -> BenchTable:
    """For a terminal."""
    return BenchTable(
        "verdicts",
        "The papers' claims",
        _judged(found),
        [
            ("", lambda row: row["claim"].name),
            ("scene", lambda row: row["scene"]),
            ("", _verdict),
            ("found", lambda row: row["found"]),
        ],
    )


def run_table(scene: str, results: Sequence[dict[str, Any]]) -> BenchTable:
    """One row per run."""
    rows: list[Row] = [{"run": name, "seeds": [result[name] for result in results]} for name in RUNS]

    def several(name: str, form: str) -> Any:
        def cell(row: Row) -> str:
            count = len(row["seeds"][0][name])
            return " / ".join(shown(row["seeds"], lambda s, k=k: s[name][k], form) for k in range(count))

        return cell

    return BenchTable(
        f"claims-{scene}",
        scene,
        rows,
        [
            ("run", lambda row: row["run"]),
            ("PSNR, dB", lambda row: shown(row["seeds"], lambda s: s["psnr"])),
            ("SSIM", lambda row: shown(row["seeds"], lambda s: s["ssim"], ".3f")),
            ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["gaussians"], ",.0f")),
            ("by level", several("counts", ",.0f")),
            ("PSNR of prefixes, dB", several("prefixes", ".2f")),
            ("added, grey levels", several("added", ".1f")),
        ],
        "*PSNR of prefixes*: picture and photograph both reduced to the prefix's size. *Added*: what a level changes "
        "in the picture of those below it, root mean square; of the first one against the background.",
    )


def markdown_page(record: Mapping[str, Any], found: Found) -> str:
    """Verdicts first, then every run."""
    options, seeds = record["options"], record["seeds"]
    table = claim_table(found)
    judged = [row["holds"] for row in table.rows if row["holds"] is not None]
    parts = [
        "# The papers' claims",
        "This page is written by `freqgs experiment claims` (see [Experiments](experiments.md)). Nothing is typed in.",
        circumstances(record),
        f"Every run has {options['steps']:,} steps. Every eighth view is held out. "
        f"Seeds: {', '.join(map(str, seeds))}; of several, figures are means ± half of the range. "
        "One run scatters by 0.1 to 0.5 dB.",
        INTRODUCTION,
        f"{sum(judged)} of {len(judged)} hold.",
        table.markdown().replace("---:", "---"),
    ]
    if found["goals"]:
        goals = goals_of(found)
        parts += ["## Goals", claims_goals.INTRODUCTION, summary(goals), goal_markdown(goals)]
    parts.append("## The runs")
    for scene, results in found["runs"].items():
        runs = run_table(scene, results)
        parts += [f"### {scene}", runs.markdown(), runs.note]
    return "\n\n".join(parts) + "\n"
