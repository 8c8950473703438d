"""nerfstudio's trainer, whose checkpoints are written whole or not at all, and looked at before they are loaded."""

import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.decorators import check_main_thread

from freqgs_plugin.studio.run_files import check_whole, naming_the_disk


@dataclass
class SplatTrainerConfig(TrainerConfig):
    """nerfstudio's settings of a training."""

    _target: type = field(default_factory=lambda: SplatTrainer)


class SplatTrainer(Trainer):
    """nerfstudio's trainer; a full disk or an interrupt while it saves leaves the checkpoints that were there."""

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Save the model and the optimizers.

        Raises:
            OSError: the disk is full.
        """
        folder = self.checkpoint_dir
        folder.mkdir(parents=True, exist_ok=True)
        # not within `folder`: nerfstudio takes every file there for a checkpoint
        with tempfile.TemporaryDirectory(prefix=".checkpoint-", dir=folder.parent) as partial:
            self.checkpoint_dir = Path(partial)
            try:
                with naming_the_disk(f"step-{step:09d}.ckpt", Path(partial), folder, self._remedy(folder)):
                    super().save_checkpoint(step)
            finally:
                self.checkpoint_dir = folder
            written = next(Path(partial).iterdir())
            os.replace(written, folder / written.name)
        if self.config.save_only_latest_checkpoint:
            for path in folder.glob("*.ckpt"):
                if path.name != written.name:
                    path.unlink()

    @staticmethod
    def _remedy(folder: Path) -> str:
        last = max((path.name for path in folder.glob("step-*.ckpt")), default=None)
        if last is None:
            return "Make room, and start again."
        return f"Make room, and go on from the last one, {last}, with --load-dir {folder}."

    def _load_checkpoint(self) -> None:
        """Raises ValueError where the checkpoint is cut off or has changed since it was written."""
        config = self.config
        path = config.load_checkpoint
        if config.load_dir is not None and config.load_dir.is_dir():
            step = config.load_step
            name = "*.ckpt" if step is None else f"step-{step:09d}.ckpt"
            path = max(config.load_dir.glob(name), default=None)
        if path is not None and path.is_file():
            check_whole(path)
        super()._load_checkpoint()
