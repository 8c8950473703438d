"""`ns-train lapsplat`, and its settings as the paper has them or without levels."""

from nerfstudio.plugins.types import MethodSpecification

from freqgs_plugin.studio.lapsplat import LapSplatModelConfig
from freqgs_plugin.training.presets import LAPSPLAT_PAPER, PLAIN
from method_configs.optimizers import splat_optimizers
from method_configs.trainer import trainer_config

lapsplat = MethodSpecification(
    config=trainer_config("lapsplat", LapSplatModelConfig(), splat_optimizers()),
    description="Level of detail by frequency: Gaussians in Laplacian-pyramid levels.",
)
lapsplat_paper = MethodSpecification(
    config=trainer_config("lapsplat-paper", LapSplatModelConfig(**LAPSPLAT_PAPER), splat_optimizers()),
    description="lapsplat with the settings of the paper instead of those that measured best.",
)
lapsplat_plain = MethodSpecification(
    config=trainer_config("lapsplat-plain", LapSplatModelConfig(**PLAIN), splat_optimizers()),
    description="One level: splatfacto's algorithm with the same rasterizers, to compare with.",
)
