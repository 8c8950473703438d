"""`lapsplat`: Gaussians in Laplacian-pyramid levels ("Frequency-Aware Gaussian Splatting Decomposition")."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, LevelCut, Product
from freqgs_plugin.functional.budget import LevelBudget, in_view
from freqgs_plugin.functional.pyramid import max_levels, reduce
from freqgs_plugin.rendering.render import render_prefixes, rendered_weight
from freqgs_plugin.studio.config import FreqSplatModelConfig
from freqgs_plugin.studio.controls import band_of, level_cut, lod_slider
from freqgs_plugin.studio.level_gain import LevelGain, view_image
from freqgs_plugin.studio.model import FreqSplatModel
from freqgs_plugin.studio.optimizers import restart
from freqgs_plugin.studio.outputs import LazyOutputs
from freqgs_plugin.studio.panel import Panel
from freqgs_plugin.studio.targets import ViewTarget
from freqgs_plugin.studio.viewing import psnr, show
from freqgs_plugin.training.baking import signed_refusal
from freqgs_plugin.training.choose_levels import MOST_LEVELS, choose_levels
from freqgs_plugin.training.densify import Growth, LevelStrategy, add_level
from freqgs_plugin.training.objective import pyramid_objective
from freqgs_plugin.training.promote import promote, surplus
from freqgs_plugin.training.schedule import Schedule, scaled
from freqgs_plugin.types import Camera, Gaussians, Rendering

# one colour per level, coarse to fine (Okabe and Ito, told apart by colour-blind readers)
_PALETTE = ((0.90, 0.62, 0.00), (0.34, 0.71, 0.91), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.94, 0.89, 0.26))


@dataclass
class LapSplatModelConfig(FreqSplatModelConfig):
    """Fields of `lapsplat`. Step constants are for runs of 30,000 steps and scale with the run's length."""

    _target: type = field(default_factory=lambda: LapSplatModel)
    num_levels: int | Literal["auto"] = 3
    """levels L at the end of training (the paper: 3 or 5); 1 is splatfacto's algorithm; auto: one for each band of the
    photographs that holds enough energy (ours)"""
    auto_psnr: float = 30.0
    """PSNR whose mean square error is the budget by which num-levels auto judges bands, dB (ours)"""
    auto_share: float = 0.1
    """share of that budget which a Laplacian band must hold to get a level (ours)"""
    least_level_gain: float = 0.0
    """dB by which a new level must improve training views that are held back for it, or none is added after it, and
    training goes on at full size; 0: no view is held back (ours)"""
    level_interval: int = 2500
    """K: steps between two new levels (the paper)"""
    refine_pause: int = 300
    """steps without densification after a new level (the paper)"""
    multiresolution: bool = True
    """stage m trains at 1 / 2^(L - m) of full size (the paper)"""
    signed_residuals: bool = True
    """levels above 1 hold colours in [-1, inf) (Eq. 4); off: [0, inf) for all, which exports as a plain PLY"""
    image_weight: float = 1.0
    """weight of the image term (Eq. 13, the paper)"""
    dft_weight: float = 1e-3
    """weight of the frequency term (Eq. 13, the paper); 0 leaves it out"""
    dft_size: Literal["image", "fast"] = "fast"
    """size of the transforms: the image's (the paper), or with zeros up to the next one without prime factors above 13
    (ours), which takes down to a fifth of the time"""
    dft_norm: Literal["backward", "ortho"] = "backward"
    """scaling of the DFT: none (the paper; the term then grows with image size) or 1 / sqrt(pixels)"""
    lower_level_weight: float = 0.2
    """lambda_k of the image term for prefixes k < m (Eq. 12; ours, the paper: 0.1); 0 leaves them out"""
    growth: Growth = "newest"
    """which Gaussians may grow: all (the paper), the newest level's (ours), or each level from its own_prefix"""
    dropout: float | None = None
    """share of Gaussians that each training step leaves out at random, in [0, 1); 0: none; None: 0.1 if fewer than 25
    views train, else none (ours)"""
    opacity_penalty: float = 0.01
    """weight of the mean opacity of what a view shows: Gaussians that it does not need fade and are pruned (ours)"""
    size_penalty: float = 0.01
    """weight of the mean standard deviation of what a view shows, world units; 0: none (ours)"""
    densify_grad_thresh: float = 0.0006
    """2D gradient, in units of half the image, above which a Gaussian grows (ours; splatfacto: 0.0008)"""
    split_screen_size: float = 0.03
    """radius on the screen, as a share of the longer side, above which a Gaussian is split (ours; splatfacto: 0.05)"""
    coarse_growth_factor: float = 1.8
    """densification threshold is multiplied by this for each level below the finest (ours; the paper: 1)"""
    lower_cull_alpha_thresh: float = 0.22
    """opacity under which Gaussians of levels below the newest are pruned (ours; the paper: 0.1, as the newest)"""
    reset_levels: Literal["all", "newest"] = "all"
    """whose opacities are reset: all levels' (the paper) or only the newest's (ours)"""
    restart_schedulers: bool = True
    """learning rate schedules begin anew with each level, as optimizers do (the paper)"""
    base_share: float = 1.0
    """share of all Gaussians that level 1 may have in the last stage: what its own small pictures need least moves to
    level 2, with its colour; 1: any (ours)"""
    new_level_opacity: float | None = None
    """bound on the opacity of a new level's duplicates; None: as their originals (the paper)"""


