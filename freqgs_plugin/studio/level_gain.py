"""What a new level gains on training views that are held back while levels are added."""

import statistics
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from freqgs_plugin.studio.viewing import psnr, show

EVERY = 8
"""every eighth training view is held back"""


class LevelGain:
    """PSNR on held-back views before each new level."""

    def __init__(self) -> None:
        self.last: float | None = None
        """PSNR when it was last measured, dB"""
        self._manager: Any = None

    @property
    def active(self) -> bool:
        """Whether views are held back."""
        return self._manager is not None

    @property
    def count(self) -> int:
        """Views that are held back."""
        return len(self._manager.held_back) if self.active else 0

    def hold_back(self, datamanager: Any) -> None:
        """Take every eighth training view out of training for now; none of fewer than 8."""
        numbers = set(range(EVERY // 2, len(datamanager.train_dataset), EVERY))
        if len(datamanager.train_dataset) < EVERY:
            CONSOLE.log(f"[yellow]least-level-gain has no effect: of fewer than {EVERY} views none is held back.")
            return
        datamanager.hold_back(numbers)
        self._manager = datamanager
        CONSOLE.log(f"{len(numbers)} training views are held back until the last level has begun.")

    def release(self) -> None:
        """Train on all views again."""
        if self.active:
            self._manager.hold_back(set())
        self._manager = None

    @torch.no_grad()
    def measure(self, model: Any) -> float | None:
        """How much better the views are shown than the last time, dB; None the first time."""
        cameras, cached = self._manager.train_dataset.cameras, self._manager.cached_train
        was_training = model.training
        model.eval()
        values = []
        for number in sorted(self._manager.held_back):
            picture = model.get_outputs_for_camera(cameras[number : number + 1].to(model.device))["rgb"]
            values.append(float(psnr(show(picture), view_image(model, cached[number]))))
        model.train(was_training)
        now, before = statistics.fmean(values), self.last
        self.last = now
        return None if before is None else now - before


def view_image(model: Any, data: dict[str, Any]) -> Float[Tensor, "_ _ 3"]:
    """A cached photograph over the model's background, colours in [0, 1]."""
    image = data["image"].to(model.device)
    image = image.float() / 255.0 if image.dtype == torch.uint8 else image
    return model.composite_with_background(image, model.background_color.to(model.device))
