"""What was found of the papers' claims, scene by scene, as tables and Markdown."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from freqgs_plugin.reports.bench.tables import BenchTable, Row
from freqgs_plugin.reports.experiments import claims_goals, claims_levels
from freqgs_plugin.reports.experiments.claims import CLAIMS, RUNS
from freqgs_plugin.reports.experiments.goals import Goal, goal_markdown, summary
from freqgs_plugin.reports.experiments.page import circumstances
from freqgs_plugin.reports.experiments.section import Results
from freqgs_plugin.reports.experiments.seeds import shown

Found = Mapping[str, list[dict[str, Any]]]
"""claim, "goals", "runs" or "levels" -> what was measured in one scene, one per finished seed"""
INTRODUCTION = """\
What the two papers claim, each put to the test on the same scenes in the same run. *A* is the paper on frequency-aware
decomposition (`lapsplat`), *B* the one on continuous level of detail (`clodsplat`). *plain* is the same code with one
level and without decay: splatfacto's algorithm ([One level](methods.md#one-level)). It densifies over the same part of
the run as `lapsplat` and `clodsplat` do with our settings; with the paper's settings, `lapsplat` densifies to the end.

A claim *holds* if at least half of the paper's figure is found in its direction, or what the column *condition* says.
These are small scenes and short runs: a claim that does not hold here may hold on large scenes at 30,000 steps."""
RUNS_NOTE = (
    "*PSNR of prefixes*: picture and photograph both reduced to the prefix's size. *Added*: what a level changes "
    "in the picture of those below it, root mean square; of the first one against the background."
)


def places(scene: str, record: Mapping[str, Any], found: Found) -> dict[str, str]:
    """What fills a page: the name of each place -> Markdown; of what is wholly missing there is no place."""
    texts = _texts(scene, found, len(record["seeds"]))
    return {f"{name} {scene}": f"{_circumstances(record)}\n\n{text}\n" for name, text in texts.items() if text}


def place_of(name: str) -> str:
    """The place of a claim, of "goals", "runs" or "levels": what one paper claims stands together."""
    return name if name in ("goals", "runs", "levels") else f"claims-{name[0]}"


def _texts(scene: str, found: Found, seeds: int) -> dict[str, str]:
    """Place -> Markdown, where `seeds` were asked for; empty where nothing of it was measured."""
    papers = dict.fromkeys(place_of(claim.name) for claim in CLAIMS)
    tables = {
        "goals": goals_text(scene, found),
        "runs": runs_text(scene, found),
        "levels": claims_levels.text(scene, found["levels"]) if found["levels"] else "",
    }
    missing = {name: finished_of(len(found[name]), seeds) for name, text in tables.items() if text}
    return {
        **{place: claims_text(scene, found, place, seeds) for place in papers},
        **{name: f"Of {missing[name]}.\n\n{text}" if missing.get(name) else text for name, text in tables.items()},
    }


def finished_of(count: int, seeds: int) -> str:
    """How many seeds a figure is of; empty where that is all of them."""
    return "" if count in (0, seeds) else f"{count} of {seeds} seeds"


def verdicts(scene: str, found: Found) -> list[Row]:
    """One row per claim."""
    rows: list[Row] = []
    for claim in CLAIMS:
        results = found[claim.name]
        verdict = asdict(claim.judge(scene, results)) if results else {"found": "-", "holds": None}
        rows.append({"claim": claim, "scene": scene, "measured": bool(results), **verdict})
    return rows


def _verdict(row: Row) -> str:
    if row["holds"] is None:
        return "not measurable here" if row["measured"] else "not measured"
    return "holds" if row["holds"] else "does not hold"


def verdict_table(rows: Sequence[Row]) -> BenchTable:
    """For a terminal, of all scenes."""
    columns = [
        ("", lambda row: row["claim"].name),
        ("scene", lambda row: row["scene"]),
        ("", _verdict),
        ("found", lambda row: row["found"]),
    ]
    return BenchTable("verdicts", "The papers' claims", rows, columns)


def goals_of(scene: str, found: Found) -> list[Goal]:
    """None where they were not measured."""
    return claims_goals.goals(scene, found["goals"]) if found["goals"] else []


def _claim_table(rows: Sequence[Row]) -> BenchTable:
    columns = [
        ("", lambda row: row["claim"].name),
        ("claim", lambda row: row["claim"].text),
        ("the paper", lambda row: row["claim"].paper),
        ("condition", lambda row: row["claim"].condition),
        ("found", lambda row: row["found"]),
        ("", _verdict),
    ]
    return BenchTable("claims", "The papers' claims", rows, columns)


def run_table(scene: str, results: Results) -> BenchTable:
    """One row per run."""
    rows: list[Row] = [{"run": name, "seeds": [result[name] for result in results]} for name in RUNS]

    def several(name: str, form: str) -> Any:
        def cell(row: Row) -> str:
            count = len(row["seeds"][0][name])
            return " / ".join(shown(row["seeds"], lambda s, k=k: s[name][k], form) for k in range(count))

        return cell

    columns = [
        ("run", lambda row: row["run"]),
        ("PSNR, dB", lambda row: shown(row["seeds"], lambda s: s["psnr"])),
        ("SSIM", lambda row: shown(row["seeds"], lambda s: s["ssim"], ".3f")),
        ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["gaussians"], ",.0f")),
        ("by level", several("counts", ",.0f")),
        ("PSNR of prefixes, dB", several("prefixes", ".2f")),
        ("added, grey levels", several("added", ".1f")),
    ]
    return BenchTable(f"claims-{scene}", scene, rows, columns, RUNS_NOTE)


def claims_text(scene: str, found: Found, place: str, seeds: int) -> str:
    """The claims of one paper; a row of fewer than `seeds` says so."""
    rows = [row for row in verdicts(scene, found) if place_of(row["claim"].name) == place]
    fewer = {row["claim"].name: finished_of(len(found[row["claim"].name]), seeds) for row in rows}
    rows = [{**row, "found": f"{row['found']} ({few})"} if (few := fewer[row["claim"].name]) else row for row in rows]
    if not any(row["measured"] for row in rows):
        return ""
    judged = [row["holds"] for row in rows if row["holds"] is not None]
    table = _claim_table(rows).markdown().replace("---:", "---")
    return f"{sum(judged)} of {len(judged)} claims that were measured hold.\n\n{table}"


def runs_text(scene: str, found: Found) -> str:
    """Every run's figures."""
    if not found["runs"]:
        return ""
    runs = run_table(scene, found["runs"])
    return f"{runs.markdown()}\n\n{runs.note}"


def goals_text(scene: str, found: Found) -> str:
    """What was aimed at."""
    goals = goals_of(scene, found)
    return f"{summary(goals)}\n\n{goal_markdown(goals)}" if goals else ""


def _circumstances(record: Mapping[str, Any]) -> str:
    seeds = ", ".join(map(str, record["seeds"]))
    return (
        f"{circumstances(record)}\n\n"
        f"{record['options']['steps']:,} steps, every eighth view held out, seed{'s' * (len(record['seeds']) > 1)} "
        f"{seeds}; of several, figures are means ± half of the range. One run scatters by 0.1 to 0.5 dB."
    )


def markdown_page(scenes: Mapping[str, tuple[Mapping[str, Any], Found]]) -> str:
    """All scenes, each with its record."""
    parts = ["# The papers' claims", INTRODUCTION, claims_goals.INTRODUCTION]
    for scene, (record, found) in scenes.items():
        parts += [f"## {scene}", _circumstances(record), *_shown(scene, found, len(record["seeds"]))]
    return "\n\n".join(parts) + "\n"


def _shown(scene: str, found: Found, seeds: int) -> list[str]:
    return [text for text in _texts(scene, found, seeds).values() if text]
