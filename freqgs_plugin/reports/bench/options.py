"""What every `freqgs bench` command can be told. Imports nothing heavy: the command line reads it."""

from dataclasses import dataclass
from pathlib import Path


class BenchError(RuntimeError):
    """A benchmark that cannot be run as asked; the message holds the remedy."""


@dataclass(frozen=True)
class BenchOptions:
    """Where a benchmark writes, and how it measures."""

    output_dir: Path = Path("bench-out")
    """folder for NAME.json, NAME.md and NAME.png"""
    docs: Path | None = None
    """Markdown page whose places `<!-- TABLE -->` ... `<!-- end of TABLE -->` are filled with the tables"""
    quick: bool = False
    """small sizes, to see that it works; the figures mean little"""
    rounds: int = 7
    """timed rounds; each runs every candidate once, and medians and quartiles are over rounds"""
    threads: int = 1
    """threads of torch and of the compiled kernels"""

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.threads < 1:
            raise BenchError(f"--rounds and --threads must be at least 1, not {self.rounds} and {self.threads}")
