"""Runs nerfstudio's commands, and its trainer step by step."""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path

SIZE = (80, 64)
"""width and height of the images: the smallest for three levels, whose coarsest is trained at 16 px"""
STEPS = 150
SCALE = 0.02
"""of step constants: levels begin at steps 50 and 100"""
EVERY = 20
"""steps between two refinements"""
DECAY_START = 40
"""step from which clodsplat's opacities decay"""


@dataclass(frozen=True)
class Finished:
    """What a command left behind."""

    code: int
    text: str

    def __str__(self):
        return f"exit status {self.code}:\n{self.text[-6000:]}"


def command(name, *arguments, timeout=200, folder=None):
    """Run one of the installed nerfstudio commands as a user would, and read what it says."""
    beside = Path(sys.executable).with_name(name)
    program = str(beside) if beside.exists() else shutil.which(name)
    assert program, f"{name} is not installed"
    environment = {**os.environ, "TERM": "dumb"}
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [program, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            cwd=folder,
        )
        alarm = threading.Timer(timeout, process.kill)
        alarm.start()
        if hasattr(os, "wait4"):
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            _peaks.append(usage.ru_maxrss / 2**20)
        else:
            process.wait()
        alarm.cancel()
        output.seek(0)
        return Finished(process.returncode, output.read().decode(errors="replace"))


_peaks = [0.0]


def peak_gigabytes():
    """The most memory that any command so far had resident (Linux counts in kB)."""
    return max(_peaks)


def train_arguments(scene, output, *more, timestamp="run", method="lapsplat"):
    return [
        *(method, "--data", scene, "--output-dir", output, "--experiment-name", "small", "--timestamp", timestamp),
        *("--steps-per-eval-image", "60", "--steps-per-eval-batch", "50", "--steps-per-eval-all-images", "149"),
        *("--pipeline.model.steps-scale", SCALE, "--pipeline.model.least-refine-interval", EVERY),
        # runs of 150 steps: nothing but the pictures counts
        *("--pipeline.model.dropout", 0, "--pipeline.model.opacity-penalty", 0, "--pipeline.model.size-penalty", 0),
        *("--vis", "tensorboard"),
        *more,
        *("colmap", "--eval-mode", "interval", "--eval-interval", "4"),
    ]


def advance(trainer, steps, before=lambda step: None):
    """`steps` more steps of the trainer's own loop. `before(step)` is called between its callbacks and the step."""
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as Location

    out = None
    for step in range(trainer._start_step, trainer._start_step + steps):
        trainer.step = step
        trainer.pipeline.train()
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=Location.BEFORE_TRAIN_ITERATION)
        before(step)
        out = trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=Location.AFTER_TRAIN_ITERATION)
        trainer._start_step = step + 1
    return out


def save(trainer):
    """A checkpoint of the last step, and config.yml beside it; returns the folder of checkpoints."""
    trainer.config.save_config()
    trainer.save_checkpoint(trainer.step)
    return trainer.checkpoint_dir