class LapSplatModel(FreqSplatModel):
    """Levels are added in stages; every prefix of levels is trained towards the image at that level's detail."""

    config: LapSplatModelConfig
    method = "lapsplat"

    def _check_config(self) -> None:
        super()._check_config()
        config = self.config
        if isinstance(config.num_levels, int) and config.num_levels < 1:
            raise ValueError(f"num_levels is {config.num_levels}; it must be at least 1, or auto.")
        opacity = config.new_level_opacity
        if opacity is not None and not 0 < opacity < 1:
            raise ValueError(f"new_level_opacity is {opacity}; it must be between 0 and 1, or None: as the originals.")
        if not 0 < config.coarse_growth_factor < float("inf"):
            raise ValueError(f"coarse_growth_factor is {config.coarse_growth_factor}; it must be a finite number > 0.")
        weights = ("image_weight", "dft_weight", "lower_level_weight")
        for name in ("auto_psnr", "auto_share", "least_level_gain", *weights):
            if not 0 <= getattr(config, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(config, name)}; it must be a finite number >= 0.")
        if not 0 < config.base_share <= 1:
            raise ValueError(f"base_share is {config.base_share}; it must be over 0 and at most 1 (1: no bound).")
        if config.level_interval < 1:
            raise ValueError(f"level_interval is {config.level_interval} steps; it must be at least 1.")

    def populate_modules(self) -> None:
        super().populate_modules()
        self._stage = 1
        self._num_levels = self._most_levels()
        self._level_choice: dict[str, Any] = {}
        self._gain = LevelGain()

    def _most_levels(self) -> int:
        """As many as the config asks for; with auto as many as there may be."""
        levels = self.config.num_levels
        return levels if isinstance(levels, int) else MOST_LEVELS

    # -- schedule and densification -------------------------------------------------------------------------------

    @property
    def num_levels(self) -> int:
        """Levels present now."""
        return self._stage

    def _adapt_to_images(self, height: int, width: int) -> None:
        wanted = self._most_levels()
        self._num_levels = min(wanted, max_levels(height, width))
        if self._num_levels < wanted and self.config.num_levels != "auto":
            CONSOLE.log(
                f"[yellow]{self._num_levels} levels instead of {wanted}: "
                f"with more, images of {width}x{height} px would be trained at under 16 px."
            )

    def _begin_run(self, datamanager: Any) -> None:
        super()._begin_run(datamanager)
        config = self.config
        if config.num_levels == "auto":
            images = (view_image(self, data) for data in datamanager.cached_train)
            choice = choose_levels(images, config.auto_psnr, config.auto_share)
            self._num_levels, self._level_choice = choice.levels, choice.state()
            CONSOLE.log(choice.text())
        self.controls.set_slider(lod_slider(self._num_levels), self._num_levels)

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:  # pyright: ignore
        callbacks = super().get_training_callbacks(attributes)
        if self.config.least_level_gain > 0 and 2 < self._num_levels > self._stage:
            assert attributes.pipeline is not None
            self._gain.hold_back(attributes.pipeline.datamanager)
        return callbacks

    def level_choice(self) -> dict[str, Any]:
        return dict(self._level_choice)

    def _make_schedule(self) -> Schedule:
        config, s = self.config, self._scale
        return replace(
            super()._make_schedule(),
            num_levels=self._num_levels,
            level_interval=scaled(config.level_interval, s),
            refine_pause=scaled(config.refine_pause, s, least=0),
            multiresolution=config.multiresolution,
        )

    def _make_strategy(self) -> LevelStrategy:
        config = self.config
        return replace(
            super()._make_strategy(),
            growth=config.growth,
            lower_prune_opa=config.lower_cull_alpha_thresh,
            reset_levels=config.reset_levels,
        )

    def _halvings(self) -> int:
        return super()._halvings() if self._num_levels == 1 else self.schedule.halvings(self._stage)

    def _begin_step(self, step: int) -> None:
        super()._begin_step(step)
        while self._stage < self.schedule.stage(step):
            if self._last_level_gained():
                self._enter_stage(self._stage + 1)
            else:
                self._num_levels = self._stage
                self.schedule = self._make_schedule()
                self._targets.clear()
            if self._stage == self._num_levels:
                self._gain.release()

    def _last_level_gained(self) -> bool:
        """Whether the newest level was worth its while; measured before the next one begins."""
        if not self._gain.active:
            return True
        gain = self._gain.measure(self)
        if gain is None or gain >= self.config.least_level_gain:
            return True
        text = (
            f"Step {self.step}: level {self._stage} gained {gain:.2f} dB on {self._gain.count} views that were held "
            f"back, less than {self.config.least_level_gain:g}: no further level of {self._num_levels}."
        )
        self._level_choice["stopped"] = text
        CONSOLE.log(text)
        return False

    def _enter_stage(self, stage: int) -> None:
        restart(self._optimizers, tuple(self.gauss_params), self.config.restart_schedulers)
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

    def _remove_unneeded(self, step: int) -> dict[str, int]:
        done = super()._remove_unneeded(step)
        if 1 < self._stage == self._num_levels and self.schedule.drops_unneeded(step):
            moved = self._bound_base()
            done.update({"moved to level 2": moved} if moved else {})
        return done

    def _bound_base(self) -> int:
        """Move what the base's pictures, at their own size, need least to level 2. Returns how many."""
        share, level = self.config.base_share, self.level
        if int((level == 1).sum()) <= share * len(level):  # pyright: ignore
            return 0
        gaussians, base = self.gaussians(), LevelCut(1)
        weight = gaussians.means.new_zeros(len(gaussians))
        for camera in self._train_cameras(self._num_levels - 1):
            weight += rendered_weight(
                gaussians, camera, 1, base, rasterizer=self.rasterizer(), antialiased=self.antialiased
            )
        rows = surplus(level, weight, share)  # pyright: ignore
        return promote(self.gauss_params, self._optimizers.optimizers, level, rows, self._signed())  # pyright: ignore

    def _gradient_weights(self) -> Float[Tensor, " n"]:
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

    def _census(self) -> str:
        return f", by level {' / '.join(f'{count:,}' for count in self.level_counts())}"

    # -- training -------------------------------------------------------------------------------------------------

    def _signed(self) -> bool:
        return self.config.signed_residuals

    def _training_renderings(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> list[Rendering]:
        return render_prefixes(
            gaussians,
            camera,
            self._stage,
            rasterizer=self.rasterizer(),
            background=background,
            antialiased=self.antialiased,
            statistics="own" if self.config.growth == "own_prefix" else "full",
        )

    def _target_options(self) -> dict[str, Any]:
        return {"dft": self.config.dft_weight != 0, "dft_size": self.config.dft_size}

    def _objective(self, outputs: dict[str, Any], target: ViewTarget) -> dict[str, Tensor]:
        config = self.config
        return pyramid_objective(
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

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        metrics = super().get_metrics_dict(outputs, batch)
        metrics["stage"] = self._stage
        metrics.update({f"gaussians_level_{k}": c for k, c in enumerate(self.level_counts(), start=1)})
        return metrics

    # -- checkpoints ----------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, Any]:
        ours = {"stage": self._stage, "num_levels": self._num_levels, "level_choice": self._level_choice}
        return {**super().get_extra_state(), **ours, "level_psnr": self._gain.last}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        super().set_extra_state(state)
        self._stage = int(state["stage"])
        self._num_levels = int(state["num_levels"])
        self._level_choice = dict(state.get("level_choice", {}))
        self._gain.last = state.get("level_psnr")
        self.controls.set_slider(lod_slider(self._num_levels), self._num_levels)

    # -- pictures, evaluation, export -----------------------------------------------------------------------------

    def _make_controls(self) -> Panel:
        levels = self._most_levels()
        return Panel(
            lod_slider(levels), ("prefix", "all", "band", "budget") if levels > 1 else ("all", "budget"), levels
        )

    def _viewer_attenuation(self, gaussians: Gaussians, camera: Camera) -> Attenuation | None:
        mode, count = self.controls.mode.value, self.controls.count()
        self._say_if_under_the_base(gaussians, camera, count)
        if mode == "all":
            return None
        cut = LevelCut(band_of(self.controls.slider)) if mode == "band" else level_cut(self.controls.slider)
        return cut if count is None else Product((cut, LevelBudget(count)))

    def _viewer_subtrahend(self) -> Attenuation | None:
        level = band_of(self.controls.slider)
        return LevelCut(level - 1) if self.controls.mode.value == "band" and level > 1 else None

    def _say_if_under_the_base(self, gaussians: Gaussians, camera: Camera, count: int | None) -> None:
        """A note where a budget does not hold level 1."""
        text = None
        if count is not None and count < int((gaussians.level == 1).sum()):
            base = int((in_view(gaussians, camera) & (gaussians.level == 1)).sum())
            if count < base:
                text = f"The budget of {count:,} is below level 1, of which {base:,} are in view: it is drawn in part."
        self.controls.say("base", text)

    def _more_outputs(
        self, gaussians: Gaussians, camera: Camera, background: Tensor, notes: dict[str, float]
    ) -> dict[str, Any]:
        def prefix(k: int) -> Tensor:
            return self.draw(gaussians, camera, background, LevelCut(k)).features

        def band(k: int) -> Tensor:
            return show(prefix(1)) if k == 1 else show(0.5 + prefix(k) - prefix(k - 1))

        def levels() -> Tensor:
            palette = gaussians.means.new_tensor([_PALETTE[k % len(_PALETTE)] for k in range(self._num_levels)])
            colours = palette[gaussians.level.long() - 1]
            return show(self.paint(gaussians, colours, camera).features)

        outputs: dict[str, Any] = {}
        for k in range(1, self._num_levels + 1):
            outputs[f"prefix_{k}"] = lambda k=k: show(prefix(k))
        for k in range(1, self._num_levels + 1):
            outputs[f"band_{k}"] = lambda k=k: band(k)
        outputs["levels"] = levels
        return outputs

    def _more_metrics(self, outputs: LazyOutputs, target: Tensor) -> dict[str, float]:
        """PSNR of each prefix against the image reduced to its level (REDUCE^n, Eq. 9), and counts."""
        metrics = {}
        full = target.permute(2, 0, 1)[None]
        counts = self.level_counts() + [0] * (self._num_levels - self._stage)
        for k in range(1, self._num_levels + 1):
            n = self._num_levels - k
            picture = outputs[f"prefix_{k}"].permute(2, 0, 1)[None]
            metrics[f"psnr_prefix_{k}"] = float(psnr(reduce(picture, n), reduce(full, n)))
            metrics[f"gaussians_prefix_{k}"] = float(sum(counts[:k]))
            metrics[f"gaussians_level_{k}"] = float(counts[k - 1])
        return metrics

    def _before_export(self) -> None:
        if self.config.signed_residuals and self._stage > 1:
            raise ValueError(signed_refusal(self._stage))
