"""`freqgs experiment claims`: trains what the papers' claims need, judges each, writes JSON and Markdown."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.page import check_places, fill, read_page
from freqgs_plugin.reports.bench.runner import check_folder, write_all
from freqgs_plugin.reports.experiments import claims_goals, claims_levels
from freqgs_plugin.reports.experiments.claims import CLAIMS, RUNS, of_runs
from freqgs_plugin.reports.experiments.claims_page import (
    Found,
    goals_of,
    markdown_page,
    place_of,
    places,
    verdict_table,
    verdicts,
)
from freqgs_plugin.reports.experiments.goals import goal_table
from freqgs_plugin.reports.experiments.lab import Lab, Missing, Tools
from freqgs_plugin.reports.experiments.options import ClaimsOptions, ExperimentError, TrialOptions, command_line
from freqgs_plugin.reports.experiments.progress import Bars, Silent
from freqgs_plugin.reports.experiments.runner import record_of, trials
from freqgs_plugin.reports.experiments.store import Store, alone
from freqgs_plugin.reports.experiments.training import ExperimentScene, Trial
from freqgs_plugin.reports.tables import finite_json

if TYPE_CHECKING:
    from rich.console import Console

MEASURED: Mapping[str, Callable[[Lab, Trial, TrialOptions], dict[str, Any]]] = {
    **{claim.name: claim.measure for claim in CLAIMS},
    "goals": claims_goals.measure,
    "runs": of_runs(*RUNS),
    "levels": claims_levels.measure,
}
"""all that is measured for each scene and seed"""
Scenes = Mapping[str, tuple[Mapping[str, Any], Found]]
"""scene -> circumstances, and what was found in it"""


def run_claims(options: ClaimsOptions, scenes: Sequence[ExperimentScene], tools: Tools, console: "Console") -> Scenes:
    """Do what is not done yet, scene by scene, and print the verdicts. A report is written after each scene.

    Raises:
        KeyboardInterrupt: passed on, after a message on how to go on.
        ExperimentError: `page_only`, and nothing is finished, or nothing of `only`; `only` names what there is not.
        BenchError: the page of `docs` lacks the place of a scene.
    """
    names = check_claims(options, [scene.name for scene in scenes])
    out = options.output_dir
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    store, log = Store(out / "steps"), out / "load.log"

    def finished() -> Lab:
        return Lab(store, tools, Silent(), log, only_finished=True)

    if not options.page_only:
        try:
            with (
                alone(out),
                Bars(console, "freqgs experiment claims", len(names) * len(scenes) * options.seeds) as bars,
            ):
                lab = Lab(store, tools, bars, log)
                for scene in scenes:
                    for trial in trials(options, scene):
                        for name in names:
                            bars.part(f"{name}: {scene.name}, seed {trial.seed}")
                            MEASURED[name](lab, trial, options)
                            bars.advance()
                    _report(options, scenes, finished)
        except KeyboardInterrupt:
            _say(console, f"Stopped. What is finished is kept in {store.folder}; the same command goes on from there.")
            raise
    found, files = _report(options, scenes, finished)
    for name in names if options.only else ():
        if lacking := [scene.name for scene in scenes if scene.name not in found or not found[scene.name][1][name]]:
            _say(console, f"Nothing finished of {name}: {', '.join(lacking)}; leave out --page-only to measure it.")
    console.print(verdict_table([row for name in found for row in verdicts(name, found[name][1])]).rich())
    if goals := [goal for name in found for goal in goals_of(name, found[name][1])]:
        console.print(goal_table(goals))
    for path in files:
        _say(console, str(path))
    return found


def _chosen(only: Iterable[str]) -> list[str]:
    wanted = [name for item in only for name in item.split(",") if name]
    if only and not wanted:
        raise ExperimentError(f"--only {' '.join(only)} names nothing: choose among {', '.join(MEASURED)}")
    unknown = [name for name in wanted if name not in MEASURED]
    if unknown:
        raise ExperimentError(f"--only {' '.join(unknown)}: choose among {', '.join(MEASURED)}")
    return [name for name in MEASURED if not wanted or name in wanted]


def check_claims(options: ClaimsOptions, scenes: Sequence[str]) -> list[str]:
    """What can be refused before hours of work, and before there are scenes; the names that `only` chooses.

    Raises:
        ExperimentError: `only` names what there is not.
        BenchError: the page of `docs` lacks the place of one of `scenes`.
        OSError: nothing can be written beside the page.
    """
    names = _chosen(options.only)
    if options.docs is not None:
        parts = dict.fromkeys(place_of(name) for name in names)
        places = [f"{part} {scene}" for scene in scenes for part in parts]
        check_places(read_page(options.docs), places, options.docs)
        check_folder(options.docs.parent)
    return names


def _report(
    options: ClaimsOptions, scenes: Sequence[ExperimentScene], finished: Callable[[], Lab]
) -> tuple[Scenes, list[Path]]:
    command = command_line(options, "claims")
    found: dict[str, tuple[Mapping[str, Any], Found]] = {}
    for scene in scenes:
        # one for each scene: it notes what it was asked for
        lab = finished()
        of_scene = collect(options, scene, lab)
        if any(of_scene.values()):
            found[scene.name] = (record_of(options, lab, command), of_scene)
    wanted = _chosen(options.only)
    if not any(of_scene[name] for _, of_scene in found.values() for name in wanted):
        what = f"of {', '.join(wanted)} " if options.only else ""
        raise ExperimentError(
            f"{options.output_dir} holds nothing finished {what}of these scenes and settings; leave out --page-only"
        )
    report = {
        name: {
            **record,
            "verdicts": {row["claim"].name: {**row, "claim": row["claim"].text} for row in verdicts(name, of_scene)},
            "goals": [asdict(goal) for goal in goals_of(name, of_scene)],
            "measured": of_scene,
        }
        for name, (record, of_scene) in found.items()
    }
    files = {
        options.output_dir / "claims.json": json.dumps(finite_json(report), indent=1, allow_nan=False).encode() + b"\n",
        options.output_dir / "claims.md": markdown_page(found).encode(),
    }
    if options.docs is not None:
        page = read_page(options.docs)
        for name, (record, of_scene) in found.items():
            for place, text in places(name, record, of_scene).items():
                page = fill(page, place, text)
        files[options.docs] = page.encode()
    write_all(files)
    return found, list(files)


def collect(options: ClaimsOptions, scene: ExperimentScene, lab: Lab) -> Found:
    """All that is finished of a scene; `lab` does nothing anew."""
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in MEASURED}
    for name, measure in MEASURED.items():
        for trial in trials(options, scene):
            try:
                found[name].append(measure(lab, trial, options))
            except Missing:
                continue
    return found


def _say(console: "Console", text: str) -> None:
    console.print(text, soft_wrap=True, highlight=False, markup=False)
