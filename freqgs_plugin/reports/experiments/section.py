"""What a section of an experiment consists of."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.tables import BenchTable
from freqgs_plugin.reports.experiments.goals import Goal
from freqgs_plugin.reports.experiments.lab import Lab
from freqgs_plugin.reports.experiments.options import ClodOptions, Section
from freqgs_plugin.reports.experiments.training import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Results = Sequence[dict[str, Any]]
"""what `measure` returned, one per seed; JSON values, so null for infinite numbers"""


Measure = Callable[[Lab, Trial, ClodOptions], dict[str, Any]]
"""does what is not done yet, for one scene and seed"""
Tables = Callable[[str, Results], list[BenchTable]]
"""name of the scene, results of all seeds -> tables"""
Figures = Callable[[str, Results], "Mapping[str, Figure]"]
"""the same -> end of a file's name -> picture"""
Goals = Callable[[str, Results], list[Goal]]


def no_goals(scene: str, results: Results) -> list[Goal]:
    return []


@dataclass(frozen=True)
class Part:
    """A section: measured for each scene and seed, shown for each scene."""

    name: Section
    title: str
    introduction: str
    """what the tables mean; Markdown"""
    measure: Measure
    tables: Tables
    figures: Figures
    goals: Goals = no_goals
