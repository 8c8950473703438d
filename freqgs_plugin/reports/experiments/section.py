"""What a section of an experiment consists of."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from freqgs_plugin.reports.bench.tables import BenchTable
from freqgs_plugin.reports.experiments.goals import Goal
from freqgs_plugin.reports.experiments.lab import Lab
from freqgs_plugin.reports.experiments.options import ClodOptions, Section
from freqgs_plugin.reports.experiments.training import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Results = Sequence[dict[str, Any]]
"""what `measure` returned, one per seed; JSON values, so null for infinite numbers"""


class Measure(Protocol):
    def __call__(self, lab: Lab, trial: Trial, options: ClodOptions) -> dict[str, Any]: ...


class Tables(Protocol):
    def __call__(self, scene: str, results: Results) -> list[BenchTable]: ...


class Figures(Protocol):
    def __call__(self, scene: str, results: Results) -> "Mapping[str, Figure]": ...


class Goals(Protocol):
    def __call__(self, scene: str, results: Results) -> list[Goal]: ...


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
    """end of the file's name -> picture"""
    goals: Goals = no_goals
