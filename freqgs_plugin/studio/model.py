"""The base of both methods: splatfacto with a swappable rasterizer, level tags, a guard and restartable training."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.model_components.lib_bilagrid import BilateralGrid
from nerfstudio.models.splatfacto import SH2RGB, SplatfactoModel, SplatfactoModelConfig, get_color
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.functional.image_loss import ssim
from freqgs_plugin.rendering.base import Rasterizer, get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.controls import Stopwatch, drawn_text, in_viewer, uninterrupted
from freqgs_plugin.studio.lpips import lpips_if_available
from freqgs_plugin.studio.optimizers import adopt_parameters, scale_schedulers
from freqgs_plugin.studio.outputs import LazyOutputs
from freqgs_plugin.training.guard import FiniteGuard, NonFiniteError
from freqgs_plugin.training.initialise import initial_parameters, random_points
from freqgs_plugin.training.schedule import REFERENCE_STEPS
from freqgs_plugin.types import Camera, Gaussians, Rendering

GROUPS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
_STATISTICS = ("grad2d", "count", "radii")


class uncached_property(cached_property):
    """A property that nerfstudio's viewer does not read while it looks for controls (it skips cached properties)."""

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        return self if instance is None else self.func(instance)


@dataclass
class FreqSplatModelConfig(SplatfactoModelConfig):
    """Fields that both methods share, beside splatfacto's own."""

    _target: type = field(default_factory=lambda: FreqSplatModel)
    rasterizer: str = "auto"
    """auto (gsplat on CUDA, numba on the CPU, torch elsewhere), torch, numba, gsplat, or one added by entry point"""
    rasterize_mode: Literal["classic", "antialiased"] = "antialiased"
    """antialiased: opacity compensation of Mip-Splatting (the paper's setting); classic: none"""
    steps_scale: float | None = None
    """step constants are multiplied by this; None: max_num_iterations / 30000"""
    least_refine_interval: int = 100
    """refinement is never more frequent than this, in steps, however short the run (ours)"""
    stop_reset_before_end: int = 5000
    """opacity resets stop this many steps before refinement does (ours)"""
    max_gaussians: int = 0
    """densification stops at this many Gaussians; 0: no bound (ours)"""
    bad_steps_patience: int = 10
    """training stops after this many steps in a row with losses or gradients that are not finite (ours)"""
    seed: int = 42
    """of the initial rotations, and of random initial points"""


