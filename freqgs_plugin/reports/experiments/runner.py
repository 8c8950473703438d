"""`freqgs experiment clod`: runs sections scene by scene, seed by seed; writes JSON, Markdown and pictures."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.page import read_page
from freqgs_plugin.reports.bench.runner import IMAGES, check_folder, png, write_all
from freqgs_plugin.reports.experiments import ablation, budget, curve, pops, sigma
from freqgs_plugin.reports.experiments.goals import goal_table
from freqgs_plugin.reports.experiments.lab import Lab, Missing, Tools
from freqgs_plugin.reports.experiments.options import SECTIONS, ClodOptions, ExperimentError, TrialOptions, command_line
from freqgs_plugin.reports.experiments.page import TITLE, Shown, markdown_page
from freqgs_plugin.reports.experiments.progress import Bars, Silent
from freqgs_plugin.reports.experiments.section import Part
from freqgs_plugin.reports.experiments.store import Store, alone
from freqgs_plugin.reports.experiments.training import ExperimentScene, Trial
from freqgs_plugin.reports.tables import finite_json
from freqgs_plugin.reports.timing import environment

if TYPE_CHECKING:
    from rich.console import Console

PARTS: Mapping[str, Part] = {p.name: p for p in (curve.PART, budget.PART, pops.PART, ablation.PART, sigma.PART)}
FIRST_SEED = 42


def run_clod(options: ClodOptions, scenes: Sequence[ExperimentScene], tools: Tools, console: "Console") -> list[Shown]:
    """Do what is not done yet, and print the goals. After each section all that is known for these settings is written.

    Raises:
        KeyboardInterrupt: passed on, after a message on how to go on.
        ExperimentError: `page_only`, and nothing is finished; `docs` is another page.
    """
    out = options.output_dir
    check_clod(options)
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    store, log = Store(out / "steps"), out / "load.log"
    if options.page_only:
        shown, files = _report(options, scenes, Lab(store, tools, Silent(), log, only_finished=True))
    else:
        try:
            with alone(out):
                shown, files = _measure(options, scenes, store, tools, log, console)
        except KeyboardInterrupt:
            _say(console, f"Stopped. What is finished is kept in {store.folder}; the same command goes on from there.")
            raise
    goals = [goal for each in shown for goal in each.goals()]
    if goals:
        console.print(goal_table(goals))
    for path in files:
        _say(console, str(path))
    return shown


def check_clod(options: ClodOptions) -> None:
    """What can be refused before hours of work. The whole page is written, so what is there must be an earlier one.

    Raises:
        ExperimentError: it is another page.
        OSError: nothing can be written beside it.
    """
    if options.docs is None:
        return
    page = read_page(options.docs)
    if page and not page.startswith(TITLE):
        raise ExperimentError(
            f"{options.docs} is no page that this command wrote (it would begin with '{TITLE}'), and all of it would "
            "be replaced; name another --docs"
        )
    check_folder(options.docs.parent)


Report = tuple[list[Shown], Mapping[Path, bytes]]
"""sections, and the files that show them"""


def _measure(
    options: ClodOptions, scenes: Sequence[ExperimentScene], store: Store, tools: Tools, log: Path, console: "Console"
) -> Report:
    """Every section in turn, with a report after each."""
    report: Report = ([], {})
    with Bars(console, "freqgs experiment clod", len(options.sections) * len(scenes) * options.seeds) as bars:
        lab = Lab(store, tools, bars, log)
        for name in options.sections:
            for scene in scenes:
                for trial in trials(options, scene):
                    bars.part(f"{name}: {scene.name}, seed {trial.seed}")
                    PARTS[name].measure(lab, trial, options)
                    bars.advance()
            report = _report(options, scenes, Lab(store, tools, Silent(), log, only_finished=True))
    return report


def _report(options: ClodOptions, scenes: Sequence[ExperimentScene], finished: Lab) -> Report:
    """Write all that is known for these settings.

    Raises:
        ExperimentError: nothing is.
    """
    shown = collect(options, scenes, finished)
    if not shown:
        raise ExperimentError(
            f"{options.output_dir} holds no finished section of these scenes and settings; leave out --page-only"
        )
    files = _files(options, record_of(options, finished, command_line(options, "clod")), shown)
    write_all(files)
    return shown, files


def trials(options: TrialOptions, scene: ExperimentScene) -> list[Trial]:
    """One per seed."""
    return [Trial(scene, options.steps, FIRST_SEED + i) for i in range(options.seeds)]


def collect(options: ClodOptions, scenes: Sequence[ExperimentScene], lab: Lab) -> list[Shown]:
    """All sections, scene by scene, with those seeds that are finished; `lab` does nothing anew."""
    shown = []
    for name in SECTIONS:
        results: dict[str, dict[int, dict[str, Any]]] = {}
        for scene in scenes:
            for trial in trials(options, scene):
                try:
                    found = PARTS[name].measure(lab, trial, options)
                except Missing:
                    continue
                results.setdefault(scene.name, {})[trial.seed] = found
        if results:
            shown.append(Shown(PARTS[name], results))
    return shown


def record_of(options: TrialOptions, lab: Lab, command: str) -> dict[str, Any]:
    """Circumstances of all steps that `lab` was asked for; options without the folders that they write to."""
    used = list(lab.used.values())
    return {
        **environment(),
        "command": command,
        "options": {
            **{name: value for name, value in asdict(options).items() if name not in ("output_dir", "docs")},
            "scenes": [folder.resolve().name for folder in options.scenes],
        },
        "seeds": [FIRST_SEED + i for i in range(options.seeds)],
        "dates": sorted({record["date"][:10] for record in used}),
        "commits": sorted({str(record["commit"]) for record in used}),
        "hours": sum(record["seconds"] for record in used) / 3600,
    }


def _files(options: ClodOptions, record: dict[str, Any], shown: Sequence[Shown]) -> dict[Path, bytes]:
    """Path -> contents of everything that is written."""
    report = {
        **record,
        "goals": [{**asdict(goal)} for each in shown for goal in each.goals()],
        "sections": {each.part.name: each.results for each in shown},
    }
    out, pictures = options.output_dir, {}
    for each in shown:
        pictures |= {name: png(figure) for name, figure in each.figures().items()}
    files = {
        out / "clod.json": json.dumps(finite_json(report), indent=1, allow_nan=False).encode() + b"\n",
        out / "clod.md": markdown_page(record, shown, "").encode(),
        **{out / name: picture for name, picture in pictures.items()},
    }
    if options.docs is not None:
        files[options.docs] = markdown_page(record, shown, f"{IMAGES}/").encode()
        files |= {options.docs.parent / IMAGES / name: picture for name, picture in pictures.items()}
    return files


def _say(console: "Console", text: str) -> None:
    console.print(text, soft_wrap=True, highlight=False, markup=False)
