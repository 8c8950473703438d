"""`clodsplat`: opacities that fall with distance at a learned rate ("CLoD-GS: Continuous Level-of-Detail")."""

import statistics
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.utils.colormaps import apply_float_colormap
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, DistanceDecay, Reference, frustum_distance
from freqgs_plugin.functional.budget import DecayBudget
from freqgs_plugin.functional.fading import faded_logits
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.rendering.render import render_prefixes
from freqgs_plugin.studio.config import FreqSplatModelConfig
from freqgs_plugin.studio.controls import Stopwatch, detail_slider, in_viewer
from freqgs_plugin.studio.model import FreqSplatModel
from freqgs_plugin.studio.optimizers import set_rate
from freqgs_plugin.studio.outputs import LazyOutputs
from freqgs_plugin.studio.panel import Panel
from freqgs_plugin.studio.starting import start_from
from freqgs_plugin.studio.targets import ViewTarget
from freqgs_plugin.studio.viewing import psnr, show, uncached_property
from freqgs_plugin.training.detail import CountGradient, DetailSampling, count_loss
from freqgs_plugin.training.objective import pyramid_objective
from freqgs_plugin.training.presets import LARGEST_SCALE
from freqgs_plugin.training.schedule import Schedule, scaled
from freqgs_plugin.types import Camera, Gaussians, Rendering

_LARGEST_SPEEDUP = 10.0
"""the decays' learning rate is never more than so many times its setting"""


@dataclass
class ClodSplatModelConfig(FreqSplatModelConfig):
    """Fields of `clodsplat`. Step constants are for runs of 30,000 steps and scale with the run's length."""

    _target: type = field(default_factory=lambda: ClodSplatModel)
    use_decay: bool = True
    """learn a distance decay for each Gaussian; off: everything else stays as it is, to compare with"""
    decay_start_step: int = 5000
    """step from which opacities decay with distance (the paper)"""
    initial_decay: float = 5.0
    """sigma of every Gaussian at first, in normalised distances (ours; the paper does not say)"""
    largest_scale: float = LARGEST_SCALE
    """s_max: training draws its virtual distance scale from U(1, s_max) (the paper: 1, 3, 5 or 7)"""
    full_detail_every: int = 2
    """every so many steps the scale is 1 (ours); 0: only by chance (the paper)"""
    weigh_scales: bool = True
    """steps at larger scales count less, by w_s of Eq. 5 (the paper)"""
    reg_weight: float = 1.0
    """lambda_reg of the loss on the number of drawn Gaussians (Eq. 5, the paper); 0 leaves it out"""
    reg_gradient: CountGradient = "ste"
    """gradient of that loss: none (the paper's formula has none), ste (counts exactly, gradient of a sigmoid; ours),
    soft (sum of the sigmoids). ste and soft are divided by (s_max - 1)^2"""
    reg_temperature: float = 2.0
    """width of these sigmoids, in units of ln(opacity / threshold): the wider, the more opaque are Gaussians that are
    still pushed to fade (ours)"""
    reg_opacities: bool = False
    """opacities learn from that loss, too: fewer Gaussians, but hardly fewer of them at larger scales"""
    densify_compensate: bool = True
    """2D gradients are divided by w_s before densification looks at them (ours)"""
    train_reference: Reference = "frustum_max"
    """what distances are divided by in training: the largest in the frustum (the paper), their 0.99 quantile, or the
    scene's own number"""
    view_reference: Reference = "scene"
    """the same for viewing, evaluation and export; scene does not jump when a far Gaussian comes into view (ours)"""
    soft_cut: bool = True
    """viewing fades Gaussians between 1 and 2 times the threshold, so that nothing pops (ours)"""
    train_soft_cut: bool = False
    """the same in training (the paper: no)"""
    dead_decay: Literal["prune", "keep"] = "keep"
    """Gaussians with sigma <= 0, which nothing brings back: removed, or kept from it by a least_decay (ours)"""
    least_decay: float = 0.25
    """sigma is held at or above this where dead_decay is keep (ours)"""
    densify_grad_thresh: float = 0.0009
    """2D gradient, in units of half the image, above which a Gaussian grows (ours; splatfacto: 0.0008)"""
    split_screen_size: float = 0.025
    """radius on the screen, as a share of the longer side, above which a Gaussian is split (ours; splatfacto: 0.05)"""
    least_weight: float = 2.0
    """Gaussians whose weight over all training views is under this many pixels are removed; 0: none (ours)"""
    detail_scales: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
    """scales that are evaluated, and offered as outputs detail_1, detail_1.5 ..."""
    init_from: Path | None = None
    """Gaussians to start from: a 3DGS PLY, or a splatfacto, lapsplat or clodsplat run (its folder or config.yml);
    opacities then decay from the first step on"""
    init_from_frame: Literal["scene", "dataset"] = "scene"
    """frame of a PLY's coordinates: the scene as nerfstudio trains and exports it, or the data set (COLMAP), as INRIA's
    code writes it. Runs say it themselves"""
    init_refine: bool = False
    """densify, prune and reset opacities in a run that starts from Gaussians"""
    export_distance: float = 0.7
    """ns-export writes opacities as seen from this normalised distance: a plain 3DGS scene cannot fade (ours)"""


