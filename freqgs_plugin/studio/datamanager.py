"""nerfstudio's full-image datamanager, after a look at the scene: what is wrong is said before training starts."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from freqgs_plugin.io.check_images import SceneError, some
from freqgs_plugin.io.check_scene import SceneSummary, check_colmap_scene, find_model
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.disk_views import DiskViews
from freqgs_plugin.studio.image_cache import EvalPairs, Where, choose_place, scene_folder
from freqgs_plugin.studio.view_names import view_names
from freqgs_plugin.types import Camera

NAMED_CAMERAS = "named_cameras"
"""key in the metadata of the dataset trained on, and so of a model: `SceneDatamanager.named_cameras`"""


@dataclass
class SceneDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's fields, and where photographs are kept."""

    _target: type = field(default_factory=lambda: SceneDatamanager)
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """of a cached photograph: 3 or 12 bytes per pixel (nerfstudio's default is float32)"""
    cache_images_where: Where = "auto"
    """where photographs are kept at the size used: memory, disk (written once, mapped into memory when looked at), or
    auto: memory if all of them take at most cache_images_share of what is available, else disk (ours)"""
    cache_images_share: float = 0.5
    """share of the available memory up to which auto keeps photographs there, in (0, 1] (ours)"""
    cache_images_dir: Path | None = None
    """where disk puts a folder for each scene; None: freqgs/images in the user's cache, $XDG_CACHE_HOME or ~/.cache
    (ours)"""


class SceneDatamanager(FullImageDatamanager):
    """Checks the scene, then reads it as nerfstudio does."""

    config: SceneDatamanagerConfig

    def __init__(
        self,
        config: SceneDatamanagerConfig,
        device: torch.device | str = "cpu",
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        **kwargs: Any,
    ):
        self.held_back: set[int] = set()
        if not 0 < config.cache_images_share <= 1:
            raise ValueError(f"cache-images-share is {config.cache_images_share}; it is a share of memory in (0, 1].")
        parser = config.dataparser
        data = Path(config.data if config.data is not None else parser.data)
        if test_mode != "val" and not data.exists():
            raise SceneError(_moved(data))
        if isinstance(parser, ColmapDataParserConfig):
            _look_at_colmap(parser, data, thorough=test_mode == "val")
        elif isinstance(parser, NerfstudioDataParserConfig):
            _look_at_transforms(data)
        super().__init__(config, device, test_mode, world_size, local_rank, **kwargs)
        _look_at_views(self.train_dataset, data)
        # all that nerfstudio hands to a model
        self.train_dataset.metadata[NAMED_CAMERAS] = self.named_cameras

    def named_cameras(self) -> tuple[list[str], list[Camera]]:
        """Names and cameras of the views trained on, and then of those held out, on the CPU."""
        files, cameras = [], []
        # looked at first: nerfstudio undistorts images and cameras as it reads them
        for _, dataset in ((self.cached_train, self.train_dataset), (self.cached_eval, self.eval_dataset)):
            files += dataset.image_filenames
            cameras += [to_camera(dataset.cameras[i : i + 1]) for i in range(len(dataset))]
        return view_names(files), cameras

    @cached_property
    def images_on_disk(self) -> bool:
        """Whether photographs are kept on disk: decided, and said, when the first of them is needed."""
        return choose_place(self.config, (self.train_dataset, self.eval_dataset), self.device) == "disk"

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]) -> Any:
        if not self.images_on_disk:
            return super()._load_images(split, cache_images_device)
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        views = DiskViews(dataset, self.config.cache_images_type, scene_folder(self.config))
        cameras = self.train_dataset.cameras
        self.train_cameras = cameras.to(self.device) if cache_images_device == "gpu" else cameras
        return views

    @property
    def fixed_indices_eval_dataloader(self) -> Any:
        """Cameras and images held out; from disk one by one, not all on the device at once."""
        if not self.images_on_disk:
            return super().fixed_indices_eval_dataloader
        return EvalPairs(self.cached_eval, self.eval_dataset.cameras, self.device)

    def sample_train_cameras(self) -> list[int]:
        """nerfstudio's order of training views, without those held back."""
        return [number for number in super().sample_train_cameras() if number not in self.held_back]

    def hold_back(self, views: set[int]) -> None:
        """Do not train on these views from now on."""
        self.held_back = set(views)
        self.train_unseen_cameras = self.sample_train_cameras()


