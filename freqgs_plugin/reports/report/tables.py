"""The tables of a report, from its record: for the terminal and Markdown; and its rows as CSV."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from freqgs_plugin.reports.bench.tables import BenchTable, Row, number

NONE = "-"
_WAYS = {"prefixes": "prefixes of levels", "scales": "sweep of s_v", "shares": "cuts"}

POINTS_NOTE = (
    "*PSNR*, *RMSE* (of full intensity 1; the geometric mean over views, which is 10^(-PSNR/20)), *SSIM* and *LPIPS* "
    "are means over the held-out views, of pictures clamped to [0, 1] against the photographs. *Own size*: picture and "
    "photograph both reduced to the prefix's size. *Drawn*: Gaussians passed to the rasterizer, mean over views; *MB*: "
    "of their float32 parameters, 10^6 bytes, as budgets count them. *ms*: median and quartiles of warm, repeated "
    "renderings of one picture, nothing else (ns-eval's fps also times the metrics). Cuts of a plain model are made "
    "once, before the clock starts; prefixes and s_v are chosen anew in every picture, as a viewer does. \\* : on the "
    "Pareto front of RMSE against ms."
)
LEFT_OUT_COLUMNS = (("run", "run"), ("what", "what"), ("left out", "done"), ("not done, and what it would buy", "more"))
LEFT_OUT_NOTE = "What the scene does not need, as training (levels) and `freqgs trim` found."
HEALTH_NOTE = (
    "*Clamped*: pixels with a colour outside of [0, 1] before clamping, at full detail; *range*: the extremes there. "
    "*Dead decay*: Gaussians whose sigma has come to the bound. *Near-degenerate*: the shortest standard deviation is "
    "under 1/4096 of the longest, which a float32 covariance cannot hold. *Skipped*: training steps whose loss or "
    "gradients were not finite."
)


def points_of(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every point of every series, with the names of its run and series."""
    return [
        {"run": run["name"], "series": series["name"], **point}
        for run in record["runs"]
        for series in run["series"]
        for point in series["points"]
    ]


def tables(record: Mapping[str, Any], front: Sequence[int]) -> list[BenchTable]:
    """All tables; `front` are the numbers of the points on the Pareto front of RMSE against time."""
    return [_runs(record), _points(record, set(front)), *_training(record), *_left_out(record), _health(record)]


def _left_out(record: Mapping[str, Any]) -> list[BenchTable]:
    """No table where nothing was left out."""
    rows = [{"run": run["name"], **row} for run in record["runs"] for row in run["left_out"]]
    columns = [(name, lambda row, key=key: row[key] or NONE) for name, key in LEFT_OUT_COLUMNS]
    return [BenchTable("report-left-out", "Left out", rows, columns, LEFT_OUT_NOTE)] if rows else []


def _runs(record: Mapping[str, Any]) -> BenchTable:
    return BenchTable(
        "report-runs",
        "Runs",
        record["runs"],
        [
            ("run", lambda row: row["name"]),
            ("method", lambda row: row["method"]),
            ("measured", lambda row: _WAYS[row["kind"]]),
            ("steps", lambda row: f"{row['steps']:,}"),
            ("checkpoint", lambda row: f"step {row['checkpoint_step']:,}"),
            ("seed", seeds),
            ("Gaussians", lambda row: f"{row['gaussians']:,}"),
            ("bytes each", lambda row: f"{row['bytes_each']}"),
            ("training", lambda row: _seconds(row["training"]["seconds"])),
            ("rasterizer", lambda row: row["rasterizer"]),
        ],
        "*Training*: seconds of training steps alone, from the log.",
    )


def _points(record: Mapping[str, Any], front: set[int]) -> BenchTable:
    rows: list[Row] = [{"number": i, **point} for i, point in enumerate(points_of(record))]
    return BenchTable(
        "report-points",
        "Held-out error, and what it costs",
        rows,
        [
            ("run", lambda row: row["run"] + (f", {row['series']}" if row["series"] else "")),
            ("drawn part", lambda row: row["label"] + (" *" if row["number"] in front else "")),
            ("PSNR, dB", lambda row: f"{row['psnr']:.2f}"),
            ("RMSE", lambda row: f"{row['rmse']:.4f}"),
            ("SSIM", lambda row: f"{row['ssim']:.4f}"),
            ("1-SSIM", lambda row: f"{row['1-ssim']:.4f}"),
            ("LPIPS", lambda row: "not computed" if row["lpips"] is None else f"{row['lpips']:.4f}"),
            ("PSNR, own size", lambda row: _own(row, "psnr", ".2f")),
            ("SSIM, own size", lambda row: _own(row, "ssim", ".4f")),
            ("drawn", lambda row: f"{row['drawn']:,.0f}"),
            ("MB", lambda row: f"{row['bytes'] / 1e6:.2f}"),
            ("ms", lambda row: _time(row["render"])),
            ("ms per million pixels", lambda row: number(row["ms_per_megapixel"])),
            ("clamped", lambda row: f"{100 * row['clamped']['share']:.2f} %"),
        ],
        POINTS_NOTE,
    )


