"""`ns-train lapsplat`."""

from nerfstudio.plugins.types import MethodSpecification

from freqgs_plugin.studio.lapsplat import LapSplatModelConfig
from method_configs.optimizers import splat_optimizers
from method_configs.trainer import trainer_config

lapsplat = MethodSpecification(
    config=trainer_config("lapsplat", LapSplatModelConfig(), splat_optimizers()),
    description="Level of detail by frequency: Gaussians in Laplacian-pyramid levels.",
)
