"""Runs `ns-train` as a subprocess: its output goes to a log file, its steps to a progress bar."""

import re
import shlex
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from freqgs_plugin.reports.child import child

STEP = re.compile(r"^\s*(\d+) \(\d+(?:\.\d+)?%\)")
"""a line of nerfstudio's LocalWriter"""
STAGE = re.compile(r"level (\d+) of (\d+) begins")
"""a line of lapsplat's log"""


class TrainingError(RuntimeError):
    """ns-train ended with an error; the message holds the end of its log."""


@dataclass(frozen=True)
class TrainingRun:
    """One run of ns-train and where it leaves its files."""

    scene: Path
    output_dir: Path
    steps: int
    seed: int
    levels: int | None
    """of lapsplat; None: the method's default"""
    timestamp: str
    method: str = "lapsplat"
    experiment: str = "demo"
    options: tuple[str, ...] = ()
    """further arguments of the method"""
    evaluations: int = 0
    """how often all held-out views are evaluated during training, into the tensorboard log"""
    parser: tuple[str, ...] = ("colmap", "--colmap-path", "sparse/0", "--eval-mode", "interval", "--eval-interval", "8")
    """how the scene is read"""

    @property
    def folder(self) -> Path:
        """What nerfstudio makes of output folder, experiment, method and timestamp."""
        return self.output_dir / self.experiment / self.method / self.timestamp

    @property
    def config_path(self) -> Path:
        return self.folder / "config.yml"

    def arguments(self, *more: str) -> list[str]:
        """What follows `ns-train`."""
        levels = () if self.levels is None else ("--pipeline.model.num-levels", str(self.levels))
        every = max(self.steps // self.evaluations, 1) if self.evaluations else 0
        return [
            self.method,
            *("--data", str(self.scene)),
            *("--output-dir", str(self.output_dir)),
            *("--experiment-name", self.experiment),
            *("--timestamp", self.timestamp),
            *("--max-num-iterations", str(self.steps)),
            *("--steps-per-save", str(max(self.steps // 4, 1))),
            *("--steps-per-eval-image", "0"),
            *("--steps-per-eval-all-images", str(every)),
            *("--machine.seed", str(self.seed)),
            *levels,
            *self.options,
            *("--vis", "tensorboard"),
            *("--logging.local-writer.max-log-size", "0"),
            *more,
            *self.parser,
        ]

    def resume_hint(self) -> str:
        """How to go on after a stop."""
        checkpoints = self.folder / "nerfstudio_models"
        if not any(checkpoints.glob("step-*.ckpt")):
            return "No checkpoint was saved yet; run the same command again to start over."
        command = shlex.join(["ns-train", *self.arguments("--load-dir", str(checkpoints))])
        return f"To go on from the last checkpoint:\n  {command}"


def train(run: TrainingRun, log: Path, on_step: Callable[[int, str | None], None]) -> None:
    """Train until the end.

    Args:
        run: what to train.
        log: file for the trainer's output.
        on_step: called with the step and, where one begins, the name of the stage.

    Raises:
        TrainingError: ns-train failed; the message holds the end of the log.
        KeyboardInterrupt: passed on, after the child has ended.
    """
    command = [sys.executable, "-u", "-m", "nerfstudio.scripts.train", *run.arguments()]
    tail: deque[str] = deque(maxlen=25)
    with child(command) as process, log.open("w", encoding="utf-8") as file:
        assert process.stdout is not None
        file.write(shlex.join(command) + "\n")
        for line in process.stdout:
            file.write(line)
            file.flush()
            tail.append(line)
            _report(line, on_step)
    code = process.returncode
    if code != 0 or not run.config_path.is_file():
        raise TrainingError(
            f"ns-train ended with exit status {code}. All of its output is in {log}; the end:\n{''.join(tail)}"
        )


def _report(line: str, on_step: Callable[[int, str | None], None]) -> None:
    step, stage = STEP.match(line), STAGE.search(line)
    if stage:
        on_step(0, f"training level {stage[1]} of {stage[2]}")
    elif step:
        on_step(int(step[1]), None)
