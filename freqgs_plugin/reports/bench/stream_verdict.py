"""What a stream's pictures reach after so many bytes, in words: holes, closeness, and the goals.

Larger Gaussians close holes with few bytes, but a picture of blobs says little. So a picture is *complete* from the cut
on from which no view has holes and the distance to the run's own picture is near that of the whole base, which is the
least that the run itself would show.
"""

from collections.abc import Callable, Sequence

from freqgs_plugin.reports.bench.stream_measure import Point
from freqgs_plugin.reports.bench.tables import Row

CURVE = "balanced"
"""variant whose curve and times are measured: the default"""
COVERED, CLOSE = 0.99, 3.0
"""a complete picture: this share of every view's pixels are no holes, and it is at most so many dB further from the
run's own picture than the whole base is; 3 dB are twice the squared error"""
GOAL_BASE, GOAL_BYTES, GOAL_LOSS = 0.15, 0.35, 0.2
"""goals: share of the bytes, of the stream's own and of the PLY's, for a complete picture; of the PLY's for the whole;
loss in dB"""


def milestones(points: Sequence[Point]) -> list[tuple[str, Point]]:
    """The first chunk, those that close holes and complete the picture, and the last one of every part of a level."""
    names = {"core": "", "sh": ", harmonics"}
    found = [("first chunk", points[0])]
    for point, after in zip(points, [*points[1:], None], strict=True):
        if after is None or (after.level, after.part) != (point.level, point.part):
            found.append((f"level {point.level}{names[point.part]}", point))
    found.append(("without holes", points[without_holes_from(points)]))
    found.append(("complete picture", points[complete_from(points)]))
    return sorted(found, key=lambda mark: mark[1].bytes)


def from_then_on(points: Sequence[Point], holds: Callable[[Point], bool]) -> int:
    """Index of the first point from which on it holds; the last one where it does not there."""
    fails = [index for index, point in enumerate(points) if not holds(point)]
    return min(max(fails, default=-1) + 1, len(points) - 1)


def without_holes_from(points: Sequence[Point]) -> int:
    """From which point on no picture has holes."""
    return from_then_on(points, lambda point: point.covered >= COVERED)


def complete_from(points: Sequence[Point]) -> int:
    """From which point on the picture is complete."""
    base = [p for p in points if (p.level, p.part) == (points[0].level, points[0].part)][-1]
    return from_then_on(points, lambda p: p.covered >= COVERED and p.complete >= base.complete - CLOSE)


def worst_dip(values: Sequence[float]) -> float:
    """How far a value lies under the best before it, at most; 0 where none does."""
    best, worst = -float("inf"), 0.0
    for value in values:
        worst, best = max(worst, best - value), max(best, value)
    return worst


def verdict(name: str, points: Sequence[Point], ply: int, variants: Sequence[Row]) -> str:
    """One scene's figures against the goals."""
    total, covered, complete = points[-1].bytes, points[without_holes_from(points)], points[complete_from(points)]
    whole = next(row for row in variants if row["variant"] == CURVE)
    smallest = min((row["share"] for row in variants if row["loss"] <= GOAL_LOSS), default=float("nan"))
    dips = worst_dip([p.photographs for p in points]), worst_dip([p.complete for p in points])
    return (
        f"**{name}**: the picture is without holes from {covered.bytes / total:.1%} of the stream's bytes on, at first "
        f"with {covered.complete:.1f} dB to the run's own, and complete from {complete.bytes / total:.1%} on, "
        f"{complete.bytes / ply:.1%} of the PLY's (goal {GOAL_BASE:.0%} of the stream's: "
        f"{_met(complete.bytes / total <= GOAL_BASE)}; of the PLY's: {_met(complete.bytes / ply <= GOAL_BASE)}); all "
        f"of it takes {whole['share']:.1%} at {whole['loss']:.2f} dB loss, the smallest variant within {GOAL_LOSS} dB "
        f"{smallest:.1%} (goal {GOAL_BYTES:.0%}: {_met(smallest <= GOAL_BYTES)}); over {len(points)} cuts the picture "
        f"is never worse than the best before by more than {dips[0]:.3f} dB against the photographs and {dips[1]:.3f} "
        f"dB against the run's own picture, which is what is sent (goal 0: {_met(dips[1] == 0)})."
    )


def _met(yes: bool) -> str:
    return "met" if yes else "missed"
