"""`ns-train lapsplat`."""

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from freqgs_plugin.studio.datamanager import SceneDatamanagerConfig
from freqgs_plugin.studio.lapsplat import LapSplatModelConfig
from method_configs.optimizers import splat_optimizers

lapsplat = MethodSpecification(
    config=TrainerConfig(
        method_name="lapsplat",
        steps_per_eval_image=500,
        steps_per_eval_batch=0,
        steps_per_save=2000,
        steps_per_eval_all_images=1000,
        max_num_iterations=30_000,
        mixed_precision=False,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        pipeline=VanillaPipelineConfig(
            datamanager=SceneDatamanagerConfig(
                # every eighth image is held out, as in the papers
                dataparser=NerfstudioDataParserConfig(load_3D_points=True, eval_mode="interval", eval_interval=8),
            ),
            model=LapSplatModelConfig(),
        ),
        optimizers=splat_optimizers(),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="Level of detail by frequency: Gaussians in Laplacian-pyramid levels.",
)
