"""The base of both methods: how splats are trained, with level tags, densification, a guard and exact resuming."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from freqgs_plugin.functional.image_loss import image_distance, mean_square_as_shown
from freqgs_plugin.io.packed import unpack
from freqgs_plugin.rendering.render import rendered_weight
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.config import FreqSplatModelConfig
from freqgs_plugin.studio.optimizers import adopt_parameters, fuse, scale_schedulers
from freqgs_plugin.studio.outputs import LazyOutputs
from freqgs_plugin.studio.targets import TargetCache, ViewTarget
from freqgs_plugin.studio.viewing import SplatViews, show, to_psnr
from freqgs_plugin.training.densify import LevelStrategy
from freqgs_plugin.training.guard import FiniteGuard, NonFiniteError
from freqgs_plugin.training.regularise import default_dropout, drop_out, opacity_shown, size_shown
from freqgs_plugin.training.schedule import REFERENCE_STEPS, Schedule, scaled
from freqgs_plugin.types import Camera, Gaussians, Rendering

__all__ = ["FreqSplatModel", "FreqSplatModelConfig"]

_STATISTICS = ("grad2d", "count", "radii")


class FreqSplatModel(SplatViews):
    """Steps, densification, targets, losses and checkpoints.

    Subclasses draw the training pictures and define the objective; what is to happen when can be added to.
    """

    method = ""
    """name of the method, for messages"""

    def populate_modules(self) -> None:
        super().populate_modules()
        self.guard = FiniteGuard(self.config.bad_steps_patience)
        self._scale = 1.0
        self._info: dict[str, Any] | None = None
        self._step_is_finite = True
        self._trimmed = self._imported = False
        self._targets = TargetCache(self.config.target_cache_mb)
        self.strategy = self._make_strategy()
        self.strategy_state: dict[str, Any] = {"scene_scale": 1.0, **dict.fromkeys(_STATISTICS)}

    def _check_config(self) -> None:
        super()._check_config()
        if self.config.strategy != "default":
            raise ValueError(
                f"strategy '{self.config.strategy}' does not work with {self.method}: MCMC moves Gaussians between "
                "places and overwrites the state in which level tags travel. Use the default strategy."
            )

    def get_gaussian_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        return {name: [parameter] for name, parameter in self.gauss_params.items()}

    # -- what a method defines ------------------------------------------------------------------------------------

    def _training_renderings(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> list[Rendering]:
        """The pictures that the objective compares; the last is the full one, whose `info` densification reads."""
        raise NotImplementedError

    def _objective(self, outputs: dict[str, Any], target: ViewTarget) -> dict[str, Tensor]:
        """Weighted parts of the loss."""
        raise NotImplementedError

    def _gradient_weights(self) -> Float[Tensor, " n"] | None:
        """What each Gaussian's 2D gradient is divided by before it is compared with the densification threshold."""
        return None

    def _target_options(self) -> dict[str, Any]:
        """Of `PyramidTargets.from_image`: what the objective compares with."""
        return {"dft": False}

    def _adapt_to_images(self, height: int, width: int) -> None:
        """Before a new run: the smallest training image has this size, px."""

    def _begin_run(self, datamanager: Any) -> None:
        """Before a new run: images and cameras are known."""

    def _begin_step(self, step: int) -> None:
        """Before a training step: what the schedule brings."""
        self._sh_degree = self.schedule.sh_degree(step, self.config.sh_degree)

    def _remove_unneeded(self, step: int) -> dict[str, int]:
        """Before refinement: remove Gaussians that nobody needs. Returns what was removed, and how many."""
        dropped = self._drop_unneeded() if self.schedule.drops_unneeded(step) else 0
        return {"dropped (hardly seen)": dropped} if dropped else {}

    def level_choice(self) -> dict[str, Any]:
        """How the number of levels was chosen: `choose_levels.LevelChoice.state`, and `stopped` where no level gained
        enough; empty where it was given."""
        return {}

    def _census(self) -> str:
        """What is logged with the number of Gaussians."""
        return ""

    def _halvings(self) -> int:
        """How often training images are halved at this step: splatfacto's resolution schedule."""
        interval = scaled(self.config.resolution_schedule, self._scale)
        return max(self.config.num_downscales - self.step // interval, 0)

    # -- schedule -------------------------------------------------------------------------------------------------

    def _make_schedule(self) -> Schedule:
        """The schedule of this run, `_scale` being known."""
        config, s = self.config, self._scale
        refine = scaled(config.refine_every, s, config.least_refine_interval)
        stop = scaled(config.stop_split_at, s)
        reset = max(scaled(config.reset_alpha_every * config.refine_every, s), 2 * refine)
        return Schedule(
            num_levels=1,
            level_interval=1,
            refine_every=refine,
            refine_start=scaled(config.warmup_length, s),
            refine_stop=stop,
            refine_pause=0,
            reset_every=reset,
            # after a reset every view is seen once; with thousands of views that must not end densification
            reset_pause=min(self.num_train_data + refine, reset // 2),
            reset_stop=stop - scaled(config.stop_reset_before_end, s),
            screen_size_stop=scaled(config.stop_screen_size_at, s),
            sh_interval=scaled(config.sh_degree_interval, s),
            multiresolution=False,
        )

    def _make_strategy(self) -> LevelStrategy:
        config = self.config
        return LevelStrategy(
            prune_opa=config.cull_alpha_thresh,
            lower_prune_opa=config.cull_alpha_thresh,
            grow_grad2d=config.densify_grad_thresh,
            grow_scale3d=config.densify_size_thresh,
            grow_scale2d=config.split_screen_size,
            prune_scale3d=config.cull_scale_thresh,
            prune_scale2d=config.cull_screen_size,
            absgrad=config.use_absgrad,
            max_gaussians=config.max_gaussians,
        )

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:  # pyright: ignore
        trainer, optimizers = attributes.trainer, attributes.optimizers
        assert trainer is not None and optimizers is not None and attributes.pipeline is not None
        cameras = attributes.pipeline.datamanager.train_dataset.cameras  # pyright: ignore
        resumed = self.step > 0
        if resumed and self._trimmed:
            raise ValueError(
                "this run was written by `freqgs trim`: the state of its optimizers was left out, and training cannot "
                "go on. Resume the run that it was made from, and trim it again when it has finished."
            )
        if self._imported:
            raise ValueError(
                "this run was written by `freqgs import`: it was not trained here, and there is nothing to resume. "
                "`ns-train clodsplat --pipeline.model.init-from` its config.yml trains on from its Gaussians."
            )
        if not resumed:
            steps = trainer.config.max_num_iterations
            if steps < 1:
                raise ValueError(f"max_num_iterations is {steps}; train for at least 1 step.")
            self._scale = self.config.steps_scale or steps / REFERENCE_STEPS
            self._adapt_to_images(int(cameras.height.min()), int(cameras.width.min()))
            self._begin_run(attributes.pipeline.datamanager)
        self.schedule = self._make_schedule()
        self.strategy.reset_every = self.schedule.reset_every
        self.strategy.refine_scale2d_stop_iter = self.schedule.screen_size_stop
        CONSOLE.log(f"Step constants are multiplied by {self._scale:g}.")
        adopt_parameters(optimizers, self.get_param_groups())
        fuse(optimizers, self.get_param_groups())
        scale_schedulers(optimizers, self._scale)
        for name in self.gauss_params:
            optimizers.optimizers[name].register_step_pre_hook(lambda *_: self._check_gradients(trainer))
        self._optimizers = optimizers
        self._all_train_cameras = cameras
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self._before_step),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._after_step),
        ]

    def _train_cameras(self, halvings: int = 0) -> Iterator[Camera]:
        """The training views' cameras, one by one."""
        for index in range(len(self._all_train_cameras)):
            camera: Cameras = self._all_train_cameras[index : index + 1]
            yield to_camera(camera.to(self.device), halvings=halvings)

    # -- a step ---------------------------------------------------------------------------------------------------

    def _before_step(self, step: int) -> None:
        self.step = step
        self._checked = False
        self._step_is_finite = True
        self._begin_step(step)

    def _training_outputs(self, camera: Camera, background: Tensor, cam_idx: int | None) -> dict[str, Any]:
        gaussians = drawn = self.gaussians()
        rate = self.config.dropout
        if rate is None:
            rate = default_dropout(self.num_train_data)
        if rate > 0:
            drawn = replace(gaussians, opacities=drop_out(gaussians.opacities, rate, self.config.seed, self.step))
        renderings = self._training_renderings(drawn, camera, background)
        self._info = renderings[-1].info
        images = [r.features for r in renderings]
        if self.config.use_bilateral_grid and cam_idx is not None:
            height, width = camera.height, camera.width
            images = [self._apply_bilateral_grid(i[None], cam_idx, height, width).squeeze(0) for i in images]
        outputs = {
            "prefixes": images,
            "accumulation": renderings[-1].alpha,
            "background": background,
            "info": self._info,
            "gaussians": gaussians,
        }
        return LazyOutputs(outputs, {"rgb": lambda: show(images[-1].detach())})

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

    # -- densification --------------------------------------------------------------------------------------------

    def _lent_levels(self) -> "_LentLevels":
        return _LentLevels(self)

    def _densify(self, step: int) -> None:
        """After a training step with finite gradients."""
        assert self._info is not None
        if step < self.schedule.refine_stop:
            self.strategy.observe(self.strategy_state, self._info, self._gradient_weights())
        removed = self._remove_unneeded(step)
        with self._lent_levels() as state:
            done = self.strategy.step(self.gauss_params, self._optimizers.optimizers, state, step, self.schedule)
        done.update(removed)
        if done:
            what = ", ".join(f"{count:,} {name}" for name, count in done.items())
            CONSOLE.log(f"Step {step}: {what}; now {self.num_points:,} Gaussians{self._census()}.")

    def _drop_unneeded(self) -> int:
        """Remove Gaussians that the training views hardly show."""
        config = self.config
        if config.least_weight <= 0 and config.least_views <= 1:
            return 0
        gaussians, attenuation = self.gaussians(), self._attenuation()
        weights = [
            rendered_weight(
                gaussians,
                camera,
                self.num_levels,
                rasterizer=self.rasterizer(),
                attenuation=attenuation,
                antialiased=self.antialiased,
            )
            for camera in self._train_cameras(self._halvings())
        ]
        with self._lent_levels() as state:
            return self.strategy.drop_unneeded(
                self.gauss_params, self._optimizers.optimizers, state, weights, config.least_weight, config.least_views
            )

    # -- targets, losses, metrics ---------------------------------------------------------------------------------

    def _halve(self, image: Tensor) -> Tensor:
        """Image [h, w, c] at the size trained at, at least 1 px: means of 2^n x 2^n blocks, as splatfacto's."""
        n = self._halvings()
        if image.dtype == torch.uint8:
            image = image.float() / 255.0
        image = image.to(self.device)
        if n == 0 or not self.training:
            return image
        block = [min(2**n, side) for side in image.shape[:2]]
        return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], block)[0].permute(1, 2, 0).contiguous()

    def _training_targets(self, batch: dict[str, Any], background: Tensor) -> ViewTarget:
        image = batch["image"]
        opaque = image.shape[-1] == 3
        levels = self.num_levels

        def make() -> tuple[Tensor, Tensor | None]:
            mask = self._halve(batch["mask"].float()) if "mask" in batch else None
            return self.composite_with_background(self._halve(image), background), mask

        key = (int(batch["image_idx"]), levels, self._halvings()) if opaque and "image_idx" in batch else None
        return self._targets.get(key, make, levels, **self._target_options())

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        if self.training:
            picture, target = outputs["prefixes"][-1], self._training_targets(batch, outputs["background"]).image
        else:
            target = self.composite_with_background(self._halve(batch["image"]), outputs["background"])
            picture = outputs["rgb"]
        metrics: dict[str, Any] = {
            "gaussian_count": self.num_points,
            "width": picture.shape[1],
            "height": picture.shape[0],
            "skipped_steps": self.guard.skipped,
        }
        self.camera_optimizer.get_metrics_dict(metrics)
        # nerfstudio logs one step in ten
        return LazyOutputs(metrics, {"psnr": lambda: to_psnr(mean_square_as_shown(picture, target))})

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        if not self.training:
            target = self.composite_with_background(self._halve(batch["image"]), outputs["background"])
            pair = [i.permute(2, 0, 1)[None] for i in (outputs["rgb"], target)]
            return {f"image_{self.num_levels}": image_distance(pair[0], pair[1], self.config.ssim_lambda)}
        losses: dict[str, Any] = self._objective(outputs, self._training_targets(batch, outputs["background"]))
        if self.config.use_scale_regularization and self.step % 10 == 0:
            losses["scale_reg"] = self._scale_regularization()
        assert self._info is not None
        shown = self._info["radii"][0] > 0
        if self.config.opacity_penalty != 0:
            losses["opacity"] = self.config.opacity_penalty * opacity_shown(outputs["gaussians"].opacities, shown)
        if self.config.size_penalty != 0:
            losses["size"] = self.config.size_penalty * size_shown(outputs["gaussians"].scales, shown)
        self.camera_optimizer.get_loss_dict(losses)
        if self.config.use_bilateral_grid:
            from nerfstudio.model_components.lib_bilagrid import total_variation_loss

            losses["tv_loss"] = 10 * total_variation_loss(self.bil_grids.grids)
        self.guard.note_losses(losses)
        return losses

    def _scale_regularization(self) -> Float[Tensor, ""]:
        """PhysGaussian's penalty on spikes, as splatfacto's."""
        log_ratio = self.scales.amax(-1) - self.scales.amin(-1)
        return 0.1 * (log_ratio.exp().clamp_min(self.config.max_gauss_ratio) - self.config.max_gauss_ratio).mean()

    # -- checkpoints ----------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, Any]:
        """What a resumed run needs beside parameters and levels."""
        return {
            "step": self.step,
            "steps_scale": self._scale,
            "sh_degree": self._sh_degree,
            "trimmed": self._trimmed,
            "imported": self._imported,
            "strategy": {k: self.strategy_state[k] for k in _STATISTICS if self.strategy_state[k] is not None},
            "guard": self.guard.state(),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.step = int(state["step"])
        self._scale = float(state["steps_scale"])
        self._sh_degree = int(state["sh_degree"])
        self._trimmed = bool(state.get("trimmed", False))
        self._imported = bool(state.get("imported", False))
        for key in _STATISTICS:
            value = state["strategy"].get(key)
            self.strategy_state[key] = None if value is None else value.to(self.device)
        self.guard.load_state(state.get("guard"))

    def load_state_dict(self, dict: dict[str, Any], **kwargs: Any) -> Any:  # pyright: ignore
        if "level" not in dict or "_extra_state" not in dict:
            raise ValueError(
                "the checkpoint holds no levels: it was not made by this method. "
                "Load it with the method that made it (see `method_name` in its config.yml)."
            )
        dict = unpack(dict)
        prefix = "gauss_params."
        groups = {key.removeprefix(prefix) for key in dict if key.startswith(prefix)}
        if groups != set(self.gauss_params):
            raise ValueError(
                f"the checkpoint holds the parameters {', '.join(sorted(groups))}, this model has "
                f"{', '.join(sorted(self.gauss_params))}: it was made by another method or with other settings. "
                "Load it with the method and the settings of its config.yml."
            )
        self.level = torch.zeros_like(dict["level"], device=self.device)
        self._rasterizer = None
        return super().load_state_dict(dict, **kwargs)


class _LentLevels:
    """The strategy's state with the level tags in it, for the length of a block: they follow every operator."""

    def __init__(self, model: FreqSplatModel):
        self._model = model

    def __enter__(self) -> dict[str, Any]:
        state = self._model.strategy_state
        state["level"] = self._model.level
        return state

    def __exit__(self, *_: object) -> None:
        self._model.level = self._model.strategy_state.pop("level")
