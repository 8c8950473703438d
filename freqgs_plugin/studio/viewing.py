"""What both methods show: splatfacto with a swappable rasterizer, its pictures, evaluation and export."""

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.lib_bilagrid import BilateralGrid
from nerfstudio.models.splatfacto import SH2RGB, SplatfactoModel, get_color
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, LevelCut, Product
from freqgs_plugin.functional.budget import LevelBudget
from freqgs_plugin.functional.image_loss import ssim
from freqgs_plugin.rendering.base import Rasterizer, get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.config import FreqSplatModelConfig
from freqgs_plugin.studio.controls import Stopwatch, in_viewer, uninterrupted
from freqgs_plugin.studio.datamanager import NAMED_CAMERAS
from freqgs_plugin.studio.filtering import FilterCache
from freqgs_plugin.studio.lpips import lpips_if_available
from freqgs_plugin.studio.masking import Surroundings
from freqgs_plugin.studio.outputs import LazyOutputs
from freqgs_plugin.studio.panel import OFF, Panel
from freqgs_plugin.training.initialise import initial_parameters, random_points
from freqgs_plugin.types import Camera, Gaussians, Rendering, Splats

SMALL = 256
"""px: longer side of the picture in which the most salient place is looked for"""


class uncached_property(cached_property):
    """A property that nerfstudio's viewer does not read while it looks for controls (it skips cached properties)."""

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        return self if instance is None else self.func(instance)


