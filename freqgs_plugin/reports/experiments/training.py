"""What is trained: scenes, and the settings of every run that an experiment compares."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from freqgs_plugin.training.presets import LARGEST_SCALE, PLAIN, Value
from freqgs_plugin.types import Camera

DEFAULT_SCALE = LARGEST_SCALE
"""s_max of clodsplat's default, of all runs but those of the sections curve, sigma and ablation"""
ABLATION_SCALE = 5.0
"""s_max of the ablation (the paper's: 5)"""
_LATER = {"auto_psnr": "30.0", "auto_share": "0.1", "least_level_gain": "0.0", "base_share": "1.0"}
"""options that a model has got since runs were kept, with the values at which they change nothing"""
_ONLY_SHOWN = {"detail_scales": "(1.0, 1.5, 2.0, 3.0, 5.0)"}
"""options that training does not read, with the value that stands for all"""
_DOWNSCALED = re.compile(r"images_\d+$")


@dataclass(frozen=True)
class ExperimentScene:
    """A scene to train on."""

    name: str
    folder: Path
    identity: str
    """changes with what is in the folder, and with nothing else"""
    dolly: tuple[Camera, ...] | None = None
    """a camera's way that changes distance at least tenfold, in the data set's frame; None: one is made"""


@dataclass(frozen=True)
class Training:
    """One run of ns-train."""

    scene: ExperimentScene
    method: str
    steps: int
    seed: int
    options: Mapping[str, Value] = field(default_factory=dict)
    """fields of the model's config that differ from its defaults"""

    def arguments(self) -> tuple[str, ...]:
        """The model's options for the command line."""
        options = {**self.options, "seed": self.seed}
        words = ((f"--pipeline.model.{name.replace('_', '-')}", str(value)) for name, value in options.items())
        return tuple(word for pair in words for word in pair)

    def settings(self, defaults: Mapping[str, str]) -> dict[str, Any]:
        """All that the result depends on, apart from the code: two trainings with equal settings are one.

        `defaults` are the model's config fields as `repr` shows them.
        """
        unknown = set(self.options) - set(defaults)
        assert not unknown, f"{self.method} has no options {sorted(unknown)}"
        model = {**defaults, **{name: repr(value) for name, value in self.options.items()}, "seed": repr(self.seed)}
        # so that what was trained before they were there is found again
        model = {name: _ONLY_SHOWN.get(name, value) for name, value in model.items() if _LATER.get(name) != value}
        return {"scene": self.scene.identity, "method": self.method, "steps": self.steps, "model": model}


@dataclass(frozen=True)
class Trial:
    """One scene and one seed: the trainings that belong to them."""

    scene: ExperimentScene
    steps: int
    seed: int

    def clod(self, largest_scale: float | int = DEFAULT_SCALE, more: Mapping[str, Value] | None = None) -> Training:
        """clodsplat with s_max = `largest_scale` and `more` options."""
        options = {"largest_scale": float(largest_scale), **(more or {})}
        return Training(self.scene, "clodsplat", self.steps, self.seed, options)

    def plain(self, max_gaussians: int = 0) -> Training:
        """One level, no decay; at most so many Gaussians by densification (0: any number)."""
        more: dict[str, Value] = {"max_gaussians": max_gaussians} if max_gaussians else {}
        return Training(self.scene, "lapsplat", self.steps, self.seed, {**PLAIN, **more})


def fingerprint(folder: Path, output_dir: Path | None = None) -> str:
    """A hash of names and sizes of all files of a scene.

    Images that nerfstudio downscaled itself do not count, nor what an experiment wrote into an `output_dir` below.
    """
    ours = None if output_dir is None else output_dir.resolve()
    files = (
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and not any(_DOWNSCALED.match(part) for part in path.relative_to(folder).parts)
        and (ours is None or not path.resolve().is_relative_to(ours))
    )
    text = "\n".join(f"{path.relative_to(folder).as_posix()} {path.stat().st_size}" for path in files)
    return f"{folder.resolve().name} {hashlib.sha256(text.encode()).hexdigest()[:16]}"
