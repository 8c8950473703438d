"""Error against what it costs, for all runs in one picture, with the Pareto front marked."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.experiments.plots import COLOURS, GREY, panels
from freqgs_plugin.reports.report.drawn import SHOWN
from freqgs_plugin.reports.report.front import pareto_front
from freqgs_plugin.reports.report.tables import points_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Point = Mapping[str, Any]
Cost = Callable[[Point], float | int]

ERRORS = {"rmse": "RMSE", "1-ssim": "1 - SSIM"}
COSTS: dict[str, tuple[str, str, Cost]] = {
    "error_time": ("render time", "ms per picture", lambda p: p["render"]["median_ms"]),
    "error_bytes": ("bytes", "MB of drawn Gaussians", lambda p: p["bytes"] / 1e6),
    "error_count": ("count", "Gaussians drawn, thousands", lambda p: p["drawn"] / 1000),
}
"""file -> what it is called, the axis, and the value"""
_NAME_WIDTH, _NAME_HEIGHT = 32, 12
"""of a point's name, pixels"""
_MARKERS = {"prefixes": "s", "scales": "o", "shares": "^"}


def front_of(record: Mapping[str, Any], cost: Cost, error: str) -> list[int]:
    """Numbers of the points on the Pareto front; at their own size prefixes do not compete."""
    return pareto_front([(cost(point), point[error]) for point in points_of(record)])


def figures(record: Mapping[str, Any]) -> "dict[str, Figure]":
    """File name without its ending -> picture; the last one only where a run was evaluated during training."""
    found = {name: _against(record, *what) for name, what in COSTS.items()}
    if any(run["training"]["points"] for run in record["runs"]):
        found["error_training"] = _training(record)
    return found


def _against(record: Mapping[str, Any], title: str, label: str, cost: Cost) -> "Figure":
    figure, axes = panels(2, width=5.6, height=4.4)
    for axis, (error, name) in zip(axes, ERRORS.items(), strict=True):
        for text, style, points in _lines(record):
            x, y = [cost(p) for p in points], [p[error] for p in points]
            axis.plot(x, y, ms=4.5, lw=1.2, label=text, **style)
            if label.startswith("ms"):
                spread = [[p["render"]["median_ms"] - p["render"]["low_ms"] for p in points]]
                spread += [[p["render"]["high_ms"] - p["render"]["median_ms"] for p in points]]
                axis.errorbar(x, y, xerr=spread, fmt="none", ecolor=style["color"], elinewidth=0.8, alpha=0.7)
            else:
                _own_size(axis, points, cost, error, style["color"], text)
        _mark(axis, record, cost, error)
        axis.set(xlabel=label, ylabel=name)
        axis.margins(x=0.08, y=0.08)
        _logarithmic(axis, [cost(p) for p in points_of(record)])
        _name(axis, record, cost, error)
    return _finish(figure, axes[0], f"Held-out error against {title}", record)


def _lines(record: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any], Sequence[Point]]]:
    for i, run in enumerate(record["runs"]):
        for series in run["series"]:
            style = {"color": COLOURS[i % len(COLOURS)], "marker": _MARKERS[run["kind"]], "ls": "-"}
            if run["kind"] == "shares":
                style["ls"] = "--"
                style["marker"] = "v" if series["name"] == SHOWN else "^"
                style["markerfacecolor"] = "white" if series["name"] == SHOWN else style["color"]
            text = run["name"] + (f", {series['name']}" if series["name"] else "")
            yield text, style, series["points"]


def _own_size(axis: Any, points: Sequence[Point], cost: Cost, error: str, colour: str, text: str) -> None:
    """A prefix judged at its own size, apart from the front: an easier task."""
    own = [point for point in points if point["own"] is not None]
    if own:
        x, y = [cost(p) for p in own], [p["own"][error] for p in own]
        axis.plot(x, y, color=colour, marker="s", mfc="white", ms=4.5, lw=0.8, ls=":", label=f"{text}, at its own size")


def _name(axis: Any, record: Mapping[str, Any], cost: Cost, error: str) -> None:
    """Points by name, the first and the last of each line before the others; none where another name stands."""
    lines = [(style["color"], points) for _, style, points in _lines(record)]
    ends = [(colour, point) for colour, points in lines for point in (points[0], points[-1])]
    between = [(colour, point) for colour, points in lines for point in points[1:-1]]
    taken: list[Any] = []
    for colour, point in (*ends, *between):
        place = (cost(point), point[error])
        if not all(math.isfinite(value) for value in place):
            continue
        x, y = axis.transData.transform(place)
        if all(abs(x - left) > _NAME_WIDTH or abs(y - low) > _NAME_HEIGHT for left, low in taken):
            taken.append((x, y))
            text = point["label"].removeprefix("s_v ")
            axis.annotate(text, place, (5, 5), textcoords="offset points", fontsize=7, color=colour)


def _mark(axis: Any, record: Mapping[str, Any], cost: Cost, error: str) -> None:
    points = points_of(record)
    front = [points[i] for i in front_of(record, cost, error)]
    x, y = [cost(p) for p in front], [p[error] for p in front]
    axis.plot(x, y, drawstyle="steps-post", color=GREY, lw=0.8, zorder=1)
    axis.plot(x, y, ls="none", marker="o", ms=10, mfc="none", mec="black", mew=1.0, label="Pareto front")


def _logarithmic(axis: Any, values: Sequence[float | int]) -> None:
    positive = [value for value in values if 0 < value < math.inf]
    if positive and max(positive) > 5 * min(positive) and len(positive) == len(values):
        from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.xaxis.set_minor_formatter(NullFormatter())


def _training(record: Mapping[str, Any]) -> "Figure":
    figure, axes = panels(2, width=5.6, height=4.4)
    for axis, (error, name) in zip(axes, ERRORS.items(), strict=True):
        for i, run in enumerate(record["runs"]):
            points, colour = run["training"]["points"], COLOURS[i % len(COLOURS)]
            if not points:
                continue
            x, y = [p["seconds"] for p in points], [p[error] for p in points]
            axis.plot(x, y, color=colour, marker="o", ms=4, lw=1.2, label=run["name"])
            if points[-1]["source"] == "checkpoint":
                axis.plot(x[-1:], y[-1:], color=colour, marker="*", ms=12, ls="none")
        axis.set(xlabel="seconds of training (evaluation excluded)", ylabel=name)
        axis.set_xlim(left=0)
    return _finish(figure, axes[0], "Held-out error against training time (star: the checkpoint)", record)


def _finish(figure: "Figure", axis: Any, title: str, record: Mapping[str, Any]) -> "Figure":
    from freqgs_plugin.reports.report.circumstances import short

    handles, labels = axis.get_legend_handles_labels()
    # of what stands in several panels or lines once
    kept = dict(zip(labels, handles, strict=True))
    place = {"loc": "outside lower center", "ncols": 3, "fontsize": 8, "frameon": False}
    legend = figure.legend(kept.values(), kept.keys(), title=short(record), title_fontsize=6, **place)
    legend.get_title().set_color(GREY)
    figure.suptitle(title, fontsize=11)
    return figure
