"""How well a scene shows photographs, by how much of it is drawn: what trimming may cost is measured here."""

import statistics
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.rendering.render import render, render_prefixes, rendered_weight
from freqgs_plugin.reports.tables import reduced_psnr
from freqgs_plugin.types import Camera, Gaussians

Quality = dict[str, float]
"""what is drawn -> mean PSNR over views, dB"""


class Judge:
    """Draws a run's views as the run does: every prefix of levels, or every distance scale in `scales_of`.

    The last entry of a `Quality` is the whole scene.
    """

    def __init__(self, run: Any, on_view: Callable[[], object] = lambda: None):
        self._run, self._on_view = run, on_view
        self.scales = scales_of(run)

    def views(self, split: Literal["train", "test"], most: int | None = None) -> list[int]:
        """Numbers of a split's views; of more than `most`, so many spread over all of them."""
        count = self._run.num_views(split)
        if most is None or count <= most:
            return list(range(count))
        return [round(i * (count - 1) / (most - 1)) for i in range(most)]

    @torch.no_grad()
    def quality(self, gaussians: Gaussians, split: Literal["train", "test"], views: Sequence[int]) -> Quality:
        """Mean PSNR of each prefix (both reduced to its own size) or scale; pictures are clamped as they are shown."""
        found: dict[str, list[float]] = {}
        for number in views:
            view = self._run.view(split, number)
            for name, picture, halvings in self._pictures(gaussians, view.camera):
                value = reduced_psnr(picture.clamp(0, 1), view.image.to(picture), halvings)
                found.setdefault(name, []).append(min(value, 100.0))
            self._on_view()
        return {name: statistics.fmean(values) for name, values in found.items()}

    def _pictures(self, gaussians: Gaussians, camera: Camera) -> list[tuple[str, Float[Tensor, "h w 3"], int]]:
        """Name, picture and halvings."""
        run = self._run
        options = {"rasterizer": run.rasterizer, "background": run.background, "antialiased": run.antialiased}
        if self.scales:
            pictures = []
            for scale in reversed(self.scales):
                attenuation = attenuation_at(run, gaussians, scale)
                picture = render(gaussians, camera, attenuation, depth=False, **options).features
                pictures.append((f"s_v = {scale:g}", picture, 0))
            return pictures
        levels = run.num_levels
        prefixes = render_prefixes(gaussians, camera, levels, **options)
        names = ["all levels" if k == levels else f"levels 1-{k}" if k > 1 else "level 1" for k in range(1, levels + 1)]
        return [(names[k - 1], prefixes[k - 1].features, levels - k) for k in range(1, levels + 1)]

    @torch.no_grad()
    def picture(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """The whole scene, as it is shown."""
        run = self._run
        options = {"rasterizer": run.rasterizer, "background": run.background, "antialiased": run.antialiased}
        return render(gaussians, camera, attenuation_at(run, gaussians, 1.0), depth=False, **options).features

    def weights(self, gaussians: Gaussians) -> list[Tensor]:
        """For each training view how much of its pictures each Gaussian makes up, pixels; kept at half precision."""
        run, found = self._run, []
        for number in self.views("train"):
            camera = run.view("train", number).camera
            total = torch.zeros(len(gaussians), device=gaussians.means.device)
            for scale in self.scales or [1.0]:
                total += rendered_weight(
                    gaussians,
                    camera,
                    run.num_levels,
                    attenuation_at(run, gaussians, scale),
                    rasterizer=run.rasterizer,
                    antialiased=run.antialiased,
                ).to(total)
            # its range is float32's
            found.append(total.bfloat16())
            self._on_view()
        return found


def scales_of(run: Any) -> list[float]:
    """The distance scales that a run is evaluated at and the largest in training, rising from 1; none without decay."""
    if run.gaussians.decay is None:
        return []
    config = run.model.config
    return sorted({1.0, float(config.largest_scale), *(float(scale) for scale in config.detail_scales if scale >= 1)})


def attenuation_at(run: Any, gaussians: Gaussians, scale: float) -> Attenuation | None:
    """How the run draws at a distance scale; None where the Gaussians do not decay."""
    return None if gaussians.decay is None else run.model.attenuation(scale)


def loss(before: Quality, after: Quality) -> tuple[float, str]:
    """The largest loss of PSNR, dB (negative: a gain), and where."""
    where = max(before, key=lambda name: before[name] - after[name])
    return before[where] - after[where], where
