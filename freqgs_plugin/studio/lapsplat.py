"""`lapsplat`: Gaussians in Laplacian-pyramid levels ("Frequency-Aware Gaussian Splatting Decomposition")."""

from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Float
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, LevelCut
from freqgs_plugin.functional.image_loss import image_distance
from freqgs_plugin.functional.pyramid import max_levels, reduce
from freqgs_plugin.rendering.render import render_prefixes, rendered_weight
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.controls import level_cut, lod_slider
from freqgs_plugin.studio.model import GROUPS, FreqSplatModel, FreqSplatModelConfig, show
from freqgs_plugin.studio.optimizers import restart
from freqgs_plugin.studio.targets import TargetCache
from freqgs_plugin.training.densify import Growth, LevelStrategy, add_level
from freqgs_plugin.training.objective import pyramid_objective
from freqgs_plugin.training.schedule import Schedule, scaled
from freqgs_plugin.types import Camera, Gaussians, Splats

# one colour per level, coarse to fine (Okabe and Ito, told apart by colour-blind readers)
_PALETTE = ((0.90, 0.62, 0.00), (0.34, 0.71, 0.91), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.94, 0.89, 0.26))


@dataclass
class LapSplatModelConfig(FreqSplatModelConfig):
    """Fields of `lapsplat`. Step constants are for runs of 30,000 steps and scale with the run's length."""

    _target: type = field(default_factory=lambda: LapSplatModel)
    num_levels: int = 3
    """levels L at the end of training (the paper: 3 or 5); 1 is splatfacto's algorithm"""
    level_interval: int = 2500
    """K: steps between two new levels (the paper)"""
    refine_pause: int = 300
    """steps without densification after a new level (the paper)"""
    multiresolution: bool = True
    """stage m trains at 1 / 2^(L - m) of full size (the paper)"""
    stop_split_at: int = 27_000
    """densification ends at this step, so that the last Gaussians can settle (ours; the paper: never)"""
    signed_residuals: bool = True
    """levels above 1 hold colours in [-1, inf) (Eq. 4); off: [0, inf) for all, which exports as a plain PLY"""
    image_weight: float = 1.0
    """weight of the image term (Eq. 13, the paper)"""
    dft_weight: float = 1e-3
    """weight of the frequency term (Eq. 13, the paper); 0 leaves it out"""
    dft_norm: Literal["backward", "ortho"] = "backward"
    """scaling of the DFT: none (the paper; the term then grows with image size) or 1 / sqrt(pixels)"""
    lower_level_weight: float = 0.2
    """lambda_k of the image term for prefixes k < m (Eq. 12; ours, the paper: 0.1); 0 leaves them out"""
    clamp_in_loss: Literal["none", "hard", "straight_through"] = "none"
    """clamp pictures to [0, 1] before the loss: hard (the paper's code) stops gradients outside of it (ours: none)"""
    strategy: Literal["default", "mcmc"] = "default"
    """densification strategy; mcmc is refused, with the reason"""
    growth: Growth = "newest"
    """which Gaussians may grow: all (the paper), the newest level's (ours), or each level from its own_prefix"""
    densify_grad_thresh: float = 0.0006
    """2D gradient, in units of half the image, above which a Gaussian grows (ours; splatfacto: 0.0008)"""
    least_weight: float = 1.0
    """Gaussians whose weight over all training views is under this many pixels are removed; 0: none (ours)"""
    least_views: int = 2
    """Gaussians above level 1 that fewer training views show are removed; 0: none (ours)"""
    coarse_growth_factor: float = 1.8
    """densification threshold is multiplied by this for each level below the finest (ours; the paper: 1)"""
    lower_cull_alpha_thresh: float = 0.1
    """opacity under which Gaussians of levels below the newest are pruned (the paper: as the newest)"""
    reset_levels: Literal["all", "newest"] = "all"
    """whose opacities are reset: all levels' (the paper) or only the newest's (ours)"""
    restart_schedulers: bool = True
    """learning rate schedules begin anew with each level, as optimizers do (the paper)"""
    new_level_opacity: float | None = None
    """bound on the opacity of a new level's duplicates; None: as their originals (the paper)"""
    target_cache_mb: int = 1024
    """memory for training targets that are kept from step to step, megabytes"""


