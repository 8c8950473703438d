"""`freqgs bench step`: what a whole training step of lapsplat consists of, stage by stage."""

import json
import os
import sys
import tempfile
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from freqgs_plugin.reports.bench.options import BenchError, BenchOptions
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.tables import BenchTable, Row, number
from freqgs_plugin.reports.child import child

COMPOSITING = ("compositing", "compositing, backward")
"""its two kernels"""
RASTERIZER = (*COMPOSITING, "binning", "projection", "projection, backward", "rasterizer, around its kernels")
"""all that a `Rasterizer` does, from splats to a picture and back"""
TICKS = 20
SEED = 42


def step_bench(options: BenchOptions, data: Path, steps: int) -> Bench:
    """The benchmark: one run of `steps` training steps on the folder `data`.

    Raises:
        BenchError: no such folder, or too few steps.
    """
    if not data.is_dir():
        raise BenchError(f"{data} is no folder; name one with a COLMAP model and its images, or a transforms.json")
    if steps < 100:
        raise BenchError(f"--steps {steps}: the stages of so short a run are not told apart; take at least 100")

    def measure(tick: Tick) -> Measured:
        stages = run_profile(data, steps, options.threads, tick)
        table = step_table(part_rows(stages), stages, steps)
        return Measured([table], {"training": SEED}, remarks=[outside_compositing(stages)])

    return Bench("step", ("step",), TICKS, measure)


def run_profile(data: Path, steps: int, threads: int, tick: Tick) -> dict[str, Any]:
    """Stage -> its sums, from a process of its own.

    Raises:
        BenchError: training failed; the message holds the end of its output.
    """
    with tempfile.TemporaryDirectory(prefix="freqgs-bench-") as folder:
        spec, result = Path(folder) / "spec.json", Path(folder) / "result.json"
        spec.write_text(json.dumps({"data": str(data.resolve()), "output": folder, "steps": steps, "seed": SEED}))
        command = [sys.executable, "-m", "freqgs_plugin.studio.step_profile", str(spec), str(result)]
        counts = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), str(threads))
        tail, ticked = deque(maxlen=25), 0
        with child(command, {**os.environ, **counts}) as process:
            assert process.stdout is not None
            tick("starting")
            for line in process.stdout:
                name, _, step = line.partition("step: ")
                if name or not step.strip().isdigit():
                    tail.append(line)
                    continue
                reached = int(step) * (TICKS - 1) // max(steps - 1, 1)
                for _ in range(ticked, reached):
                    tick(f"step {int(step)} of {steps}")
                ticked = max(ticked, reached)
        code = process.returncode
        if code or not result.is_file():
            raise BenchError(f"training ended with exit status {code}; the end of its output:\n{''.join(tail)}")
        return json.loads(result.read_text(encoding="utf-8"))


def part_rows(stages: Mapping[str, Any]) -> list[Row]:
    """One row per part: seconds per step of each stage, and share of the whole run; the largest first."""
    total = sum(stage["seconds"] for stage in stages.values())
    names = dict.fromkeys(name for stage in stages.values() for name in stage["parts"])
    rows = []
    for name in names:
        seconds = {number: stage["parts"].get(name, 0.0) for number, stage in stages.items()}
        rows.append(
            {
                "part": name,
                "milliseconds": {k: 1000 * s / stages[k]["steps"] for k, s in seconds.items()},
                "share": sum(seconds.values()) / total,
                "last_share": _last(seconds) / _last(stages)["seconds"],
            }
        )
    return sorted(rows, key=lambda row: -row["share"])


def _last(by_stage: Mapping[str, Any]) -> Any:
    return by_stage[max(by_stage, key=int)]


def outside(stages: Sequence[Any], parts: Collection[str]) -> float:
    """Share of these stages' time outside of `parts`."""
    inside = sum(stage["parts"].get(name, 0.0) for stage in stages for name in parts)
    return 1 - inside / sum(stage["seconds"] for stage in stages)


def outside_compositing(stages: Mapping[str, Any]) -> str:
    """What is outside, by the narrowest meaning of compositing and by the widest."""

    def shares(parts: Collection[str]) -> str:
        whole, last = (100 * outside(of, parts) for of in (list(stages.values()), [_last(stages)]))
        return f"{whole:.1f} % of the whole run, {last:.1f} % of its last stage"

    return (
        f"outside of the rasterizer (projection, binning and compositing, both directions): {shares(RASTERIZER)}; "
        f"outside of its two compositing kernels alone: {shares(COMPOSITING)}"
    )


def step_table(rows: list[Row], stages: Mapping[str, Any], steps: int) -> BenchTable:
    def stage_column(key: str) -> Any:
        return (f"stage {key}, ms", lambda row: number(row["milliseconds"][key]))

    whole = {
        "part": "a whole step",
        "milliseconds": {k: 1000 * stage["seconds"] / stage["steps"] for k, stage in stages.items()},
        "share": 1.0,
        "last_share": 1.0,
    }
    census = "; ".join(
        f"stage {k}: {stage['steps']:,} steps, {stage['gaussians']:,} Gaussians at its end"
        for k, stage in stages.items()
    )
    held_up = sum(stage["held_up"] for stage in stages.values())
    return BenchTable(
        "step",
        "A training step of lapsplat",
        [*rows, whole],
        [
            ("part", lambda row: row["part"]),
            *(stage_column(key) for key in stages),
            ("last stage", lambda row: f"{100 * row['last_share']:.1f} %"),
            ("whole run", lambda row: f"{100 * row['share']:.1f} %"),
        ],
        f"Means over the steps of a run of {steps:,} steps; {census}. Each part is without the parts that it calls. "
        f"{outside_compositing(stages).capitalize()}."
        + (f" {held_up} steps in which the system stopped the process are not counted." if held_up else ""),
    )