def _moved(data: Path) -> str:
    """Of a run, which knows its scene by its folder alone."""
    remedy = (
        "Move it back, or name its new place in the run's config.yml: there, put one line `- /NEW/FOLDER` in place of "
        "the lines that begin with `- `, one for each part of the old path, below the first `data:` that holds it."
    )
    if data.is_absolute():
        return f"the scene's folder {data} is not there. {remedy}"
    return (
        f"the scene's folder {data} is not in {Path.cwd()}: the run names it from where ns-train was started. Go "
        f"there, or {remedy[0].lower()}{remedy[1:]}"
    )


def _look_at_colmap(parser: ColmapDataParserConfig, data: Path, thorough: bool) -> None:
    """Point the parser at the model that is there, and check the scene."""
    found = find_model(data)
    if found is not None and find_model(data, (str(parser.colmap_path),)) is None:
        CONSOLE.log(escape(f"No COLMAP model in {data / parser.colmap_path}; using the one in {data / found}."))
        parser.colmap_path = Path(found)
    if not thorough:
        return
    summary = check_colmap_scene(
        data,
        colmap_path=parser.colmap_path,
        images_path=parser.images_path,
        downscale_factor=parser.downscale_factor,
        downscale_rounding_mode=parser.downscale_rounding_mode,
        eval_mode=parser.eval_mode,
        eval_interval=parser.eval_interval,
        train_split_fraction=parser.train_split_fraction,
        load_3D_points=parser.load_3D_points,
    )
    if summary.num_points == 0:
        parser.load_3D_points = False
    _report(summary)


def _report(summary: SceneSummary) -> None:
    sizes = ", ".join(f"{w}x{h} px" for w, h in summary.sizes)
    CONSOLE.log(
        f"{summary.num_views} views ({summary.num_train} to train on, {summary.num_eval} held out), {sizes}, "
        f"{summary.num_points:,} points."
    )
    for warning in summary.warnings:
        CONSOLE.log(f"[yellow]{escape(warning)}")


def _look_at_transforms(data: Path) -> None:
    if data.suffix == ".json":
        if not data.is_file():
            raise SceneError(f"{data} does not exist; name a folder with a transforms.json, or that file.")
        return
    if not data.is_dir():
        raise SceneError(f"the data folder {data} does not exist.")
    if (data / "transforms.json").is_file():
        return
    model = find_model(data)
    hint = (
        f"There is a COLMAP model in {data / model}: end the command with `colmap`."
        if model is not None
        else "Run `ns-process-data images` on the photographs first, or name another dataparser after the options."
    )
    raise SceneError(f"{data} holds no transforms.json. {hint}")


def _look_at_views(dataset: Any, data: Path) -> None:
    """What any dataparser's result must fulfil."""
    if len(dataset) < 1:
        raise SceneError(f"the split of {data} leaves no view to train on; hold fewer views out.")
    missing = [str(f) for f in dataset.image_filenames if not Path(f).is_file()]
    if missing:
        raise SceneError(f"{len(missing)} of {len(dataset)} images of {data} are missing: {some(missing)}.")
    kinds = {int(k) for k in dataset.cameras.camera_type.flatten()} - {CameraType.PERSPECTIVE.value}
    if kinds:
        names = ", ".join(t.name for t in CameraType if t.value in kinds)
        raise SceneError(
            f"{data} has cameras of type {names}. Gaussians are projected by a pinhole camera: undistort the images "
            "first (for COLMAP models: `colmap image_undistorter`)."
        )
