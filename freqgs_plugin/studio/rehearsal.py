"""Short training runs that note the loss of every step: `python -m freqgs_plugin.studio.rehearsal SPECS.json`.

A process of its own, because nerfstudio keeps global state; one line of JSON per run on standard output.
"""

import copy
import json
import math
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from freqgs_plugin.io.parameters import GROUPS
from freqgs_plugin.studio.checkpoint import Run
from freqgs_plugin.studio.optimizers import restart

MARK = "rehearsal: "
"""in front of a line with a record"""


@dataclass(frozen=True)
class Rehearsal:
    """One run."""

    name: str
    scene: str
    """a COLMAP folder"""
    output: str
    """folder for what the trainer writes"""
    steps: int
    rate: float = 1.0
    """all learning rates are multiplied by this"""
    model: dict[str, Any] = field(default_factory=dict)
    """fields of the model's config"""
    method: str = "lapsplat"
    restart_at: int | None = None
    """step before which all optimizers forget their state"""
    autocast: str = ""
    """`bfloat16` or `float16`: steps run under autocast to it"""


@dataclass
class Record:
    """What became of it."""

    name: str
    losses: list[float] = field(default_factory=list)
    """of every step; may hold NaN"""
    rmse: float | None = None
    """root mean square error of the held-out pictures, colours in [0, 1]; None where there is none"""
    flat_rmse: float | None = None
    """the same for pictures of the photographs' mean colour"""
    gaussians: int = 0
    skipped: int = 0
    """steps that the guard dropped"""
    first: str = ""
    """what the guard said first"""
    error: str = ""
    """type and message of the error that ended the run"""
    seconds: float = 0.0


def rehearse(spec: Rehearsal) -> Record:
    """Train, and measure on the held-out views. An error that ends training is part of the record."""
    record = Record(spec.name)
    torch.manual_seed(0)
    trainer = _trainer(spec)
    model = trainer.pipeline.model
    start = time.perf_counter()
    try:
        for step in range(spec.steps):
            if step == spec.restart_at:
                restart(trainer.optimizers, GROUPS, schedulers=True)
            with _autocast(spec):
                record.losses.append(_step(trainer, step))
        record.seconds = time.perf_counter() - start
        record.rmse, record.flat_rmse = _errors(trainer)
    except (ArithmeticError, RuntimeError, ValueError) as error:
        record.error = f"{type(error).__name__}: {error}"
        record.seconds = time.perf_counter() - start
    record.skipped, record.first = model.guard.skipped, model.guard.first
    record.gaussians = model.num_points
    return record


def _trainer(spec: Rehearsal) -> Any:
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
    from nerfstudio.utils import writer

    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    config: Any = copy.deepcopy(all_methods[spec.method])
    manager = config.pipeline.datamanager
    manager.dataparser = ColmapDataParserConfig(eval_mode="interval", eval_interval=4)
    config.data = manager.data = Path(spec.scene)
    config.output_dir, config.experiment_name, config.timestamp = Path(spec.output), "rehearsal", spec.name
    config.max_num_iterations, config.vis = spec.steps, "tensorboard"
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    for name, value in spec.model.items():
        if not hasattr(config.pipeline.model, name):
            raise ValueError(f"the model of {spec.method} has no field '{name}'.")
        setattr(config.pipeline.model, name, value)
    for group in config.optimizers.values():
        group["optimizer"].lr *= spec.rate
        scheduler = group["scheduler"]
        if scheduler is not None and scheduler.lr_final is not None:
            scheduler.lr_final *= spec.rate
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    writer.EVENT_WRITERS.clear()
    return trainer


def _autocast(spec: Rehearsal) -> torch.autocast:
    """nerfstudio itself allows mixed precision on CUDA only."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    dtype = {"bfloat16": torch.bfloat16, "float16": torch.float16, "": None}[spec.autocast]
    return torch.autocast(device, dtype=dtype, enabled=dtype is not None)


def _step(trainer: Any, step: int) -> float:
    """One step of the trainer's own loop; returns the loss."""
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as Location

    trainer.step = step
    trainer.pipeline.train()
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=Location.BEFORE_TRAIN_ITERATION)
    loss = trainer.train_iteration(step)[0]
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=Location.AFTER_TRAIN_ITERATION)
    return float(loss.detach())


@torch.no_grad()
def _errors(trainer: Any) -> tuple[float, float]:
    """RMSE of the held-out pictures, and of flat ones in their photographs' mean colour."""
    run = Run(trainer.config, trainer.pipeline, trainer.step)
    trainer.pipeline.eval()
    model, squares, flat = trainer.pipeline.model, [], []
    for view in run.cameras("test"):
        picture = model.draw(run.gaussians, view.camera, run.background).features.clamp(0, 1)
        squares.append((picture - view.image).square().mean())
        flat.append((view.image - view.image.mean((0, 1))).square().mean())
    return math.sqrt(float(torch.stack(squares).mean())), math.sqrt(float(torch.stack(flat).mean()))


def main(path: str) -> None:
    """Run the specs in the JSON file at `path`, one after another."""
    for values in json.loads(Path(path).read_text(encoding="utf-8")):
        record = rehearse(Rehearsal(**values))
        print(MARK + json.dumps(asdict(record)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
