"""What the methods' trainer configurations have in common."""

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from freqgs_plugin.studio.config import FreqSplatModelConfig
from freqgs_plugin.studio.datamanager import SceneDatamanagerConfig
from freqgs_plugin.studio.trainer import SplatTrainerConfig


def trainer_config(method_name: str, model: FreqSplatModelConfig, optimizers: dict) -> SplatTrainerConfig:
    """30,000 steps on full images, of which every eighth is held out; in the viewer; on CUDA where there is one."""
    return SplatTrainerConfig(
        method_name=method_name,
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
            model=model,
        ),
        optimizers=optimizers,
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    )