def _training(record: Mapping[str, Any]) -> list[BenchTable]:
    rows: list[Row] = [{"run": run["name"], **p} for run in record["runs"] for p in run["training"]["points"]]
    if not rows:
        return []
    return [
        BenchTable(
            "report-training",
            "Held-out error during training",
            rows,
            [
                ("run", lambda row: row["run"]),
                ("step", lambda row: f"{row['step']:,}"),
                ("seconds", lambda row: f"{row['seconds']:.1f}"),
                ("PSNR, dB", lambda row: f"{row['psnr']:.2f}"),
                ("RMSE", lambda row: f"{row['rmse']:.4f}"),
                ("1-SSIM", lambda row: f"{row['1-ssim']:.4f}"),
                ("from", lambda row: row["source"]),
            ],
            "*Seconds*: of training steps alone; evaluation and saving are left out.",
        )
    ]


def _health(record: Mapping[str, Any]) -> BenchTable:
    return BenchTable(
        "report-health",
        "Numerical health",
        record["runs"],
        [
            ("run", lambda row: row["name"]),
            ("clamped", lambda row: f"{100 * row['health']['clamped']['share']:.2f} %"),
            ("range", lambda row: _range(row["health"]["clamped"])),
            ("dead decay", lambda row: _dead(row["health"]["dead_decay"])),
            ("near-degenerate", lambda row: _degenerate(row["health"]["scales"])),
            ("not finite: parameters", lambda row: _counts(row["health"]["parameters"])),
            ("pixels", lambda row: f"{row['health']['clamped']['non_finite']:,}"),
            ("skipped steps", lambda row: _skipped(row["health"]["training"])),
            ("not finite: log", lambda row: _logged(row["health"]["training"]["scalars"])),
        ],
        HEALTH_NOTE,
    )


def seeds(row: Mapping[str, Any]) -> str:
    """Of a run: one number where machine and model have the same."""
    machine, model = row["seeds"]["machine"], row["seeds"]["model"]
    return str(model) if machine == model else f"{model}, machine {machine}"


def _seconds(value: float | int | None) -> str:
    return NONE if value is None else f"{value:.0f} s"


def _own(row: Row, name: str, form: str) -> str:
    return NONE if row["own"] is None else format(row["own"][name], form)


def _time(render: Mapping[str, Any]) -> str:
    return f"{number(render['median_ms'])} ({number(render['low_ms'])}-{number(render['high_ms'])})"


def _range(clamped: Mapping[str, Any]) -> str:
    return f"{clamped['lowest']:.2f} to {clamped['highest']:.2f}"


def _dead(dead: Mapping[str, Any] | None) -> str:
    return "no decay" if dead is None else f"{dead['count']:,} ({100 * dead['share']:.2f} %), at {dead['bound']:g}"


def _degenerate(scales: Mapping[str, Any]) -> str:
    return f"{scales['near_degenerate']:,} ({100 * scales['share']:.2f} %)"


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name}: {count:,} Gaussians" for name, count in counts.items()) or "none"


def _skipped(events: Mapping[str, Any]) -> str:
    if events["skipped_steps"] is None:
        return "not known"
    if not events["skipped_steps"]:
        return "none"
    first = f"first at {'step' if events['exact'] else 'or before step'} {events['first_step']:,}"
    return f"{events['skipped_steps']:,}, {first}"


def _logged(scalars: Mapping[str, int]) -> str:
    return ", ".join(f"{tag} from step {step:,}" for tag, step in scalars.items()) or "none"


def flat(record: Mapping[str, Any]) -> dict[str, Any]:
    """What every row of a CSV file repeats."""
    hardware, versions = record["hardware"], record["versions"]
    return {
        "date": record["date"],
        "commit": record["commit"],
        "processor": hardware["processor"],
        "gpu": hardware["gpu"],
        "threads": hardware["threads"],
        "versions": " ".join(f"{name}={found}" for name, found in versions.items()),
    }


def points_csv(record: Mapping[str, Any]) -> bytes:
    """A row per point."""
    runs = {run["name"]: run for run in record["runs"]}
    rows = []
    for point in points_of(record):
        run, own, render = runs[point["run"]], point["own"] or {}, point["render"]
        rows.append(
            {
                **{key: point[key] for key in ("run", "series", "label", "value", "psnr", "rmse", "ssim", "1-ssim")},
                "lpips": "not computed" if point["lpips"] is None else point["lpips"],
                "psnr_own_size": own.get("psnr"),
                "rmse_own_size": own.get("rmse"),
                "ssim_own_size": own.get("ssim"),
                **{key: point[key] for key in ("drawn", "bytes")},
                **{key: render[key] for key in ("median_ms", "low_ms", "high_ms", "repeats")},
                "ms_per_megapixel": point["ms_per_megapixel"],
                "clamped_share": point["clamped"]["share"],
                "method": run["method"],
                "steps": run["steps"],
                "seed": run["seeds"]["model"],
                "machine_seed": run["seeds"]["machine"],
                **flat(record),
            }
        )
    return _csv(rows)


def training_csv(record: Mapping[str, Any]) -> bytes:
    """A row per evaluation during training."""
    keys = ("step", "seconds", "psnr", "rmse", "ssim", "1-ssim", "source")
    return _csv(
        [
            {
                "run": run["name"],
                **{key: point[key] for key in keys},
                "seed": run["seeds"]["model"],
                "machine_seed": run["seeds"]["machine"],
                **flat(record),
            }
            for run in record["runs"]
            for point in run["training"]["points"]
        ]
    )


def _csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
