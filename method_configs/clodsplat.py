"""`ns-train clodsplat`."""

from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from freqgs_plugin.studio.clodsplat import ClodSplatModelConfig
from method_configs.optimizers import FusedAdamConfig, splat_optimizers
from method_configs.trainer import trainer_config

_decay = {
    # the paper's rate, which stays the same there; at first decays have far to go, and in the end they must settle
    "optimizer": FusedAdamConfig(lr=1e-2, eps=1e-15),
    "scheduler": ExponentialDecaySchedulerConfig(lr_final=2e-4, max_steps=30_000),
}

clodsplat = MethodSpecification(
    config=trainer_config("clodsplat", ClodSplatModelConfig(), {**splat_optimizers(), "decay": _decay}),
    description="Continuous level of detail: opacities fall with distance at a rate learned for each Gaussian.",
)
