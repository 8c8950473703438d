"""`ns-train clodsplat`, and its settings as the paper has them."""

from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from freqgs_plugin.studio.clodsplat import ClodSplatModelConfig
from freqgs_plugin.training.presets import CLODSPLAT_PAPER, PAPER_DECAY_RATE
from method_configs.optimizers import FusedAdamConfig, splat_optimizers
from method_configs.trainer import trainer_config


def _decay(lr_final: float) -> dict:
    return {
        "optimizer": FusedAdamConfig(lr=PAPER_DECAY_RATE, eps=1e-15),
        "scheduler": ExponentialDecaySchedulerConfig(lr_final=lr_final, max_steps=30_000),
    }


clodsplat = MethodSpecification(
    config=trainer_config(
        "clodsplat",
        ClodSplatModelConfig(),
        # the paper's rate stays the same; at first decays have far to go, and in the end they must settle
        {**splat_optimizers(), "decay": _decay(2e-4)},
    ),
    description="Continuous level of detail: opacities fall with distance at a rate learned for each Gaussian.",
)
clodsplat_paper = MethodSpecification(
    config=trainer_config(
        "clodsplat-paper",
        ClodSplatModelConfig(**CLODSPLAT_PAPER),
        {**splat_optimizers(), "decay": _decay(PAPER_DECAY_RATE)},
    ),
    description="clodsplat with the settings of the paper instead of those that measured best.",
)