class SplatViews(SplatfactoModel):
    """Splatfacto whose pictures come from `rendering.render`, on any device.

    Subclasses say what is drawn: the attenuation of an ordinary picture, the one that the viewer's controls ask for,
    and further outputs.
    """

    config: FreqSplatModelConfig

    def populate_modules(self) -> None:
        self._check_config()
        parameters = self._initial_parameters()
        self.gauss_params = torch.nn.ParameterDict(parameters)
        self.register_buffer("level", torch.ones(len(parameters["means"]), dtype=torch.int32))
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
        self.controls = self._make_controls()
        self._filtered = FilterCache()
        self._sh_degree = 0
        self._rasterizer: Rasterizer | None = None

    # -- what a method defines ------------------------------------------------------------------------------------

    def _check_config(self) -> None:
        """Raise ValueError where settings contradict each other."""
        if self.config.sh_degree not in range(5):
            raise ValueError(f"sh_degree is {self.config.sh_degree}; it must be in 0..4.")
        if self.config.rasterize_mode not in ("antialiased", "classic"):
            raise ValueError(f"rasterize_mode is '{self.config.rasterize_mode}'; choose antialiased or classic.")
        if self.config.dropout is not None and not 0 <= self.config.dropout < 1:
            raise ValueError(f"dropout is {self.config.dropout}; it is a share of the Gaussians, in [0, 1).")
        for name in ("densify_grad_thresh", "split_screen_size"):
            if not 0 < getattr(self.config, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self.config, name)}; it must be a finite number > 0.")
        for name in ("opacity_penalty", "size_penalty", "least_weight", "max_gaussians", "target_cache_mb", "seed"):
            if not 0 <= getattr(self.config, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self.config, name)}; it must be a finite number >= 0.")
        scale = self.config.steps_scale
        if scale is not None and not 0 < scale < float("inf"):
            raise ValueError(f"steps_scale is {scale}; it must be a finite number > 0, or None: by the run's length.")

    def _initial_parameters(self) -> dict[str, torch.nn.Parameter]:
        """The Gaussians at step 0, by parameter group: from the scene's points, or at random."""
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
        return initial_parameters(points, colours, self.config.sh_degree, generator)

    def _attenuation(self) -> Attenuation | None:
        """How the scene is drawn wherever no control asks for something else; None: as it is."""
        return None

    def _make_controls(self) -> Panel:
        """The viewer's controls."""
        raise NotImplementedError

    def _viewer_attenuation(self, gaussians: Gaussians, camera: Camera) -> Attenuation | None:
        """What mode, slider and budget ask for."""
        count = self.controls.count()
        return self._attenuation() if count is None else LevelBudget(count)

    def _viewer_subtrahend(self) -> Attenuation | None:
        """What mode and slider take away from the picture, which then is shown around mid grey; None: nothing."""
        return None

    def _more_outputs(
        self, gaussians: Gaussians, camera: Camera, background: Tensor, notes: dict[str, float]
    ) -> dict[str, Any]:
        """Further named outputs, as functions; these may leave numbers in `notes`."""
        return {}

    def _more_metrics(self, outputs: LazyOutputs, target: Tensor) -> dict[str, float]:
        """Further numbers of an evaluated view."""
        return {}

    def _before_export(self) -> None:
        """Raise where a 3DGS viewer would not show what we draw; say what is written where it is not plain."""

    def _signed(self) -> bool:
        return False

    def _training_outputs(self, camera: Camera, background: Tensor, cam_idx: int | None) -> dict[str, Any]:
        raise NotImplementedError

    def _halvings(self) -> int:
        """How often training images are halved at this step."""
        return 0

    # -- Gaussians and pictures -----------------------------------------------------------------------------------

    @property
    def num_levels(self) -> int:
        """Levels present now."""
        return 1

    @property
    def antialiased(self) -> bool:
        return self.config.rasterize_mode == "antialiased"

    def gaussians(self) -> Gaussians:
        """The scene with activated parameters: where exp and sigmoid are, and nowhere else."""
        return Gaussians(
            means=self.means,
            quats=self.quats,
            scales=torch.exp(self.scales),
            opacities=torch.sigmoid(self.gauss_params["opacities"]).squeeze(-1),
            features_dc=self.features_dc,
            features_rest=self.features_rest[:, : (self._sh_degree + 1) ** 2 - 1],
            level=self.level,  # pyright: ignore[reportArgumentType]
            signed_residuals=self._signed(),
        )

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

    def paint(
        self, gaussians: Gaussians, features: Float[Tensor, "n d"], camera: Camera, weight: Tensor | None = None
    ) -> Rendering:
        """The Gaussians with `features` in place of their colours, over zeros; opacities times `weight` [n]."""
        opacities = gaussians.opacities if weight is None else gaussians.opacities * weight
        splats = Splats(gaussians.means, gaussians.quats, gaussians.scales, opacities, features)
        return self.rasterizer()(splats, camera, antialiased=self.antialiased, depth=False)

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not isinstance(camera, Cameras):
            raise TypeError(f"a splat model renders nerfstudio Cameras, not {type(camera).__name__}.")
        background = self._get_background_color()
        if self.training:
            pose = self.camera_optimizer.apply_to_camera(camera)
            index = (camera.metadata or {}).get("cam_idx")
            return self._training_outputs(to_camera(camera, pose, halvings=self._halvings()), background, index)
        # abandoned in the middle, numba's loading of a kernel ends the thread that draws
        with uninterrupted():
            return self._view_outputs(to_camera(camera), background)

    @torch.no_grad()
    def _view_outputs(self, camera: Camera, background: Tensor) -> dict[str, Any]:
        viewer = in_viewer()
        gaussians = self._viewer_gaussians() if viewer else self.gaussians()
        if self.crop_box is not None:
            gaussians = gaussians.select(self.crop_box.within(gaussians.means).flatten())
        with Stopwatch(self.device) as watch:
            if viewer:
                rendering = self._viewer_rendering(gaussians, camera, background)
            else:
                rendering = self.draw(gaussians, camera, background, self._attenuation(), depth=True)
        if viewer:
            drawn = f"{rendering.info['drawn']:,} / {self.num_points:,}, {watch.milliseconds:.0f} ms"
            self.controls.drawn.value = drawn
        depth = torch.where(rendering.alpha > 0, rendering.depth, rendering.depth.max())
        ready = {
            "rgb": show(rendering.features),
            "depth": depth,
            "accumulation": rendering.alpha,
            "background": background.expand(camera.height, camera.width, 3),
        }
        notes: dict[str, float] = {}
        return LazyOutputs(ready, self._more_outputs(gaussians, camera, background, notes), notes)

    def _viewer_gaussians(self) -> Gaussians:
        """The scene, with the filter that the viewer's controls ask for."""
        name = self.controls.filter.value
        if name == OFF:
            self._filtered.clear()
            self.controls.say("filter", None)
            return self.gaussians()
        try:
            tensors = [*self.gauss_params.values(), self.level]
            filtered = self._filtered.get(name, self.gaussians, tensors, self._sh_degree)  # pyright: ignore
        except ValueError as error:
            self.controls.say("filter", f"Not filtered: {error}")
            return self.gaussians()
        self.controls.say("filter", None)
        return filtered

    def _viewer_rendering(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> Rendering:
        """The picture that the viewer's controls ask for."""
        around = self.controls.around(gaussians, self._surroundings(gaussians, camera, background))

        def draw(attenuation: Attenuation | None) -> Rendering:
            parts = around if attenuation is None else [attenuation, *around]
            product = parts[0] if len(parts) == 1 else Product(tuple(parts)) if parts else None
            return self.draw(gaussians, camera, background, product, depth=True)

        rendering, less = draw(self._viewer_attenuation(gaussians, camera)), self._viewer_subtrahend()
        if less is None:
            return rendering
        return replace(rendering, features=0.5 + rendering.features - draw(less).features)

    def _surroundings(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> Surroundings:
        def base() -> np.ndarray:
            factor = max(camera.width, camera.height) / SMALL
            K = camera.K.clone()
            K[:2] /= factor
            sides = max(round(camera.width / factor), 1), max(round(camera.height / factor), 1)
            small = Camera(camera.viewmat, K, *sides)
            return show(self.draw(gaussians, small, background, LevelCut(1)).features).cpu().numpy()

        def views() -> tuple[list[str], list[Camera]]:
            named = (self.kwargs.get("metadata") or {}).get(NAMED_CAMERAS)
            if named is None:
                raise ValueError("the run's datamanager names no views, so masks cannot be matched to any.")
            return named()

        return Surroundings(base, views, {"rasterizer": self.rasterizer(), "antialiased": self.antialiased})

    # -- evaluation and export ------------------------------------------------------------------------------------

    def get_image_metrics_and_images(
        self, outputs: LazyOutputs, batch: dict[str, Any]
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

    @uncached_property
    def shs_0(self) -> Tensor:
        self._before_export()
        return self.features_dc

    @uncached_property
    def colors(self) -> Tensor:
        self._before_export()
        return SH2RGB(self.features_dc)


def show(image: Tensor) -> Tensor:
    """Clamp to [0, 1]: what is shown or stored."""
    return image.clamp(0.0, 1.0)


def psnr(a: Float[Tensor, "*image"], b: Float[Tensor, "*image"]) -> Float[Tensor, ""]:
    """Peak signal to noise ratio of images in [0, 1], dB; at most 120."""
    return to_psnr(torch.nn.functional.mse_loss(a, b))


def to_psnr(mean_square: Float[Tensor, ""]) -> Float[Tensor, ""]:
    """Peak signal to noise ratio of a mean squared error, dB; at most 120."""
    return -10 * torch.log10(mean_square.clamp_min(1e-12))
