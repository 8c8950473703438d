"""Quality and time against the number of Gaussians, for several s_max (the paper's Figures 3 and 4)."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from freqgs_plugin.reports.bench.tables import BenchTable, Row, number
from freqgs_plugin.reports.drawing import TrainedRun, draw
from freqgs_plugin.reports.experiments.lab import Lab, LoadedRun
from freqgs_plugin.reports.experiments.measures import at_scale, quality
from freqgs_plugin.reports.experiments.options import ClodOptions
from freqgs_plugin.reports.experiments.plots import COLOURS, GREY, panels
from freqgs_plugin.reports.experiments.section import Part, Results
from freqgs_plugin.reports.experiments.seeds import mean, shown
from freqgs_plugin.reports.experiments.selection import MostOpaque
from freqgs_plugin.reports.experiments.training import Trial
from freqgs_plugin.reports.timing import interleaved

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCALES = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.5, 10.0)
"""values of s_v"""
SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2, 0.15, 0.1)
"""of the plain model's Gaussians, kept by opacity"""
ROUNDS = 5

INTRODUCTION = """\
PSNR, SSIM, Gaussians and milliseconds at twelve values of s_v, for models trained with different s_max: the paper's
Figures 3 and 4. Means over the held-out views; *Gaussians* are those drawn in the whole scene, as in the paper. *ms* is
the median of repeated renderings of the first held-out view, all scales in turn. *plain* is a model of one level
without decay (see [Methods](methods.md#one-level)) of which the most opaque Gaussians are kept; its column *s_v* holds
the share."""


def measure(lab: Lab, trial: Trial, options: ClodOptions) -> dict[str, Any]:
    """One series per s_max, and the plain model's."""
    series = by_largest_scale(lab, trial, options.s_max)
    training = trial.plain()
    more = {"shares": SHARES, "rounds": ROUNDS}
    plain = lab.step("curve-plain", [training], more, lambda: _at_shares(lab.run(training)))
    return {"clod": series, "plain": plain}


def by_largest_scale(lab: Lab, trial: Trial, s_max: Sequence[float]) -> dict[str, list[dict[str, Any]]]:
    """One series per s_max."""
    series = {}
    for largest in s_max:
        training = trial.clod(largest)
        more = {"scales": SCALES, "rounds": ROUNDS}
        series[f"{largest:g}"] = lab.step("curve", [training], more, lambda t=training: _at_scales(lab.run(t)))
    return series


def _at_scales(run: LoadedRun) -> list[dict[str, Any]]:
    return _series(run, {scale: at_scale(run, scale) for scale in SCALES}, "scale")


def _at_shares(run: LoadedRun) -> list[dict[str, Any]]:
    count = len(run.gaussians)
    kept = {share: MostOpaque(max(round(share * count), 1), within_view=False) for share in SHARES}
    return _series(run, kept, "share")


def _series(run: LoadedRun, attenuations: dict[float, Any], name: str) -> list[dict[str, Any]]:
    views = run.cameras("test")
    camera = views[0].camera
    times = interleaved(
        {f"{key:g}": lambda a=attenuation: _picture(run, camera, a) for key, attenuation in attenuations.items()},
        ROUNDS,
    )
    return [
        {
            name: key,
            "gaussians": len(run.gaussians),
            **asdict(quality(run, views, lambda _, a=attenuation: a)),
            "render": asdict(times[f"{key:g}"]),
        }
        for key, attenuation in attenuations.items()
    ]


def _picture(run: TrainedRun, camera: Any, attenuation: Any) -> Any:
    return draw(run, camera, attenuation).features


