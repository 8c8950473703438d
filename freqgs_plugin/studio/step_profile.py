"""Where the time of a training step goes: `python -m freqgs_plugin.studio.step_profile SPEC.json RESULT.json`.

A process of its own, because functions are replaced by timed ones and nerfstudio keeps global state. It trains through
nerfstudio's own trainer, as ns-train does, on the CPU. Prints `step: N` for each step.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import wraps
from pathlib import Path
from statistics import median
from typing import Any

MARK = "step: "
"""in front of the number of a finished step"""
REST = "nerfstudio: the rest of its loop"
"""part of what no timed function covers"""
WARM_UP = 10
"""first steps, which are not counted"""
HELD_UP = 20.0
"""times the median of its stage: no step takes so long by itself"""


@dataclass(frozen=True)
class ProfileSpec:
    """One run."""

    data: str
    """a COLMAP folder, or one with a transforms.json"""
    output: str
    """folder for what the trainer writes"""
    steps: int
    seed: int = 42


@dataclass
class StageProfile:
    """Sums over the steps of one stage."""

    steps: int = 0
    seconds: float = 0.0
    """from the beginning of each step to the beginning of the next"""
    parts: dict[str, float] = field(default_factory=dict)
    """part -> seconds, the parts that it calls left out"""
    gaussians: int = 0
    """at the stage's end"""
    held_up: int = 0
    """steps that were left out"""

    def add(self, seconds: float, parts: dict[str, float]) -> None:
        """Count one step; what its parts do not cover is nerfstudio's."""
        self.steps += 1
        self.seconds += seconds
        for name, spent in {**parts, REST: seconds - sum(parts.values())}.items():
            self.parts[name] = self.parts.get(name, 0.0) + spent


