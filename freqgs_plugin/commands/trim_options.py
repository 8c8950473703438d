"""What `freqgs trim` can be told. Imports nothing heavy: the command line reads it."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrimOptions:
    """Which run, what it may cost, and where the new one goes."""

    load_config: Path
    """config.yml of a finished lapsplat or clodsplat run; nothing in its folder is changed"""
    max_loss_db: float = 0.05
    """PSNR that may be lost on the training views, dB: by the whole scene, by every prefix of levels, and at every
    distance scale that the run is evaluated at, the largest in training among them"""
    output_dir: Path | None = None
    """folder of the new run, EXPERIMENT/METHOD/NAME; without it a folder beside the old one, its name with -trimmed"""
    dry_run: bool = False
    """measure, print and write no run"""
    docs: Path | None = None
    """page in which the run's tables are filled in, between the comments <!-- trim METHOD DATA --> and its end"""