def tables(scene: str, results: Results) -> list[BenchTable]:
    """One row per model and s_v."""
    rows: list[Row] = []
    for model in results[0]["clod"]:
        of = [result["clod"][model] for result in results]
        rows += [_row(f"s_max {model}", f"{row['scale']:g}", of, i) for i, row in enumerate(of[0])]
    of = [result["plain"] for result in results]
    rows += [_row("plain", f"{100 * row['share']:.0f} %", of, i) for i, row in enumerate(of[0])]
    return [
        BenchTable(
            f"clod-curve-{scene}",
            f"{scene}: quality at different s_v",
            rows,
            [
                ("model", lambda row: row["model"]),
                ("s_v", lambda row: row["at"]),
                ("PSNR, dB", lambda row: shown(row["seeds"], lambda s: s["psnr"])),
                ("SSIM", lambda row: shown(row["seeds"], lambda s: s["ssim"], ".4f")),
                ("Gaussians", lambda row: shown(row["seeds"], lambda s: s["drawn"], ",.0f")),
                ("of all", lambda row: f"{100 * mean(row['seeds'], _share):.1f} %"),
                ("ms", lambda row: number(mean(row["seeds"], lambda s: s["render"]["median_ms"]))),
            ],
        )
    ]


def _row(model: str, at: str, of: list[Any], index: int) -> Row:
    return {"model": model, "at": at, "seeds": [series[index] for series in of]}


def _share(row: dict[str, Any]) -> float:
    return row["drawn"] / row["gaussians"]


def figures(scene: str, results: Results) -> "dict[str, Figure]":
    """PSNR and SSIM against the count; time against the count, and PSNR against pictures per second."""
    return {"quality": _quality_figure(scene, results), "speed": _speed_figure(scene, results)}


def _lines(results: Results) -> list[tuple[str, str, list[list[dict[str, Any]]], float | None]]:
    """Label, colour, each point's rows (one per seed), and the s_v that training ended at."""
    lines = []
    for i, model in enumerate(results[0]["clod"]):
        points = list(zip(*(result["clod"][model] for result in results), strict=True))
        lines.append((f"s_max {model}", COLOURS[i % len(COLOURS)], [list(p) for p in points], float(model)))
    points = list(zip(*(result["plain"] for result in results), strict=True))
    return [*lines, ("plain, most opaque", GREY, [list(p) for p in points], None)]


def _quality_figure(scene: str, results: Results) -> "Figure":
    figure, axes = panels(2)
    for each, (name, label) in zip(axes, (("psnr", "PSNR, dB"), ("ssim", "SSIM")), strict=True):
        for title, colour, points, largest in _lines(results):
            x = [mean(p, lambda s: s["drawn"]) / 1000 for p in points]
            y = [mean(p, lambda s, n=name: s[n]) for p in points]
            each.plot(x, y, color=colour, marker="o", ms=3.5, lw=1.2, ls="-" if largest else "--", label=title)
            trained = [xi for xi, p in zip(x, points, strict=True) if largest and p[0].get("scale", 0) <= largest]
            if trained and largest:
                each.axvline(min(trained), color=colour, lw=0.8, ls=":")
        each.set(xlabel="Gaussians drawn, thousands", ylabel=label)
    axes[0].legend(fontsize=8, title="dotted: s_v = s_max", title_fontsize=8)
    figure.suptitle(f"{scene}: quality against the number of Gaussians", fontsize=11)
    return figure


def _speed_figure(scene: str, results: Results) -> "Figure":
    figure, axes = panels(2)
    for title, colour, points, largest in _lines(results):
        time = [mean(p, lambda s: s["render"]["median_ms"]) for p in points]
        style = {"color": colour, "marker": "o", "ms": 3.5, "lw": 1.2, "ls": "-" if largest else "--", "label": title}
        axes[0].plot([mean(p, lambda s: s["drawn"]) / 1000 for p in points], time, **style)
        axes[1].plot([1000 / ms for ms in time], [mean(p, lambda s: s["psnr"]) for p in points], **style)
    axes[0].set(xlabel="Gaussians drawn, thousands", ylabel="ms per picture")
    axes[1].set(xlabel="pictures per second", ylabel="PSNR, dB")
    axes[0].legend(fontsize=8)
    figure.suptitle(f"{scene}: time", fontsize=11)
    return figure


PART = Part("curve", "Quality against s_v", INTRODUCTION, measure, tables, figures)
