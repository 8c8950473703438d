"""`ns-train clodsplat`."""

from nerfstudio.plugins.types import MethodSpecification

from freqgs_plugin.studio.clodsplat import ClodSplatModelConfig
from method_configs.optimizers import FusedAdamConfig, splat_optimizers
from method_configs.trainer import trainer_config

_DECAY_RATE = 1e-2

clodsplat = MethodSpecification(
    config=trainer_config(
        "clodsplat",
        ClodSplatModelConfig(),
        {**splat_optimizers(), "decay": {"optimizer": FusedAdamConfig(lr=_DECAY_RATE, eps=1e-15), "scheduler": None}},
    ),
    description="Continuous level of detail: opacities fall with distance at a rate learned for each Gaussian.",
)