class LapSplatModel(FreqSplatModel):
    """Levels are added in stages; every prefix of levels is trained towards the image at that level's detail."""

    config: LapSplatModelConfig

    def _check_config(self) -> None:
        super()._check_config()
        config = self.config
        if config.num_levels < 1:
            raise ValueError(f"num_levels is {config.num_levels}; it must be at least 1.")
        if config.level_interval < 1:
            raise ValueError(f"level_interval is {config.level_interval} steps; it must be at least 1.")
        if config.strategy != "default":
            raise ValueError(
                f"strategy '{config.strategy}' does not work with lapsplat: MCMC moves Gaussians between places and "
                "overwrites the state in which level tags travel. Use the default strategy."
            )

    def populate_modules(self) -> None:
        super().populate_modules()
        self._stage = 1
        self._num_levels = self.config.num_levels
        self._targets = TargetCache(self.config.target_cache_mb)
        self.lod = lod_slider(self.config.num_levels)

    # -- schedule and densification -------------------------------------------------------------------------------

    @property
    def num_levels(self) -> int:
        """Levels present now."""
        return self._stage

    def _adapt_to_images(self, height: int, width: int) -> None:
        self._num_levels = min(self.config.num_levels, max_levels(height, width))
        if self._num_levels < self.config.num_levels:
            CONSOLE.log(
                f"[yellow]{self._num_levels} levels instead of {self.config.num_levels}: "
                f"with more, images of {width}x{height} px would be trained at under 16 px."
            )

    def _set_up_schedule(self) -> None:
        config, s = self.config, self._scale
        refine = scaled(config.refine_every, s, config.least_refine_interval)
        stop = scaled(config.stop_split_at, s)
        reset = max(scaled(config.reset_alpha_every * config.refine_every, s), 2 * refine)
        self.schedule = Schedule(
            num_levels=self._num_levels,
            level_interval=scaled(config.level_interval, s),
            refine_every=refine,
            refine_start=scaled(config.warmup_length, s),
            refine_stop=stop,
            refine_pause=scaled(config.refine_pause, s, least=0),
            reset_every=reset,
            # after a reset every view is seen once; with thousands of views that must not end densification
            reset_pause=min(self.num_train_data + refine, reset // 2),
            reset_stop=stop - scaled(config.stop_reset_before_end, s),
            screen_size_stop=scaled(config.stop_screen_size_at, s),
            sh_interval=scaled(config.sh_degree_interval, s),
            multiresolution=config.multiresolution,
        )
        self.strategy.reset_every = reset
        self.strategy.refine_scale2d_stop_iter = self.schedule.screen_size_stop

    def _make_strategy(self) -> LevelStrategy:
        config = self.config
        return LevelStrategy(
            prune_opa=config.cull_alpha_thresh,
            grow_grad2d=config.densify_grad_thresh,
            grow_scale3d=config.densify_size_thresh,
            grow_scale2d=config.split_screen_size,
            prune_scale3d=config.cull_scale_thresh,
            prune_scale2d=config.cull_screen_size,
            absgrad=config.use_absgrad,
            growth=config.growth,
            lower_prune_opa=config.lower_cull_alpha_thresh,
            reset_levels=config.reset_levels,
            max_gaussians=config.max_gaussians,
        )

    def _halvings(self) -> int:
        if self._num_levels == 1:
            interval = scaled(self.config.resolution_schedule, self._scale)
            return max(self.config.num_downscales - self.step // interval, 0)
        return self.schedule.halvings(self._stage)

    def _begin_step(self, step: int) -> None:
        self._sh_degree = self.schedule.sh_degree(step, self.config.sh_degree)
        while self._stage < self.schedule.stage(step):
            self._enter_stage(self._stage + 1)

    def _enter_stage(self, stage: int) -> None:
        restart(self._optimizers, GROUPS, self.config.restart_schedulers)
        with self._lent_levels() as state:
            added = add_level(
                self.gauss_params, self._optimizers.optimizers, state, stage, self.config.new_level_opacity
            )
        self._stage = stage
        self._targets.clear()
        CONSOLE.log(
            f"Step {self.step}: level {stage} of {self._num_levels} begins with {added:,} Gaussians, "
            f"at 1/{2 ** self._halvings()} size."
        )

    def _lent_levels(self) -> "_LentLevels":
        return _LentLevels(self)

    def _densify(self, step: int) -> None:
        assert self._info is not None
        self.strategy.observe(self.strategy_state, self._info, self._gradient_weights())
        optimizers = self._optimizers.optimizers
        dropped = self._drop_unneeded(optimizers) if self.schedule.drops_unneeded(step) else 0
        with self._lent_levels() as state:
            done = self.strategy.step(self.gauss_params, optimizers, state, step, self.schedule)
        if dropped:
            done["dropped (hardly seen)"] = dropped
        if done:
            what = ", ".join(f"{count:,} {name}" for name, count in done.items())
            levels = " / ".join(f"{c:,}" for c in self.level_counts())
            CONSOLE.log(f"Step {step}: {what}; now {self.num_points:,} Gaussians, by level {levels}.")

    def _drop_unneeded(self, optimizers: Any) -> int:
        """Remove Gaussians that the training views hardly show."""
        config = self.config
        if config.least_weight <= 0 and config.least_views <= 1:
            return 0
        gaussians = self.gaussians()
        weights = [
            rendered_weight(
                gaussians,
                to_camera(camera.to(self.device), halvings=self._halvings()),
                self._stage,
                rasterizer=self.rasterizer(),
                antialiased=self.antialiased,
            )
            for camera in self._train_cameras()
        ]
        with self._lent_levels() as state:
            return self.strategy.drop_unneeded(
                self.gauss_params, optimizers, state, weights, config.least_weight, config.least_views
            )

    def _gradient_weights(self) -> Float[Tensor, " n"]:
        """What each Gaussian's 2D gradient is divided by before it is compared with the densification threshold."""
        config = self.config
        level: Tensor = self.level  # pyright: ignore[reportAssignmentType]
        weight = config.coarse_growth_factor ** (self._num_levels - level).float()
        if config.growth == "own_prefix" and config.lower_level_weight > 0:
            # free the gradient from the loss weight of its prefix
            weight = torch.where(level < self._stage, weight * config.lower_level_weight, weight)
        return weight

    def level_counts(self) -> list[int]:
        """Gaussians of each level, 1..L so far."""
        return torch.bincount(self.level.long(), minlength=self._stage + 1)[1:].tolist()  # pyright: ignore

    # -- training -------------------------------------------------------------------------------------------------

    def _signed(self) -> bool:
        return self.config.signed_residuals

    def _training_outputs(self, camera: Camera, background: Tensor, cam_idx: int | None) -> dict[str, Any]:
        renderings = render_prefixes(
            self.gaussians(),
            camera,
            self._stage,
            rasterizer=self.rasterizer(),
            background=background,
            antialiased=self.antialiased,
            statistics="own" if self.config.growth == "own_prefix" else "full",
        )
        self._info = renderings[-1].info
        images = [r.features for r in renderings]
        if self.config.use_bilateral_grid and cam_idx is not None:
            height, width = camera.height, camera.width
            images = [self._apply_bilateral_grid(i[None], cam_idx, height, width).squeeze(0) for i in images]
        return {
            "rgb": show(images[-1].detach()),
            "prefixes": images,
            "accumulation": renderings[-1].alpha,
            "background": background,
        }

    def _halve(self, image: Tensor) -> Tensor:
        """Image [h, w, c] at the size of this stage, at least 1 px: means of 2^n x 2^n blocks, as splatfacto's."""
        n = self._halvings()
        if image.dtype == torch.uint8:
            image = image.float() / 255.0
        image = image.to(self.device)
        if n == 0 or not self.training:
            return image
        block = [min(2**n, side) for side in image.shape[:2]]
        return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], block)[0].permute(1, 2, 0).contiguous()

    def _training_targets(self, batch: dict[str, Any], background: Tensor) -> Any:
        image = batch["image"]
        opaque = image.shape[-1] == 3
        levels = self._stage

        def make() -> tuple[Tensor, Tensor | None]:
            mask = self._halve(batch["mask"].float()) if "mask" in batch else None
            return self.composite_with_background(self._halve(image), background), mask

        key = (int(batch["image_idx"]), levels, self._halvings()) if opaque and "image_idx" in batch else None
        return self._targets.get(key, make, levels, dft=self.config.dft_weight != 0)

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        target = self._training_targets(batch, outputs["background"]).image if self.training else self._halve(
            batch["image"]
        )  # fmt: skip
        if not self.training:
            target = self.composite_with_background(target, outputs["background"])
        error = torch.mean((outputs["rgb"] - target) ** 2)
        metrics: dict[str, Any] = {
            "psnr": -10 * torch.log10(error.clamp_min(1e-12)),
            "gaussian_count": self.num_points,
            "stage": self._stage,
            "width": outputs["rgb"].shape[1],
            "height": outputs["rgb"].shape[0],
            "skipped_steps": self.guard.skipped,
        }
        metrics.update({f"gaussians_level_{k}": c for k, c in enumerate(self.level_counts(), start=1)})
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        if not self.training:
            target = self.composite_with_background(self._halve(batch["image"]), outputs["background"])
            pair = [i.permute(2, 0, 1)[None] for i in (outputs["rgb"], target)]
            return {f"image_{self._stage}": image_distance(pair[0], pair[1], self.config.ssim_lambda)}
        target = self._training_targets(batch, outputs["background"])
        config = self.config
        losses: dict[str, Any] = pyramid_objective(
            outputs["prefixes"],
            target.image,
            level_weights=[config.lower_level_weight] * (self._stage - 1) + [1.0],
            ssim_weight=config.ssim_lambda,
            dft_weight=config.dft_weight,
            dft_norm=config.dft_norm,
            image_weight=config.image_weight,
            clamp_mode=config.clamp_in_loss,
            mask=target.mask,
            targets=target.pyramid,
        )
        if config.use_scale_regularization and self.step % 10 == 0:
            losses["scale_reg"] = self._scale_regularization()
        self.camera_optimizer.get_loss_dict(losses)
        if config.use_bilateral_grid:
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
        return {**super().get_extra_state(), "stage": self._stage, "num_levels": self._num_levels}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        super().set_extra_state(state)
        self._stage = int(state["stage"])
        self._num_levels = int(state["num_levels"])
        self.lod = lod_slider(self._num_levels)

    # -- pictures, evaluation, export -----------------------------------------------------------------------------

    def _viewer_attenuation(self) -> Attenuation | None:
        return level_cut(self.lod)

    def _more_outputs(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> dict[str, Any]:
        def prefix(k: int) -> Tensor:
            return self.draw(gaussians, camera, background, LevelCut(k)).features

        def band(k: int) -> Tensor:
            return show(prefix(1)) if k == 1 else show(0.5 + prefix(k) - prefix(k - 1))

        def levels() -> Tensor:
            palette = gaussians.means.new_tensor([_PALETTE[k % len(_PALETTE)] for k in range(self._num_levels)])
            colours = palette[gaussians.level.long() - 1]
            splats = Splats(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colours)
            black = torch.zeros_like(background)
            return show(
                self.rasterizer()(splats, camera, background=black, antialiased=self.antialiased, depth=False).features
            )

        outputs: dict[str, Any] = {}
        for k in range(1, self._num_levels + 1):
            outputs[f"prefix_{k}"] = lambda k=k: show(prefix(k))
        for k in range(1, self._num_levels + 1):
            outputs[f"band_{k}"] = lambda k=k: band(k)
        outputs["levels"] = levels
        return outputs

    def _more_metrics(self, outputs: dict[str, Any], target: Tensor) -> dict[str, float]:
        """PSNR of each prefix against the image reduced to its level (REDUCE^n, Eq. 9), and counts."""
        metrics = {}
        full = target.permute(2, 0, 1)[None]
        counts = self.level_counts() + [0] * (self._num_levels - self._stage)
        for k in range(1, self._num_levels + 1):
            n = self._num_levels - k
            picture = outputs[f"prefix_{k}"].permute(2, 0, 1)[None]
            error = torch.mean((reduce(picture, n) - reduce(full, n)) ** 2)
            metrics[f"psnr_prefix_{k}"] = float(-10 * torch.log10(error.clamp_min(1e-12)))
            metrics[f"gaussians_prefix_{k}"] = float(sum(counts[:k]))
            metrics[f"gaussians_level_{k}"] = float(counts[k - 1])
        return metrics

    def _refuse_export(self) -> None:
        if self.config.signed_residuals and self._stage > 1:
            raise ValueError(
                f"this scene has {self._stage} levels with signed residual colours (in [-1, inf)). A 3DGS PLY cannot "
                "hold them: viewers clamp each Gaussian's colour at 0, and the picture would be wrong. Train with "
                "`--pipeline.model.signed-residuals False` to export a scene of several levels."
            )


class _LentLevels:
    """The strategy's state with the level tags in it, for the length of a block: they follow every operator."""

    def __init__(self, model: LapSplatModel):
        self._model = model

    def __enter__(self) -> dict[str, Any]:
        state = self._model.strategy_state
        state["level"] = self._model.level
        return state

    def __exit__(self, *_: object) -> None:
        self._model.level = self._model.strategy_state.pop("level")
