"""What a run's tensorboard log tells: error against training time, and values that were not finite.

nerfstudio logs each step's `Train Iter (time)` as the mean over the last `max_buffer_size` steps. A step is the update
alone, with its callbacks; evaluation, checkpoints and loading lie outside. Sums of whole windows, one after another,
give the seconds from the first step to any later one.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_EVENTS = "events.out.tfevents.*"
_TIME = "Train Iter (time)"
_ALL = "Eval Images Metrics Dict (all images)/"
_SKIPPED = "Train Metrics Dict/skipped_steps"
_PAUSE = 100.0
"""median steps; what takes longer, and longer than `_LONG`, was no training"""
_LONG = 10.0
"""seconds"""
_REMEDY = "train with `--vis tensorboard --steps-per-eval-all-images 250`"

Series = Mapping[int, float | int]
"""step -> value"""


@dataclass(frozen=True)
class Evaluation:
    """All held-out views, evaluated during training."""

    step: int
    seconds: float
    """of training up to and with this step; evaluation and saving excluded"""
    psnr: float
    """dB"""
    ssim: float


@dataclass(frozen=True)
class TrainingLog:
    """What the log of a run holds."""

    evaluations: list[Evaluation] = field(default_factory=list)
    seconds: float | None = None
    """of training up to the last step of the log; None: not known"""
    last_step: int | None = None
    pauses: tuple[int, float] = (0, 0.0)
    """steps that took far longer than any training does, and their seconds, which are not counted"""
    missing: str = ""
    """why there is no error against training time, and what would make it"""
    skipped: int | None = None
    """steps that were skipped because they were not finite; None: not logged"""
    first_skipped: int | None = None
    """the first logged step by which one had been skipped"""
    non_finite: dict[str, int] = field(default_factory=dict)
    """scalar of the log that was not finite -> first such step"""


def read_log(folder: Path, window: int) -> TrainingLog:
    """The log in a run's folder; `window` is the run's `logging.max_buffer_size`."""
    # named after the second at which they were begun
    files = sorted(path for path in folder.glob(_EVENTS) if path.is_file())
    if not files:
        return TrainingLog(missing=f"has no tensorboard log: {_REMEDY}")
    parts = [part for part in (_read(path) for path in files) if part]
    if not parts:
        return TrainingLog(missing=f"has a tensorboard log in which nothing can be read; copy it again, or {_REMEDY}")
    return understand(parts, window)


def understand(parts: Sequence[Mapping[str, Series]], window: int) -> TrainingLog:
    """The same from what was read: one mapping of tags to series for each time that training was started."""
    seconds, problem = training_seconds([part.get(_TIME, {}) for part in parts], window)
    seconds, pauses = without_pauses(seconds)
    merged = _merged(parts)
    skipped = merged.get(_SKIPPED, {})
    bad = {tag: [step for step, value in series.items() if not math.isfinite(value)] for tag, series in merged.items()}
    found = TrainingLog(
        seconds=seconds[max(seconds)] if seconds else None,
        last_step=max(seconds) if seconds else None,
        pauses=pauses,
        skipped=round(max(skipped.values())) if skipped else None,
        first_skipped=min((step for step, value in skipped.items() if value > 0), default=None),
        non_finite={tag: min(steps) for tag, steps in sorted(bad.items()) if steps},
    )
    psnr, ssim = merged.get(_ALL + "psnr", {}), merged.get(_ALL + "ssim", {})
    evaluations = [Evaluation(s, seconds[s], psnr[s], ssim[s]) for s in sorted(psnr) if s in seconds and s in ssim]
    if not psnr:
        problem = f"was not evaluated during training: {_REMEDY}"
    if problem:
        return TrainingLog(**{**vars(found), "missing": problem})
    return TrainingLog(**{**vars(found), "evaluations": evaluations})


def training_seconds(parts: Sequence[Series], window: int) -> tuple[dict[int, float], str]:
    """Step -> seconds of training up to and with it, from windowed means; and why there are none.

    Each part is one start of the trainer. A later part replaces the steps that it did again: they were thrown away.
    """
    total: dict[int, float] = {}
    for means in (part for part in parts if part):
        first, last = min(means), max(means)
        if list(range(first, last + 1)) != sorted(means):
            return {}, "has a log with steps missing: its training time is not known"
        if first > 0 and first - 1 not in total:
            return {}, f"was continued at step {first:,} from a run whose log is elsewhere: its time is not known"
        before = total[first - 1] if first > 0 else 0.0
        total = {step: seconds for step, seconds in total.items() if step < first}
        for step in range(first, last + 1):
            done = step - first + 1
            if done <= window:
                total[step] = before + done * means[step]
            else:
                total[step] = total[step - window] + window * means[step]
    return (total, "") if total else ({}, "has a log without times of steps")


def without_pauses(total: Series) -> tuple[dict[int, float], tuple[int, float]]:
    """The same as if no step had been stopped; how many were, and for how many seconds in all.

    A process that is suspended, a machine that sleeps, and kernels that are compiled on first use show as single steps
    of over a hundred times the median.
    """
    steps = sorted(total)
    each = {step: total[step] - total.get(step - 1, 0.0) for step in steps}
    usual = statistics.median(each.values()) if each else 0.0
    stopped = {step for step in steps if each[step] > max(_PAUSE * usual, _LONG)}
    running, lost, kept = 0.0, 0.0, {}
    for step in steps:
        running += usual if step in stopped else each[step]
        lost += each[step] - usual if step in stopped else 0.0
        kept[step] = running
    return (kept, (len(stopped), lost)) if stopped else (dict(total), (0, 0.0))


def _merged(parts: Sequence[Mapping[str, Series]]) -> dict[str, dict[int, float]]:
    """All parts as one; of steps that were done twice the later ones."""
    merged: dict[str, dict[int, float]] = {}
    for part in parts:
        begin = min((min(series) for series in part.values() if series), default=0)
        for tag, series in merged.items():
            merged[tag] = {step: value for step, value in series.items() if step < begin}
        for tag, series in part.items():
            merged.setdefault(tag, {}).update(series)
    return merged


def _read(path: Path) -> dict[str, dict[int, float]]:
    """Tag -> step -> value of the scalars in one file; what was cut off at its end is left out."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    none: dict[str, Any] = dict.fromkeys(("images", "audio", "histograms", "compressedHistograms", "tensors"), 1)
    events = EventAccumulator(str(path), size_guidance={**none, "scalars": 0})
    events.Reload()
    return {tag: {e.step: e.value for e in events.Scalars(tag)} for tag in events.Tags()["scalars"]}
