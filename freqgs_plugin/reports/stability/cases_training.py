"""Training: learning rates 0.1x to 1000x, and the steps after an optimizer restart, an opacity reset, a new level."""

import json
import math
import sys
import tempfile
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from freqgs_plugin.reports.child import child
from freqgs_plugin.reports.stability.case import Group, Row, Setting, StabilityError

STEPS = 400
EVENT = 120
"""step of the event"""
VIEWS, SIZE = 20, (80, 64)
WINDOW = 10
"""steps over which losses are averaged"""
RATES = (0.1, 0.3, 1.0, 3.0, 10.0)
DIVERGING = (30.0, 100.0, 1e3, 1e5)
"""rates at which nothing but finite numbers or a named error is asked for"""
_COMMON = {"steps_scale": 0.04, "least_refine_interval": 40, "max_gaussians": 4000}
_ONE_RESET = {"stop_reset_before_end": 22_000}
_NO_RESET = {"stop_reset_before_end": 30_000}
MARK = "rehearsal: "
"""in front of a record in the child's output; `studio.rehearsal` names the same"""


class RehearsalError(StabilityError):
    """The child process failed; the message holds the end of its output."""


@dataclass(frozen=True)
class TrainingCase:
    """A short run of `lapsplat` on a ray-traced scene: right if it ends better than flat pictures, or at least ends."""

    name: str
    spec: Mapping[str, Any]
    """fields of `studio.rehearsal.Rehearsal`"""
    bounded: bool = True
    """held-out pictures must be nearer to the photographs than flat ones of their mean colour"""
    event: bool = False
    """something happens at step EVENT"""
    returns: bool = False
    """after which the loss must come back to what it was"""
    group: Group = "training"
    large: bool = True

    @property
    def id(self) -> str:
        return f"{self.group}: {self.name}"

    def row(self, setting: Setting, record: Mapping[str, Any]) -> Row:
        """The outcome of a record that the child has printed."""
        rmse, error = record["rmse"], record["error"]
        finite = error == "" and rmse is not None and all(map(math.isfinite, record["losses"]))
        named = error.startswith(("NonFiniteError", "ValueError")) and not self.bounded
        passed = finite and (not self.bounded or (rmse < record["flat_rmse"] and record["skipped"] == 0))
        notes = [f"held-out RMSE {rmse:.3f}, flat {record['flat_rmse']:.3f}"] if rmse is not None else []
        if self.event and finite:
            before, highest, steps = recovery(record["losses"])
            passed = passed and (steps is not None or not self.returns)
            back = f"back after {steps} steps" if steps is not None else "not back"
            notes.append(f"loss {before:.3f} before, {highest:.3f} after, {back}")
        notes.append(f"guard: {record['skipped']} skipped, {record['first']}" if record["skipped"] else "guard: silent")
        return Row(
            self.group, self.name, setting.backend, setting.precision,
            "better than flat" if self.bounded else "finite or named error",
            error.splitlines()[0] if error else "value" if finite else "not finite",
            rmse, None, finite, 1000 * record["seconds"], passed or (named and not finite), "; ".join(notes),
        )  # fmt: skip


def recovery(losses: list[float]) -> tuple[float, float, int | None]:
    """Mean loss before EVENT, the highest mean after it, and how many steps it takes to be within 10 % of the first.

    Means are over WINDOW steps, as each step sees another photograph.
    """
    means = [sum(losses[i : i + WINDOW]) / WINDOW for i in range(len(losses) - WINDOW + 1)]
    before, after = means[EVENT - WINDOW], means[EVENT:]
    peak = max(range(len(after)), key=after.__getitem__)
    back = next((i for i in range(peak, len(after)) if after[i] <= 1.1 * before), None)
    return before, after[peak], back


def cases() -> list[TrainingCase]:
    everything = {**_COMMON, **_ONE_RESET, "num_levels": 2}
    out = [
        TrainingCase(f"learning rates x{rate:g}", {"rate": rate, "model": everything}, rate in RATES)
        for rate in (*RATES, *DIVERGING)
    ]
    events = {
        "optimizer restart": {"model": {**_COMMON, **_NO_RESET, "num_levels": 1}, "restart_at": EVENT},
        "opacity reset": {"model": {**_COMMON, **_ONE_RESET, "num_levels": 1}},
        # K = 2500 steps, scaled
        "new level": {
            "model": {**_COMMON, **_NO_RESET, "num_levels": 2, "multiresolution": False, "steps_scale": EVENT / 2500}
        },
    }
    for name, spec in events.items():
        for rate in (0.1, 1.0, 10.0):
            out.append(
                TrainingCase(
                    f"{name}, learning rates x{rate:g}", {**spec, "rate": rate}, rate >= 1.0, True, rate == 1.0
                )
            )
    out += [
        TrainingCase(f"steps under autocast to {dtype}", {"model": everything, "autocast": dtype})
        for dtype in ("bfloat16", "float16")
    ]
    return out


def run_training(cases: list[TrainingCase], setting: Setting) -> Iterator[Row]:
    """Rows of `cases`, one by one as they come from a child process.

    Raises:
        RehearsalError: the child failed.
    """
    with tempfile.TemporaryDirectory(prefix="freqgs-stability-") as folder:
        scene = Path(folder) / "scene"
        size = [str(side) for side in SIZE]
        _call("freqgs_plugin.cli", "demo", "--scene-only", str(scene), "--views", str(VIEWS), "--size", *size)
        specs = [
            {**case.spec, "name": f"run-{i}", "scene": str(scene), "output": folder, "steps": STEPS}
            for i, case in enumerate(cases)
        ]
        path = Path(folder) / "specs.json"
        path.write_text(json.dumps(specs), encoding="utf-8")
        records = _records("freqgs_plugin.studio.rehearsal", str(path))
        for case, record in zip(cases, records, strict=True):
            yield case.row(setting, record)


def _call(module: str, *arguments: str) -> None:
    for _ in _records(module, *arguments):
        pass


def _records(module: str, *arguments: str) -> Iterator[dict[str, Any]]:
    """Run a module in a process of its own; yields what it prints behind MARK, and ends it if we are ended."""
    tail: deque[str] = deque(maxlen=20)
    with child([sys.executable, "-m", module, *arguments]) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith(MARK):
                yield json.loads(line[len(MARK) :])
            else:
                tail.append(line)
    if process.returncode != 0:
        raise RehearsalError(f"{module} ended with exit status {process.returncode}:\n{''.join(tail)}")
