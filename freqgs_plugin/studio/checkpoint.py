"""A trained run as plain Gaussians, cameras and images."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from nerfstudio.utils.eval_utils import eval_setup
from torch import Tensor

from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.init_source import frame_of
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.model import FreqSplatModel
from freqgs_plugin.studio.run_files import latest_checkpoint, read_config
from freqgs_plugin.studio.view_names import view_names
from freqgs_plugin.training.choose_levels import said_of_levels
from freqgs_plugin.types import Camera, Gaussians


@dataclass(frozen=True)
class View:
    """One photograph and its camera."""

    name: str
    camera: Camera
    image: Float[Tensor, "h w 3"]
    """in [0, 1]; images with an alpha channel are composited over the run's background"""


class Run:
    """A trained run, loaded. Nothing in it is trained further."""

    def __init__(self, config: Any, pipeline: Any, step: int):
        self.config = config
        """nerfstudio's TrainerConfig"""
        self.step = step
        """training step of the checkpoint"""
        self._pipeline = pipeline
        model = pipeline.model
        if not isinstance(model, FreqSplatModel):
            raise ValueError(
                f"the run was trained by '{config.method_name}', whose model is no level-of-detail model. "
                "Name a config.yml of a lapsplat or clodsplat run."
            )
        self.model: FreqSplatModel = model

    @cached_property
    def gaussians(self) -> Gaussians:
        """The scene."""
        with torch.no_grad():
            return self.model.gaussians()

    @cached_property
    def raw(self) -> RawGaussians:
        """The scene as it is trained; with a decay once that has begun to act."""
        groups, decay = self.model.gauss_params, self.gaussians.decay
        return RawGaussians(**{name: groups[name].detach() for name in GROUPS}, level=self.gaussians.level, decay=decay)

    @cached_property
    def frame(self) -> Similarity:
        """From the data set's frame to the scene's."""
        return frame_of(self._outputs.dataparser_transform, self._outputs.dataparser_scale)

    @property
    def frame_matrix(self) -> list[list[float]]:
        """Rotation and translation of `frame`, 3 by 4, as nerfstudio has them."""
        return self._outputs.dataparser_transform[:3].tolist()

    @property
    def _outputs(self) -> Any:
        return self._pipeline.datamanager.train_dataparser_outputs

    @property
    def num_levels(self) -> int:
        """Levels L of the scene."""
        return self.model.num_levels

    def levels_left_out(self) -> list[str]:
        """What the run's log said on its number of levels; empty where that was given."""
        return said_of_levels(self.model.level_choice())

    @property
    def scene_distance(self) -> float | None:
        """What `DistanceDecay` divides distances by for the reference `scene`, world units; None without decay."""
        return getattr(self.model, "scene_distance", None)

    @property
    def largest_scale(self) -> float | None:
        """The largest distance scale that its decays were trained for; None without decay."""
        return getattr(self.model.config, "largest_scale", None)

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """What lies behind everything."""
        return self.model.background_color.to(self.model.device)

    @property
    def rasterizer(self) -> Rasterizer:
        """The run's rasterizer, on this machine."""
        return self.model.rasterizer()

    @property
    def antialiased(self) -> bool:
        """Whether the run was trained with opacity compensation."""
        return self.model.antialiased

    def cameras(self, split: Literal["train", "test"]) -> list[View]:
        """The views of a split, with their images at full size."""
        return [self.view(split, index) for index in range(self.num_views(split))]

    def num_views(self, split: Literal["train", "test"]) -> int:
        """Views of a split."""
        return len(self._views(split)[0])

    def view(self, split: Literal["train", "test"], index: int) -> View:
        """One view of a split, with its image at full size."""
        cached, dataset = self._views(split)
        image = cached[index]["image"].to(self.model.device)
        image = image.float() / 255.0 if image.dtype == torch.uint8 else image
        image = self.model.composite_with_background(image, self.background)
        camera = to_camera(dataset.cameras[index : index + 1].to(self.model.device))
        return View(self._names[dataset.image_filenames[index]], camera, image)

    @cached_property
    def _names(self) -> dict[Path, str]:
        """File of a photograph -> name of the view."""
        manager = self._pipeline.datamanager
        files = [*manager.train_dataset.image_filenames, *manager.eval_dataset.image_filenames]
        return dict(zip(files, view_names(files), strict=True))

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds as `pipeline`."""
        return self._pipeline.state_dict()

    def _views(self, split: Literal["train", "test"]) -> tuple[Any, Any]:
        """Cached images, and the data set."""
        manager = self._pipeline.datamanager
        if split == "train":
            return manager.cached_train, manager.train_dataset
        return manager.cached_eval, manager.eval_dataset


def load_run(config_path: Path) -> Run:
    """Load the latest checkpoint of the run whose `config.yml` is named.

    Raises:
        FileNotFoundError: there is no such file, or no checkpoint beside it.
        ValueError: the run is of another method, or one of its files is damaged.
    """
    config_path = Path(config_path)
    read_config(config_path)
    checkpoint, latest = latest_checkpoint(config_path.parent)

    def found_here(config: Any) -> Any:
        # a run's config names its folder as ns-train was told, which may be relative to where that was started
        experiment, timestamp = config_path.resolve().parents[2], config_path.resolve().parent
        config.output_dir, config.experiment_name = experiment.parent, experiment.name
        config.timestamp = timestamp.name
        # else nerfstudio takes every file in the folder for a checkpoint
        config.load_step = latest
        if config.get_checkpoint_dir() != checkpoint.resolve().parent:
            raise FileNotFoundError(
                f"{config_path} is of method {config.method_name}, and no folder above it is called so. "
                f"Put it where ns-train did: EXPERIMENT/{config.method_name}/TIME/config.yml."
            )
        return config

    config, pipeline, _, step = eval_setup(config_path, test_mode="test", update_config_callback=found_here)
    return Run(config, pipeline, step)
