"""Runs nerfstudio's commands, and its trainer step by step."""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from freqgs_plugin.studio.checkpoint import load_run
from freqgs_plugin.studio.viewing import psnr, show

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
    peak: float
    """the most memory that it had resident, GB; 0 where the system does not tell"""

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
        peak = 0.0
        while process.poll() is None:
            peak = max(peak, high_water_mark(process.pid))
            time.sleep(0.05)
        alarm.cancel()
        output.seek(0)
        return Finished(process.returncode, output.read().decode(errors="replace"), peak)


def high_water_mark(pid):
    """The most memory that a process had resident, GB; 0 where Linux does not tell.

    Not `ru_maxrss`: a child's starts at what its parent, here the whole test run, had when it was forked.
    """
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 2**20


def train_arguments(scene, output, *more, timestamp="run", method="lapsplat"):
    return [
        *(method, "--data", scene, "--output-dir", output, "--experiment-name", "small", "--timestamp", timestamp),
        *("--steps-per-eval-image", "60", "--steps-per-eval-batch", "50", "--steps-per-eval-all-images", "149"),
        *("--pipeline.model.steps-scale", SCALE, "--pipeline.model.least-refine-interval", EVERY),
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


def in_render_thread(work):
    """What `work` returns in one of the viewer's render threads."""
    from nerfstudio.viewer.render_state_machine import RenderStateMachine

    class RenderThread(RenderStateMachine):
        def __init__(self):
            threading.Thread.__init__(self)

        def run(self):
            self.result = work()

    thread = RenderThread()
    thread.start()
    thread.join()
    return thread.result


def gains_over_mean_colour(config):
    """PSNR of each training view's full picture, less that of the photograph's own mean colour everywhere, dB."""
    run = load_run(config)
    gains = []
    for view in run.cameras("train"):
        with torch.no_grad():
            picture = show(run.model.draw(run.gaussians, view.camera, run.background).features)
        gains.append(float(psnr(picture, view.image) - psnr(view.image.mean((0, 1)).expand_as(view.image), view.image)))
    return gains
