"""What `freqgs report` can be told. Imports nothing heavy: the command line reads it."""

import math
import shlex
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import UseAppendAction


class ReportError(RuntimeError):
    """A report that cannot be made as asked; the message holds the remedy."""


@dataclass(frozen=True)
class ReportOptions:
    """Which runs are measured, how, and where the report goes."""

    load_config: Annotated[tuple[Path, ...], UseAppendAction]
    """config.yml of a trained run; once for each run. All of them have the same held-out views"""
    names: tuple[str, ...] = ()
    """of the runs, in their order; without them lapsplat, clodsplat or plain"""
    output_dir: Path = Path("report-out")
    """folder for report.html, report.md, report.json, report.csv, training.csv and the plots"""
    scales: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0)
    """values of s_v at which a clodsplat run is measured"""
    shares: tuple[float, ...] = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
    """of its Gaussians that are kept of a run of one level, by opacity and by what shows most"""
    views: int | None = None
    """measure on at most so many held-out views, spread over all; without it on all of them"""
    rounds: int = 9
    """timed rounds; each draws everything once, and medians and quartiles are over rounds"""
    threads: int = 1
    """threads of torch and of the compiled kernels"""
    docs: Path | None = None
    """Markdown page whose place `<!-- report -->` ... `<!-- end of report -->` is filled; plots go into images/ beside
    it"""

    def __post_init__(self) -> None:
        if not self.load_config:
            raise ReportError("there is no run to report on: give --load-config RUN/config.yml, once for each run.")
        if self.names and len(self.names) != len(self.load_config):
            raise ReportError(
                f"--names has {len(self.names)} names for {len(self.load_config)} runs; give one for each, or none."
            )
        twice = [name for name, count in Counter(self.names).items() if count > 1]
        if twice or not all(name.strip() for name in self.names):
            named = shlex.join(self.names)
            raise ReportError(f"--names {named}: runs are told apart by their names; let them differ.")
        if len({path.resolve() for path in self.load_config}) < len(self.load_config):
            raise ReportError("--load-config names a run twice; name each once.")
        if not self.scales or not all(0 < scale < math.inf for scale in self.scales):
            raise ReportError(f"--scales {_list(self.scales)}: name at least one s_v, each of them above 0 and finite.")
        if not self.shares or not all(0 < share <= 1 for share in self.shares):
            raise ReportError(f"--shares {_list(self.shares)}: name at least one share, each above 0 and at most 1.")
        if self.views is not None and self.views < 1:
            raise ReportError(f"--views is {self.views}; measure on at least one view, or leave it out for all.")
        if self.rounds < 1 or self.threads < 1:
            raise ReportError(f"--rounds and --threads must be at least 1, not {self.rounds} and {self.threads}.")


def command_line(options: ReportOptions, names: tuple[str, ...]) -> str:
    """The command that makes the same report, without the folders that it reads from and writes to."""
    command = ["freqgs", "report"]
    for name in names:
        command += ["--load-config", f"{name.upper().replace(' ', '_')}/config.yml"]
    if options.names:
        command += ["--names", *options.names]
    for option in ("scales", "shares"):
        values = getattr(options, option)
        if values != getattr(ReportOptions, option):
            command += [f"--{option}", *(f"{value:g}" for value in values)]
    for option in ("views", "rounds", "threads"):
        value = getattr(options, option)
        if value != getattr(ReportOptions, option):
            command += [f"--{option}", str(value)]
    return shlex.join(command)


def _list(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values) or "(nothing)"
