"""The page of an experiment: goals first, then every section with what it means, its pictures and its tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.tables import BenchTable
from freqgs_plugin.reports.experiments.goals import Goal, goal_markdown, summary
from freqgs_plugin.reports.experiments.section import Part, Results

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "# clodsplat, measured"


@dataclass(frozen=True)
class Shown:
    """A section with its results."""

    part: Part
    results: Mapping[str, Mapping[int, Any]]
    """scene -> seed -> what was measured; only seeds that are finished"""

    def scenes(self) -> list[tuple[str, Results]]:
        """Each scene with the results of its seeds."""
        return [(scene, list(by_seed.values())) for scene, by_seed in self.results.items()]

    def goals(self) -> list[Goal]:
        return [goal for scene, results in self.scenes() for goal in self.part.goals(scene, results)]

    def tables(self) -> list[BenchTable]:
        return [table for scene, results in self.scenes() for table in self.part.tables(scene, results)]

    def figures(self) -> "dict[str, Figure]":
        """File name -> picture."""
        return {
            picture_name(self.part, scene, end): figure
            for scene, results in self.scenes()
            for end, figure in self.part.figures(scene, results).items()
        }


def picture_name(part: Part, scene: str, end: str) -> str:
    return "_".join(word for word in ("clod", part.name, scene, end) if word) + ".png"


def circumstances(record: Mapping[str, Any]) -> str:
    """When, where, at which commits and how, in one paragraph."""
    hardware, versions = record["hardware"], record["versions"]
    parts = [
        f"Trained and measured {record['dates'][0]}"
        + (f" to {record['dates'][-1]}" if len(record["dates"]) > 1 else ""),
        f"commit{'s' if len(record['commits']) > 1 else ''} {', '.join(record['commits'])}",
        f"{hardware['processor']}, {hardware['cores']} cores, {hardware['gpu'] or 'no GPU'}",
        f"torch {versions['torch']}",
        f"{record['hours']:.1f} hours in all",
        f"`{record['command']}`",
    ]
    return ", ".join(parts) + "."


def markdown_page(record: Mapping[str, Any], shown: Sequence[Shown], pictures: str) -> str:
    """The whole page; pictures lie in the folder `pictures` (with a slash at its end), seen from it."""
    goals = [goal for each in shown for goal in each.goals()]
    steps, seeds = record["options"]["steps"], record["seeds"]
    parts = [
        TITLE,
        "This page is written by `freqgs experiment clod` (see [Experiments](experiments.md)). Nothing is typed in.",
        circumstances(record),
        f"Every run has {steps:,} steps. Every eighth view is held out. Seeds: {', '.join(map(str, seeds))}"
        + ("; figures are means ± half of the range." if len(seeds) > 1 else ". One run scatters by 0.1 to 0.5 dB."),
    ]
    if goals:
        parts += ["## Goals", summary(goals), goal_markdown(goals)]
    for each in shown:
        parts += [f"## {each.part.title}", each.part.introduction]
        for scene, results in each.scenes():
            parts.append(f"### {each.part.title}: {scene}")
            if (finished := list(each.results[scene])) != seeds:
                parts.append(f"Of seed{'s' if len(finished) > 1 else ''} {', '.join(map(str, finished))} alone.")
            for end in each.part.figures(scene, results):
                name = picture_name(each.part, scene, end)
                parts.append(f"![{each.part.title}, {scene}]({pictures}{name})")
            for table in each.part.tables(scene, results):
                parts += [f"*{table.title}.*", table.markdown(), *([table.note] if table.note else [])]
    return "\n\n".join(parts) + "\n"