class ClodSplatModel(FreqSplatModel):
    """Training looks at the scene from virtual distances; each Gaussian learns how soon it may fade."""

    config: ClodSplatModelConfig
    method = "clodsplat"

    def _check_config(self) -> None:
        super()._check_config()
        config = self.config
        if not 1 <= config.largest_scale < float("inf"):
            raise ValueError(f"largest_scale is {config.largest_scale}; it must be a finite number >= 1.")
        for name in ("initial_decay", "least_decay", "reg_temperature"):
            if not 0 < getattr(config, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(config, name)}; it must be a finite number > 0.")
        for name in ("reg_weight", "export_distance"):
            if not 0 <= getattr(config, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(config, name)}; it must be a finite number >= 0.")
        for name in ("decay_start_step", "full_detail_every"):
            if getattr(config, name) < 0:
                raise ValueError(f"{name} is {getattr(config, name)}; it must be a number of steps >= 0.")
        if any(not 0 < scale < float("inf") for scale in config.detail_scales):
            raise ValueError(f"detail_scales are {config.detail_scales}; each must be a finite number > 0.")

    def populate_modules(self) -> None:
        super().populate_modules()
        self._decays = False
        self._started = False
        self._scene_distance = 1.0

    def _initial_parameters(self) -> dict[str, torch.nn.Parameter]:
        parameters = super()._initial_parameters()
        if self.config.use_decay:
            decay = torch.full((len(parameters["means"]), 1), self.config.initial_decay)
            parameters["decay"] = torch.nn.Parameter(decay)
        return parameters

    def _begin_run(self, datamanager: Any) -> None:
        if self.config.init_from is not None:
            start_from(self, self.config.init_from, self.config.init_from_frame, datamanager)

    def take_over(self, raw: RawGaussians) -> None:
        """Make these the Gaussians to train, all of one level; those without a decay get the initial one."""
        raw, config = raw.with_degree(self.config.sh_degree), self.config
        values = {name: getattr(raw, name) for name in (*GROUPS, "decay")}
        if not config.use_decay:
            del values["decay"]
        elif raw.decay is None:
            values["decay"] = torch.full((len(raw), 1), config.initial_decay)
        else:
            values["decay"] = raw.decay[:, None]
        self.gauss_params = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(value.to(self.device)) for name, value in values.items()}
        )
        self.level = torch.ones(len(raw), dtype=torch.int32, device=self.device)
        self._started, self._sh_degree = True, config.sh_degree

    # -- the scene ------------------------------------------------------------------------------------------------

    def gaussians(self) -> Gaussians:
        """The scene; with a decay once that has begun to act."""
        gaussians = super().gaussians()
        return replace(gaussians, decay=self.gauss_params["decay"].squeeze(-1)) if self._decays else gaussians

    @property
    def scene_distance(self) -> float:
        """World units: the median over the training views of the largest distance in the frustum."""
        return self._scene_distance

    def attenuation(self, scale: float | int) -> DistanceDecay | None:
        """How the scene is drawn at `scale`; None where it does not decay (yet)."""
        config = self.config
        if not self._decays:
            return None
        return DistanceDecay(float(scale), config.view_reference, self._scene_distance, config.soft_cut)

    def _attenuation(self) -> DistanceDecay | None:
        return self.attenuation(1.0)

    def _make_controls(self) -> Panel:
        return Panel(detail_slider(2 * max(self.config.largest_scale, 1.5)), ("scale", "all", "budget"), 1)

    def _viewer_scale(self) -> float:
        """The virtual distance scale that the viewer's controls ask for."""
        return 1.0 if self.controls.mode.value == "all" else float(self.controls.slider.value)

    def _viewer_attenuation(self, gaussians: Gaussians, camera: Camera) -> Attenuation | None:
        decay, count = self.attenuation(self._viewer_scale()), self.controls.count()
        if decay is None:
            return super()._viewer_attenuation(gaussians, camera)
        if count is None:
            return decay
        return DecayBudget(
            count,
            decay.reference,
            decay.scene_distance,
            decay.soft,
            least=decay.scale,
            largest=self.config.largest_scale,
        )

    # -- schedule and densification -------------------------------------------------------------------------------

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:  # pyright: ignore
        """As of the base. Decays have as far to go in a short run as in a long one: their rate is raised."""
        callbacks = super().get_training_callbacks(attributes)
        if self.config.use_decay:
            assert attributes.trainer is not None and attributes.optimizers is not None
            rate = attributes.trainer.config.optimizers["decay"]["optimizer"].lr
            set_rate(attributes.optimizers, "decay", rate * min(max(1 / self._scale, 1.0), _LARGEST_SPEEDUP))
        return callbacks

    def _make_schedule(self) -> Schedule:
        schedule = super()._make_schedule()
        # no step is before -1
        return replace(schedule, refine_stop=-1) if self._started and not self.config.init_refine else schedule

    def _begin_step(self, step: int) -> None:
        super()._begin_step(step)
        config = self.config
        if self._started:
            self._sh_degree = config.sh_degree
        self._sampling = DetailSampling(
            start=0 if self._started else scaled(config.decay_start_step, self._scale, least=0),
            largest=config.largest_scale,
            seed=config.seed,
            full_detail_every=config.full_detail_every,
        )
        decays = config.use_decay and self._sampling.active(step)
        begins = decays and not self._decays
        self._decays = decays
        if begins or self.schedule.looks_at_views(step):
            self._measure_scene()
        if begins:
            CONSOLE.log(f"Step {step}: opacities decay with distance from here on.")

    @torch.no_grad()
    def _measure_scene(self) -> None:
        kind = "frustum_quantile" if self.config.train_reference == "frustum_quantile" else "frustum_max"
        gaussians = self.gaussians()
        measured = statistics.median(frustum_distance(gaussians, camera, kind) for camera in self._train_cameras())
        if measured > 0:
            self._scene_distance = measured

    def _gradient_weights(self) -> Float[Tensor, " n"] | None:
        assert self._info is not None
        weight = self._info["loss_weight"]
        if weight == 1 or not self.config.densify_compensate:
            return None
        return torch.full((self.num_points,), weight, device=self.device)

    def _remove_unneeded(self, step: int) -> dict[str, int]:
        removed = super()._remove_unneeded(step)
        if not self._decays or step % self.schedule.refine_every:
            return removed
        if self.config.dead_decay == "prune":
            dead = self._remove_dead(thoroughly=self.schedule.looks_at_views(step))
            if dead:
                removed["removed (dead decay)"] = dead
        elif self.num_dead:
            removed["held (dead decay)"] = self.num_dead
        return removed

    @torch.no_grad()
    def _remove_dead(self, thoroughly: bool) -> int:
        """Remove Gaussians with sigma <= 0 and, `thoroughly`, those that fade under the threshold in every view."""
        gaussians = self.gaussians()
        assert gaussians.decay is not None
        dead = gaussians.decay <= 0
        if thoroughly:
            best, decay = torch.full_like(gaussians.opacities, -torch.inf), self._training_decay(1.0)
            for camera in self._train_cameras():
                best = torch.maximum(best, decay.margin(gaussians, camera))
            dead |= best <= 0
        with self._lent_levels() as state:
            return self.strategy.remove(
                self.gauss_params, self._optimizers.optimizers, state, dead, gaussians.decay.detach()
            )

    @property
    def num_dead(self) -> int:
        """Gaussians whose sigma is at or below 0, or at the bound that keeps them from it."""
        bound = self.config.least_decay if self.config.dead_decay == "keep" else 0.0
        return int((self.gauss_params["decay"] <= bound).sum()) if self._decays else 0

    def _after_step(self, step: int) -> None:
        if self._decays and self.config.dead_decay == "keep":
            with torch.no_grad():
                self.gauss_params["decay"].clamp_(min=self.config.least_decay)
        super()._after_step(step)

    # -- training -------------------------------------------------------------------------------------------------

    def _training_decay(self, scale: float) -> DistanceDecay:
        config = self.config
        return DistanceDecay(scale, config.train_reference, self._scene_distance, config.train_soft_cut)

    def _training_renderings(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> list[Rendering]:
        decay, more = None, {"loss_weight": 1.0}
        if self._decays:
            decay = self._training_decay(self._sampling.scale(self.step, self.schedule.recovers(self.step)))
            unlearned = gaussians
            if not self.config.reg_opacities:
                unlearned = replace(gaussians, opacities=gaussians.opacities.detach())
            margin = decay.margin(unlearned, camera)
            if not bool((margin > 0).any()):
                # an empty picture teaches nothing
                decay = self._training_decay(1.0)
                margin = decay.margin(unlearned, camera)
            weight = self._sampling.loss_weight(decay.scale) if self.config.weigh_scales else 1.0
            more = {"loss_weight": weight, "scale": decay.scale, "margin": margin}
        options = {"rasterizer": self.rasterizer(), "background": background, "antialiased": self.antialiased}
        (rendering,) = render_prefixes(gaussians, camera, 1, decay, **options)
        return [replace(rendering, info={**rendering.info, **more})]

    def _objective(self, outputs: dict[str, Any], target: ViewTarget) -> dict[str, Tensor]:
        config, info = self.config, outputs["info"]
        losses = pyramid_objective(
            outputs["prefixes"],
            target.image,
            ssim_weight=config.ssim_lambda,
            image_weight=info["loss_weight"],
            clamp_mode=config.clamp_in_loss,
            mask=target.mask,
            targets=target.pyramid,
        )
        if self._decays and config.reg_weight != 0:
            excess = count_loss(
                info["margin"], info["scale"], config.largest_scale, config.reg_gradient, config.reg_temperature
            )
            losses["count"] = info["loss_weight"] * config.reg_weight * excess
        return losses

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        metrics = super().get_metrics_dict(outputs, batch)
        if self._decays:
            metrics["decay_mean"] = self.gauss_params["decay"].detach().mean()
            metrics["dead_decay"] = self.num_dead
        if self._decays and self.training:
            info = outputs["info"]
            metrics["scale"] = info["scale"]
            metrics["drawn_share"] = info["drawn"] / max(self.num_points, 1)
        return metrics

    # -- checkpoints ----------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, Any]:
        ours = {"decays": self._decays, "started": self._started, "scene_distance": self._scene_distance}
        return {**super().get_extra_state(), **ours}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        super().set_extra_state(state)
        self._decays = bool(state["decays"])
        self._started = bool(state.get("started", False))
        self._scene_distance = float(state["scene_distance"])

    # -- pictures, evaluation, export -----------------------------------------------------------------------------

    def _more_outputs(
        self, gaussians: Gaussians, camera: Camera, background: Tensor, notes: dict[str, float]
    ) -> dict[str, Any]:
        def detail(scale: float) -> Tensor:
            with Stopwatch(self.device) as watch:
                rendering = self.draw(gaussians, camera, background, self.attenuation(scale))
            notes[f"gaussians_detail_{scale:g}"] = float(rendering.info["drawn"])
            notes[f"milliseconds_detail_{scale:g}"] = watch.milliseconds
            return show(rendering.features)

        def drawn_share() -> Tensor:
            scale = self._viewer_scale() if in_viewer() else self.config.largest_scale
            less = self.attenuation(scale)
            if less is None:
                kept = torch.ones_like(gaussians.opacities)
            else:
                kept = (less(gaussians, camera) > 0).to(gaussians.opacities)
            rendering = self.paint(gaussians, kept[:, None], camera, full())
            return show(rendering.features / rendering.alpha.clamp_min(1e-6))

        def decay() -> Tensor:
            sigma = torch.ones_like(gaussians.opacities) if gaussians.decay is None else gaussians.decay.clamp_min(0.0)
            initial = 1.0 if gaussians.decay is None else self.config.initial_decay
            colours = apply_float_colormap((sigma / (sigma + initial))[:, None], "viridis")
            return show(self.paint(gaussians, colours, camera, full()).features)

        def full() -> Tensor | None:
            attenuation = self._attenuation()
            return None if attenuation is None else attenuation(gaussians, camera)

        outputs: dict[str, Any] = {f"detail_{s:g}": lambda s=s: detail(s) for s in self.config.detail_scales}
        return {**outputs, "drawn_share": drawn_share, "decay": decay}

    def _more_metrics(self, outputs: LazyOutputs, target: Tensor) -> dict[str, float]:
        """PSNR, Gaussians drawn and milliseconds at each of `detail_scales`."""
        names = [f"detail_{scale:g}" for scale in self.config.detail_scales]
        metrics = {f"psnr_{name}": float(psnr(outputs[name], target)) for name in names}
        return {**metrics, **outputs.notes, "dead_decay": float(self.num_dead)}

    @uncached_property
    @torch.no_grad()
    def opacities(self) -> Tensor:
        """What ns-export writes: logits [n, 1] of the opacities seen from `export_distance`."""
        raw = self.gauss_params["opacities"]
        if not self._decays:
            return raw
        faded = faded_logits(raw.squeeze(-1), self.gauss_params["decay"].squeeze(-1), self.config.export_distance)
        return faded[:, None]

    def _before_export(self) -> None:
        if self._decays:
            CONSOLE.log(
                f"Exported opacities are those seen from {self.config.export_distance:g} of the scene's distance "
                f"(`export_distance` in config.yml; {self._scene_distance:.3g} world units are 1): a plain 3DGS scene "
                "cannot fade with distance."
            )
