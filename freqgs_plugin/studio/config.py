"""Config fields that both methods share."""

from dataclasses import dataclass
from typing import Literal

from nerfstudio.models.splatfacto import SplatfactoModelConfig

from freqgs_plugin.functional.image_loss import Clamp


@dataclass
class FreqSplatModelConfig(SplatfactoModelConfig):
    """Fields that both methods share, beside splatfacto's own."""

    rasterizer: str = "auto"
    """auto (gsplat on CUDA, numba on the CPU, torch elsewhere), torch, numba, gsplat, or one added by entry point"""
    rasterize_mode: Literal["classic", "antialiased"] = "antialiased"
    """antialiased: opacity compensation of Mip-Splatting (the paper's setting); classic: none"""
    clamp_in_loss: Clamp = "none"
    """clamp pictures to [0, 1] before the loss: hard (the paper's code) stops gradients outside of it (ours: none)"""
    target_cache_mb: int = 1024
    """memory for training targets that are kept from step to step, megabytes"""
    strategy: Literal["default", "mcmc"] = "default"
    """densification strategy; mcmc is refused, with the reason"""
    stop_split_at: int = 27_000
    """densification ends at this step, so that the last Gaussians can settle (ours; the paper: never)"""
    stop_reset_before_end: int = 5000
    """opacity resets stop this many steps before refinement does (ours)"""
    least_refine_interval: int = 100
    """refinement is never more frequent than this, in steps, however short the run (ours)"""
    least_weight: float = 1.0
    """Gaussians whose weight over all training views is under this many pixels are removed; 0: none (ours)"""
    least_views: int = 2
    """Gaussians above level 1 that fewer training views show are removed; 0: none (ours)"""
    opacity_penalty: float = 0.0
    """weight of the mean opacity of what a view shows: Gaussians that it does not need fade and are pruned (ours)"""
    size_penalty: float = 0.0
    """weight of the mean standard deviation of what a view shows, world units; 0: none (ours)"""
    dropout: float | None = 0.0
    """share of Gaussians that each training step leaves out at random, in [0, 1); 0: none; None: 0.1 if fewer than 25
    views train, else none (ours)"""
    max_gaussians: int = 0
    """densification stops at this many Gaussians; 0: no bound (ours)"""
    steps_scale: float | None = None
    """step constants are multiplied by this; None: max_num_iterations / 30000"""
    bad_steps_patience: int = 10
    """training stops after this many steps in a row with losses or gradients that are not finite (ours)"""
    seed: int = 42
    """of the initial rotations, of random initial points, and of the scales that clodsplat trains at"""