class FreqSplatModel(SplatfactoModel):
    """Splatfacto whose pictures come from `rendering.render`, on any device.

    Subclasses define `_make_strategy`, the attenuation that the viewer's controls ask for, and the training outputs.
    """

    config: FreqSplatModelConfig

    def populate_modules(self) -> None:
        self._check_config()
        generator = torch.Generator().manual_seed(self.config.seed)
        if self.seed_points is not None and not self.config.random_init and len(self.seed_points[0]):
            points, colours = self.seed_points[0], self.seed_points[1] / 255.0
            if len(colours) != len(points):
                colours = torch.full_like(points, 0.5)
        else:
            points, colours = random_points(self.config.num_random, self.config.random_scale, generator)
            CONSOLE.log(
                f"No seed points in use: {len(points)} random ones in a cube of side {self.config.random_scale}."
            )
        self.gauss_params = torch.nn.ParameterDict(
            initial_parameters(points, colours, self.config.sh_degree, generator)
        )
        self.register_buffer("level", torch.ones(len(points), dtype=torch.int32))
        self.camera_optimizer: CameraOptimizer = self.config.camera_optimizer.setup(
            num_cameras=self.num_train_data, device="cpu"
        )
        if self.config.use_bilateral_grid:
            x, y, w = self.config.grid_shape
            self.bil_grids = BilateralGrid(num=self.num_train_data, grid_X=x, grid_Y=y, grid_W=w)
        from torchmetrics.image import PeakSignalNoiseRatio

        self.psnr = PeakSignalNoiseRatio(data_range=1.0)
        random = self.config.background_color == "random"
        # splatfacto's: the viewer's default background stands in for random ones
        self.background_color = (
            torch.tensor([0.1490, 0.1647, 0.2157]) if random else get_color(self.config.background_color)
        )
        self.crop_box = None
        self.step = 0
        self.guard = FiniteGuard(self.config.bad_steps_patience)
        self.drawn = drawn_text()
        self._sh_degree = 0
        self._scale = 1.0
        self._info: dict[str, Any] | None = None
        self._step_is_finite = True
        self._rasterizer: Rasterizer | None = None
        self.strategy = self._make_strategy()
        self.strategy_state: dict[str, Any] = {"scene_scale": 1.0, **dict.fromkeys(_STATISTICS)}

    # -- what a method defines ------------------------------------------------------------------------------------

    def _check_config(self) -> None:
        """Raise ValueError where settings contradict each other."""
        if self.config.sh_degree not in range(5):
            raise ValueError(f"sh_degree is {self.config.sh_degree}; it must be in 0..4.")
        if self.config.rasterize_mode not in ("antialiased", "classic"):
            raise ValueError(f"rasterize_mode is '{self.config.rasterize_mode}'; choose antialiased or classic.")

    def _make_strategy(self) -> Any:
        raise NotImplementedError

    def _begin_step(self, step: int) -> None:
        """Before a training step: what the schedule brings."""
        raise NotImplementedError

    def _densify(self, step: int) -> None:
        """After a training step with finite gradients."""
        raise NotImplementedError

    def _training_outputs(self, camera: Camera, background: Tensor, cam_idx: int | None) -> dict[str, Any]:
        raise NotImplementedError

    def _viewer_attenuation(self) -> Attenuation | None:
        """What the viewer's controls ask for."""
        return None

    def _more_outputs(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> dict[str, Any]:
        """Further named outputs, as functions."""
        return {}

    def _halvings(self) -> int:
        """How often training images are halved at this step."""
        return 0

    # -- Gaussians and pictures -----------------------------------------------------------------------------------

    @property
    def antialiased(self) -> bool:
        return self.config.rasterize_mode == "antialiased"

    def gaussians(self) -> Gaussians:
        """The scene with activated parameters: where exp and sigmoid are, and nowhere else."""
        rest = self.features_rest[:, : (self._sh_degree + 1) ** 2 - 1]
        return Gaussians(
            means=self.means,
            quats=self.quats,
            scales=torch.exp(self.scales),
            opacities=torch.sigmoid(self.opacities).squeeze(-1),
            sh=torch.cat([self.features_dc[:, None], rest], 1),
            level=self.level,  # pyright: ignore[reportArgumentType]
            signed_residuals=self._signed(),
        )

    def _signed(self) -> bool:
        return False

    def rasterizer(self) -> Rasterizer:
        """The configured rasterizer, loaded on first use."""
        if self._rasterizer is None:
            self._rasterizer = get_rasterizer(self.config.rasterizer, self.device, absgrad=self.config.use_absgrad)
        return self._rasterizer

    def draw(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        attenuation: Attenuation | None = None,
        depth: bool = False,
    ) -> Rendering:
        """A picture as the viewer, ns-eval and ns-render show it (not clamped)."""
        return render(
            gaussians,
            camera,
            attenuation,
            rasterizer=self.rasterizer(),
            background=background,
            antialiased=self.antialiased,
            depth=depth,
        )

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not isinstance(camera, Cameras):
            raise TypeError(f"a splat model renders nerfstudio Cameras, not {type(camera).__name__}.")
        background = self._get_background_color()
        if self.training:
            pose = self.camera_optimizer.apply_to_camera(camera)
            index = (camera.metadata or {}).get("cam_idx")
            return self._training_outputs(to_camera(camera, pose, halvings=self._halvings()), background, index)
        return self._view_outputs(to_camera(camera), background)

    @torch.no_grad()
    def _view_outputs(self, camera: Camera, background: Tensor) -> dict[str, Any]:
        gaussians = self.gaussians()
        if self.crop_box is not None:
            gaussians = gaussians.select(self.crop_box.within(gaussians.means).flatten())
        viewer = in_viewer()
        attenuation = self._viewer_attenuation() if viewer else None
        # the first picture imports and compiles
        finish = uninterrupted() if self._rasterizer is None else nullcontext()
        with Stopwatch(self.device) as watch, finish:
            rendering = self.draw(gaussians, camera, background, attenuation, depth=True)
        if viewer:
            self.drawn.value = f"{rendering.info['drawn']:,} / {self.num_points:,}, {watch.milliseconds:.0f} ms"
        depth = torch.where(rendering.alpha > 0, rendering.depth, rendering.depth.max())
        ready = {
            "rgb": show(rendering.features),
            "depth": depth,
            "accumulation": rendering.alpha,
            "background": background.expand(camera.height, camera.width, 3),
        }
        return LazyOutputs(ready, self._more_outputs(gaussians, camera, background))

    # -- training -------------------------------------------------------------------------------------------------

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:  # pyright: ignore
        trainer, optimizers = attributes.trainer, attributes.optimizers
        assert trainer is not None and optimizers is not None
        resumed = self.step > 0
        if not resumed:
            steps = trainer.config.max_num_iterations
            self._scale = self.config.steps_scale or steps / REFERENCE_STEPS
            assert attributes.pipeline is not None
            cameras = attributes.pipeline.datamanager.train_dataset.cameras  # pyright: ignore
            self._adapt_to_images(int(cameras.height.min()), int(cameras.width.min()))
        self._set_up_schedule()
        CONSOLE.log(f"Step constants are multiplied by {self._scale:g}.")
        adopt_parameters(optimizers, self.get_param_groups())
        scale_schedulers(optimizers, self._scale)
        for name in GROUPS:
            optimizers.optimizers[name].register_step_pre_hook(lambda *_: self._check_gradients(trainer))
        self._optimizers = optimizers
        self._all_train_cameras = attributes.pipeline.datamanager.train_dataset.cameras  # pyright: ignore
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self._before_step),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._after_step),
        ]

    def _adapt_to_images(self, height: int, width: int) -> None:
        """Before a new run: the smallest training image has this size, px."""

    def _train_cameras(self) -> Iterator[Cameras]:
        """The training views' cameras, one by one."""
        for index in range(len(self._all_train_cameras)):
            yield self._all_train_cameras[index : index + 1]

    def _set_up_schedule(self) -> None:
        """Build the schedule of this run, `_scale` being known."""
        raise NotImplementedError

    def _before_step(self, step: int) -> None:
        self.step = step
        self._checked = False
        self._step_is_finite = True
        self._begin_step(step)

    def _check_gradients(self, trainer: Any) -> None:
        """Before the first optimizer of a step moves: drop the step's gradients if any is not finite."""
        if self._checked:
            return
        self._checked = True
        skipped_before = self.guard.skipped
        try:
            # camera poses and bilateral grids too: their optimizers move in the same step
            parameters = {name.removeprefix("gauss_params."): p for name, p in self.named_parameters()}
            self._step_is_finite = self.guard.check(parameters, self.level, self.step)  # pyright: ignore
        except NonFiniteError:
            trainer.save_checkpoint(self.step)
            raise
        if self.guard.skipped == 1 and skipped_before == 0:
            CONSOLE.log(f"[bold yellow]{self.guard.first}. The step is skipped.")

    def _after_step(self, step: int) -> None:
        if self._step_is_finite and self._info is not None:
            self._densify(step)
        self._info = None

    # -- checkpoints ----------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, Any]:
        """What a resumed run needs beside parameters and levels."""
        return {
            "step": self.step,
            "steps_scale": self._scale,
            "sh_degree": self._sh_degree,
            "strategy": {k: self.strategy_state[k] for k in _STATISTICS if self.strategy_state[k] is not None},
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.step = int(state["step"])
        self._scale = float(state["steps_scale"])
        self._sh_degree = int(state["sh_degree"])
        for key in _STATISTICS:
            value = state["strategy"].get(key)
            self.strategy_state[key] = None if value is None else value.to(self.device)

    def load_state_dict(self, dict: dict[str, Any], **kwargs: Any) -> Any:  # pyright: ignore
        if "level" not in dict or "_extra_state" not in dict:
            raise ValueError(
                "the checkpoint holds no levels: it was not made by this method. "
                "Load it with the method that made it (see `method_name` in its config.yml)."
            )
        self.level = torch.zeros_like(dict["level"], device=self.device)
        self._rasterizer = None
        return super().load_state_dict(dict, **kwargs)

    # -- evaluation and export ------------------------------------------------------------------------------------

    def get_image_metrics_and_images(
        self, outputs: dict[str, Any], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        target = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
        predicted = outputs["rgb"]
        a, b = target.permute(2, 0, 1)[None], predicted.permute(2, 0, 1)[None]
        metrics = {"psnr": float(self.psnr(b, a)), "ssim": float(ssim(b, a)), "gaussians": float(self.num_points)}
        lpips = lpips_if_available(self.device)
        metrics["lpips_computed"] = float(lpips is not None)
        if lpips is not None:
            metrics["lpips"] = float(lpips(b, a))
        metrics.update(self._more_metrics(outputs, target))
        return metrics, {"img": torch.cat([target, predicted], 1)}

    def _more_metrics(self, outputs: dict[str, Any], target: Tensor) -> dict[str, float]:
        return {}

    def _refuse_export(self) -> None:
        """Raise where the parameters are not what an ordinary 3DGS viewer would show."""

    @uncached_property
    def shs_0(self) -> Tensor:
        self._refuse_export()
        return self.features_dc

    @uncached_property
    def colors(self) -> Tensor:
        self._refuse_export()
        return SH2RGB(self.features_dc)


def show(image: Tensor) -> Tensor:
    """Clamp to [0, 1]: what is shown or stored."""
    return image.clamp(0.0, 1.0)
