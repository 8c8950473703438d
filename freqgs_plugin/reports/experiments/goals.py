"""What was to be shown, and whether it was: reached or not, with the figures, never left out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

HEADINGS = ("scene", "goal", "measured", "")


@dataclass(frozen=True)
class Goal:
    """One goal for one scene, judged by means over seeds."""

    scene: str
    text: str
    figures: str
    reached: bool

    def cells(self) -> tuple[str, ...]:
        return self.scene, self.text, self.figures, "reached" if self.reached else "not reached"


def summary(goals: Sequence[Goal]) -> str:
    return f"{sum(goal.reached for goal in goals)} of {len(goals)} goals are reached."


def goal_markdown(goals: Sequence[Goal]) -> str:
    """All goals as a table; those that were not reached stand out."""
    lines = [HEADINGS, ("---",) * len(HEADINGS)]
    for goal in goals:
        *cells, verdict = goal.cells()
        lines.append((*cells, verdict if goal.reached else f"**{verdict}**"))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def goal_table(goals: Sequence[Goal]) -> "Table":
    """The same for a terminal."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=summary(goals))
    for heading in HEADINGS:
        table.add_column(heading)
    for goal in goals:
        table.add_row(*(escape(cell) for cell in goal.cells()), style=None if goal.reached else "red")
    return table
