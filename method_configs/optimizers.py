"""The optimizer table of both methods: splatfacto's rates and schedules, with torch's fused Adam."""

from dataclasses import dataclass

from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam in one kernel per parameter, on CPU and CUDA."""

    fused: bool = True
    """one pass over memory; same arithmetic"""


def splat_optimizers() -> dict:
    """Optimizers by parameter group; schedules are for 30,000 steps and scale with the run's length."""
    groups: dict = {
        name: {"optimizer": FusedAdamConfig(lr=rate, eps=1e-15), "scheduler": None}
        for name, rate in {
            "features_dc": 0.0025,
            "features_rest": 0.0025 / 20,
            "opacities": 0.05,
            "scales": 0.005,
            "quats": 0.001,
        }.items()
    }
    groups["means"] = {
        "optimizer": FusedAdamConfig(lr=1.6e-4, eps=1e-15),
        "scheduler": ExponentialDecaySchedulerConfig(lr_final=1.6e-6, max_steps=30_000),
    }
    groups["camera_opt"] = {
        "optimizer": AdamOptimizerConfig(lr=1e-4, eps=1e-15),
        "scheduler": ExponentialDecaySchedulerConfig(
            lr_final=5e-7, max_steps=30_000, warmup_steps=1000, lr_pre_warmup=0
        ),
    }
    groups["bilateral_grid"] = {
        "optimizer": AdamOptimizerConfig(lr=2e-3, eps=1e-15),
        "scheduler": ExponentialDecaySchedulerConfig(
            lr_final=1e-4, max_steps=30_000, warmup_steps=1000, lr_pre_warmup=0
        ),
    }
    return groups
