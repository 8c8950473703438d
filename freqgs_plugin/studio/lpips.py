"""LPIPS where its weights are on this machine. Nothing is ever downloaded."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE

_WEIGHTS = "alexnet-owt-7be5be79.pth"


@lru_cache(maxsize=2)
def lpips_if_available(device: torch.device) -> Any | None:
    """LPIPS with AlexNet on images in [0, 1], or None (said once) where its weights are not in torch's cache."""
    path = Path(torch.hub.get_dir()) / "checkpoints" / _WEIGHTS
    if not path.exists():
        CONSOLE.log(
            f"LPIPS is not computed: its weights, {_WEIGHTS}, are not in {path.parent}. "
            "Put torchvision's AlexNet file there to have it."
        )
        return None
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity(normalize=True).to(device)