class Sections:
    """Seconds spent in named functions, each without what it spends in other named functions."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self._clock = clock
        self._inner: list[float] = []

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Time a block under `name`."""
        start = self._clock()
        self._inner.append(0.0)
        try:
            yield
        finally:
            whole, inner = self._clock() - start, self._inner.pop()
            self.seconds[name] = self.seconds.get(name, 0.0) + whole - inner
            if self._inner:
                self._inner[-1] += whole

    def timed(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        """`function`, timed under `name`."""

        # nerfstudio reads its callbacks' signatures
        @wraps(function)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            with self.section(name):
                return function(*args, **kwargs)

        return wrapped

    def replace(self, owner: Any, attribute: str, name: str) -> None:
        """Put the timed function into a module or a class; static methods stay static."""
        function = getattr(owner, attribute)
        wrapped = self.timed(function, name)
        is_static = isinstance(getattr(owner, "__dict__", {}).get(attribute), staticmethod)
        setattr(owner, attribute, staticmethod(wrapped) if is_static else wrapped)

    def take(self) -> dict[str, float]:
        """What was gathered since the last call."""
        taken, self.seconds = self.seconds, {}
        return taken


def instrument(sections: Sections) -> None:
    """Replace the functions that a step of lapsplat consists of by timed ones."""
    import torch
    from nerfstudio.engine.optimizers import Optimizers

    from freqgs_plugin.functional import compiled_terms
    from freqgs_plugin.functional.compiled_harmonics import CompiledColours
    from freqgs_plugin.rendering import numba_backend
    from freqgs_plugin.rendering import render as render_module
    from freqgs_plugin.studio import lapsplat
    from freqgs_plugin.studio.datamanager import SceneDatamanager
    from freqgs_plugin.studio.model import FreqSplatModel

    compiled = {
        "project": "projection",
        "project_backward": "projection, backward",
        "depth_order": "binning",
        "tile_lists": "binning",
        "composite": "compositing",
        "composite_backward": "compositing, backward",
    }
    for attribute, name in compiled.items():
        sections.replace(numba_backend, attribute, name)
    sections.replace(numba_backend.NumbaRasterizer, "_render", "rasterizer, around its kernels")
    sections.replace(numba_backend._Composite, "backward", "rasterizer, around its kernels")
    sections.replace(render_module, "level_colours", "harmonics and colours")
    for direction in ("forward", "backward"):
        sections.replace(CompiledColours, direction, "harmonics and colours")
        sections.replace(compiled_terms.CompiledTerms, direction, "loss: around its kernels")
    losses = {
        "image_sums": "loss: L1 and SSIM",
        "distance": "loss: frequency term",
        "halve": "loss: REDUCE",
        "add_halving_gradient": "loss: REDUCE",
    }
    for attribute, name in losses.items():
        sections.replace(compiled_terms, attribute, name)
    sections.replace(lapsplat, "pyramid_objective", "loss: around its kernels")
    sections.replace(FreqSplatModel, "_training_targets", "loss: targets")
    sections.replace(torch.Tensor, "backward", "autograd: the rest of backward")
    sections.replace(FreqSplatModel, "get_outputs", "model: activations, cameras")
    sections.replace(FreqSplatModel, "get_loss_dict", "loss: around its kernels")
    sections.replace(lapsplat.LapSplatModel, "get_metrics_dict", "metrics")
    sections.replace(FreqSplatModel, "_check_gradients", "guard: finite gradients")
    sections.replace(FreqSplatModel, "_begin_step", "densification and stages")
    sections.replace(lapsplat.LapSplatModel, "_begin_step", "densification and stages")
    sections.replace(FreqSplatModel, "_after_step", "densification and stages")
    for attribute in ("optimizer_scaler_step_some", "zero_grad_some", "scheduler_step_all"):
        sections.replace(Optimizers, attribute, "Adam")
    sections.replace(SceneDatamanager, "next_train", "nerfstudio: next image")


@dataclass(frozen=True)
class _Step:
    seconds: float
    parts: dict[str, float]
    gaussians: int


class Recorder:
    """Steps by stage; `begin` is called when a step begins and the one before it ends."""

    def __init__(self, sections: Sections, clock: Callable[[], float] = time.perf_counter) -> None:
        self._steps: dict[int, list[_Step]] = {}
        self._sections, self._clock = sections, clock
        self._open: float | None = None
        self._begun = 0

    def begin(self, stage: int, gaussians: int) -> None:
        """A step begins. The one before it was of `stage`, left so many Gaussians, and counts if past the warm-up."""
        now, parts = self._clock(), self._sections.take()
        if self._open is not None:
            self._steps.setdefault(stage, []).append(_Step(now - self._open, parts, gaussians))
        self._begun += 1
        self._open = now if self._begun > WARM_UP else None

    def stages(self) -> dict[int, StageProfile]:
        """The sums. A step of over HELD_UP times its stage's median is not counted: the system stopped the process."""
        found = {}
        for stage, steps in self._steps.items():
            bound = HELD_UP * median(step.seconds for step in steps)
            profile = found[stage] = StageProfile(gaussians=steps[-1].gaussians)
            for step in steps:
                if step.seconds > bound:
                    profile.held_up += 1
                else:
                    profile.add(step.seconds, step.parts)
        return found


def trainer_config(spec: ProfileSpec) -> Any:
    """What ns-train makes of the same arguments; evaluation, checkpoints and the viewer are off."""
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    never = str(spec.steps + 1)
    arguments = [
        "lapsplat",
        *("--data", spec.data, "--output-dir", spec.output, "--experiment-name", "profile", "--timestamp", "run"),
        *("--max-num-iterations", str(spec.steps), "--machine.seed", str(spec.seed), "--machine.device-type", "cpu"),
        *("--steps-per-save", never, "--steps-per-eval-image", "0", "--steps-per-eval-all-images", "0"),
        *("--pipeline.model.rasterizer", "numba", "--vis", "tensorboard"),
        *("--logging.local-writer.max-log-size", "0"),
    ]
    if not (Path(spec.data) / "transforms.json").is_file():
        arguments += ["colmap", "--eval-mode", "interval", "--eval-interval", "8"]
    config = tyro.cli(AnnotatedBaseConfigUnion, args=arguments)
    config.pipeline.datamanager.data = config.data
    return config


def profile(spec: ProfileSpec, on_step: Callable[[int], object]) -> dict[int, StageProfile]:
    """Train, and return what each stage's steps consist of."""
    from nerfstudio.scripts.train import train_loop

    from freqgs_plugin.studio.model import FreqSplatModel

    sections = Sections()
    recorder = Recorder(sections)
    instrument(sections)
    before_step = FreqSplatModel._before_step

    def marked(self: FreqSplatModel, step: int) -> None:
        on_step(step)
        recorder.begin(self.num_levels, self.num_points)
        before_step(self, step)

    FreqSplatModel._before_step = marked
    train_loop(0, 1, trainer_config(spec))
    # the last step has no successor, and ends with a checkpoint: it is left out
    return recorder.stages()


def main(spec_path: str, result_path: str) -> None:
    spec = ProfileSpec(**json.loads(Path(spec_path).read_text(encoding="utf-8")))
    stages = profile(spec, lambda step: print(f"{MARK}{step}", flush=True))
    text = json.dumps({stage: asdict(found) for stage, found in stages.items()})
    Path(result_path).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
