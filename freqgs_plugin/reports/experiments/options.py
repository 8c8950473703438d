"""What the experiments can be told. Imports nothing heavy: the command line reads it."""

import shlex
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

Section = Literal["curve", "budget", "pops", "ablation", "sigma"]
SECTIONS: tuple[Section, ...] = get_args(Section)


LEAST_SIDE = 16
"""pixels of the demo scene's photographs: below that SSIM has no window to compare"""


class ExperimentError(RuntimeError):
    """An experiment that cannot be run as asked; the message holds the remedy."""


@dataclass(frozen=True)
class TrialOptions:
    """What every experiment can be told: scenes, the length of a run, seeds, and where the results go."""

    output_dir: Path = Path("experiment-out")
    """folder for trained runs, finished steps and results; a second start goes on from there"""
    scenes: tuple[Path, ...] = ()
    """folders of scenes, each with a COLMAP model or a transforms.json"""
    demo: bool = True
    """also the scene of `freqgs demo`, with a camera that zooms out"""
    steps: int = 3000
    """training steps of every run"""
    seeds: int = 1
    """runs of each setting, with seeds 42, 43 ...; tables show mean and spread. 2 where differences are under 0.3 dB"""
    frames: int = 200
    """steps of each sweep in which jumps are looked for"""
    views: int = 36
    """photographs of the demo scene"""
    size: tuple[int, int] = (320, 240)
    """width and height of the demo scene's photographs, pixels"""
    page_only: bool = False
    """train and measure nothing: write the page and pictures of what the folder holds"""
    docs: Path | None = None
    """also write the page there, and its pictures into images/ beside it"""

    def __post_init__(self) -> None:
        if not self.scenes and not self.demo:
            raise ExperimentError("there is no scene: name folders with --scenes, or leave out --no-demo")
        if self.steps < 1 or self.seeds < 1 or self.frames < 4:
            raise ExperimentError(
                f"--steps and --seeds must be at least 1 and --frames at least 4, not {self.steps}, {self.seeds} and "
                f"{self.frames}"
            )
        if self.views < 2 or min(self.size) < LEAST_SIDE:
            raise ExperimentError(
                f"--views must be at least 2 and both numbers of --size at least {LEAST_SIDE}, not {self.views} and "
                f"{self.size[0]} {self.size[1]}"
            )
        names = [folder.resolve().name for folder in self.scenes] + ["demo"] * self.demo
        if len(set(names)) < len(names):
            raise ExperimentError(f"scenes are told apart by the names of their folders, and these are: {names}")


@dataclass(frozen=True)
class ClodOptions(TrialOptions):
    """What is trained and measured, and where the results go."""

    output_dir: Path = Path("clod-out")
    """folder for trained runs, finished steps, clod.json, clod.md and pictures; a second start goes on from there"""
    only: tuple[str, ...] = SECTIONS
    """sections to run: curve, budget, pops, ablation, sigma, with spaces or commas between; others show what the
    folder holds of them"""
    s_max: tuple[float, ...] = (1.0, 3.0, 5.0, 7.0)
    """largest training scales that are compared (the sections curve and sigma)"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.s_max or not all(1 <= s < float("inf") for s in self.s_max):
            raise ExperimentError(f"--s-max {self.s_max}: name at least one number, each of them 1 or more")
        _ = self.sections

    @property
    def sections(self) -> tuple[Section, ...]:
        """What `only` names, in the usual order."""
        named = [name for item in self.only for name in item.split(",") if name]
        unknown = [name for name in named if name not in SECTIONS]
        if unknown or not named:
            raise ExperimentError(f"--only {' '.join(self.only)}: choose among {', '.join(SECTIONS)}")
        return tuple(name for name in SECTIONS if name in named)


@dataclass(frozen=True)
class ClaimsOptions(TrialOptions):
    """What is trained and measured, and where the results go."""

    output_dir: Path = Path("claims-out")
    """folder for trained runs, finished steps, claims.json and claims.md; a second start goes on from there. A folder
    of `freqgs experiment clod` serves as well: what it holds is not done again"""
    only: tuple[str, ...] = ()
    """what to measure: A-a, A-b ... B-d, goals, runs, levels, with spaces or commas between; without it everything.
    What else the folder holds is shown as well"""
    docs: Path | None = None
    """page in which each scene's tables are filled in, between the comments <!-- claims-A SCENE -->, <!-- claims-B
    SCENE -->, <!-- goals SCENE -->, <!-- runs SCENE -->, <!-- levels SCENE --> and their ends"""


def command_line(options: TrialOptions, experiment: str) -> str:
    """The command that makes the same page; scenes by name, without the folders that it writes to."""
    command = ["freqgs", "experiment", experiment]
    for field in fields(options):
        value: Any = getattr(options, field.name)
        if value == field.default or field.name in ("output_dir", "docs", "only", "page_only"):
            continue
        name = field.name.replace("_", "-")
        if isinstance(value, bool):
            command.append(f"--{name}" if value else f"--no-{name}")
        elif field.name == "scenes":
            command += ["--scenes", *(folder.resolve().name for folder in value)]
        else:
            values = value if isinstance(value, tuple) else (value,)
            command += [f"--{name}", *(f"{v:g}" for v in values)]
    return shlex.join(command)
