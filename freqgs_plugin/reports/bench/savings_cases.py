"""What is not needed, and the two ways to compute the same result: with it and without it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from freqgs_plugin.functional.attenuation import Attenuation, DistanceDecay, LevelCut
from freqgs_plugin.functional.harmonics import level_colours
from freqgs_plugin.functional.spectrum import magnitude, magnitude_distance_to
from freqgs_plugin.rendering.base import PrefixRasterizer, get_rasterizer
from freqgs_plugin.rendering.render import render, render_prefixes, rendered_weight, shade
from freqgs_plugin.reports.bench.options import BenchError
from freqgs_plugin.reports.bench.workloads import IMAGE_SEED, image_gradient
from freqgs_plugin.training.objective import PyramidTargets
from freqgs_plugin.types import Camera, Gaussians, Splats

DECAY_SCALE = 5.0
LEAVES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")


@dataclass(frozen=True)
class Saving:
    """The same result in two ways."""

    what: str
    """is left out"""
    how: str
    """what is compared: the way with it, against the way without it"""
    everything: Callable[[], Tensor]
    left_out: Callable[[], Tensor]
    used: bool = True
    """whether the package leaves it out"""


@dataclass(frozen=True)
class Subject:
    """A trained scene in one view, on the CPU, drawn by numba."""

    gaussians: Gaussians
    camera: Camera
    image: Tensor
    """the photograph, [h, w, 3]"""
    background: Tensor
    num_levels: int
    antialiased: bool
    scene_distance: float | None = None

    @property
    def size(self) -> str:
        levels = f"{self.num_levels} level{'s' if self.num_levels > 1 else ''}"
        return f"{len(self.gaussians):,} Gaussians, {levels}, {self.camera.width}x{self.camera.height} px"


@torch.no_grad()
def subject_of(run: Any, view: Any) -> Subject:
    """What a run and one of its views make.

    Raises:
        BenchError: a single level without decay has no level of detail to leave anything out of.
    """
    gaussians, decay = run.gaussians, run.gaussians.decay
    if run.num_levels == 1 and decay is None:
        raise BenchError("the run has one level and no decay: nothing could be left out. Name a run with more levels.")
    tensors = {name: getattr(gaussians, name).detach().cpu() for name in (*LEAVES, "level")}
    camera = replace(view.camera, viewmat=view.camera.viewmat.detach().cpu(), K=view.camera.K.cpu())
    return Subject(
        replace(gaussians, **tensors, decay=None if decay is None else decay.detach().cpu()),
        camera,
        view.image.cpu(),
        run.background.cpu(),
        run.num_levels,
        run.antialiased,
        getattr(run, "scene_distance", None),
    )


def savings_of(s: Subject) -> list[Saving]:
    """All savings that the scene has a use for."""
    found = [*_viewing(s), *_harmonics(s)]
    if s.num_levels > 1:
        found += [*_levels(s)]
    return [*found, *_gradients(s)]


# -- viewing ----------------------------------------------------------------------------------------------------------


def _viewing(s: Subject) -> list[Saving]:
    rasterizer = get_rasterizer("numba", "cpu", absgrad=False)
    options = {"rasterizer": rasterizer, "background": s.background, "antialiased": s.antialiased, "depth": False}

    def keeping(attenuation: Attenuation) -> Tensor:
        with torch.no_grad():
            splats = shade(s.gaussians, s.camera, attenuation(s.gaussians, s.camera))
            kept = {k: v for k, v in options.items() if k != "rasterizer"}
            return rasterizer(splats, s.camera, **kept).features

    def dropping(attenuation: Attenuation | None, depth: bool = False) -> Tensor:
        with torch.no_grad():
            return render(s.gaussians, s.camera, attenuation, **{**options, "depth": depth}).features

    cuts: dict[str, Attenuation] = {"level 1": LevelCut(1)} if s.num_levels > 1 else {}
    if s.gaussians.decay is not None:
        distance = s.scene_distance
        reference = "frustum_max" if distance is None else "scene"
        cuts[f"distance scale {DECAY_SCALE:g}"] = DistanceDecay(DECAY_SCALE, reference, distance)
    found = [
        Saving(
            f"rows of weight 0, viewing {name}",
            "opacities times 0 against dropped rows",
            lambda cut=cut: keeping(cut),
            lambda cut=cut: dropping(cut),
        )
        for name, cut in cuts.items()
    ]
    with torch.no_grad():
        info = rasterizer(shade(s.gaussians, s.camera), s.camera).info
    inside = info["radii"][0] > 0
    share = 100 * (1 - float(inside.float().mean()))
    found += [
        Saving(
            f"Gaussians outside of the view ({share:.0f} %), before the rasterizer",
            "harmonics and projection of all against of those that are seen, known beforehand",
            lambda: dropping(None),
            lambda: _picture_of(s.gaussians.select(inside), s, options),
            used=False,
        ),
        Saving(
            "expected depth",
            "a picture with depth against one without",
            lambda: dropping(None, depth=True),
            lambda: dropping(None),
        ),
    ]
    return found


def _picture_of(gaussians: Gaussians, s: Subject, options: dict[str, Any]) -> Tensor:
    with torch.no_grad():
        return render(gaussians, s.camera, **options).features


# -- harmonics --------------------------------------------------------------------------------------------------------


def _harmonics(s: Subject) -> list[Saving]:
    g = s.gaussians
    offsets = g.means - s.camera.centre
    zeros = torch.zeros_like(g.features_rest)
    upstream = torch.randn(len(g), 3, generator=torch.Generator().manual_seed(IMAGE_SEED))
    with torch.no_grad():
        seen = get_rasterizer("numba", "cpu", absgrad=False)(shade(g, s.camera), s.camera).info["radii"][0] > 0

    def colours(rest: Tensor) -> Tensor:
        dc, rest, means = (t.clone().requires_grad_() for t in (g.features_dc, rest, g.means))
        colour = level_colours(dc, rest, means - s.camera.centre, g.level, g.signed_residuals)
        colour.backward(upstream)
        return colour.detach()

    def backward(gradient: Tensor) -> Tensor:
        dc, rest = g.features_dc.clone().requires_grad_(), g.features_rest.clone().requires_grad_()
        level_colours(dc, rest, offsets.clone().requires_grad_(), g.level, g.signed_residuals).backward(gradient)
        assert rest.grad is not None
        return rest.grad[seen]

    degree = round((g.features_rest.shape[1] + 1) ** 0.5) - 1
    if degree == 0:
        return []
    return [
        Saving(
            "harmonics above the degree in use",
            f"zeros up to degree {degree} against degree 0 alone, as at the beginning of training; both directions",
            lambda: colours(zeros),
            lambda: colours(zeros[:, :0]),
        ),
        Saving(
            "harmonics' gradients of Gaussians that the view does not show",
            "gradients for all rows against zeros for those that are not seen; both directions",
            lambda: backward(upstream),
            lambda: backward(upstream * seen[:, None]),
        ),
    ]


# -- levels and losses ------------------------------------------------------------------------------------------------


def _levels(s: Subject) -> list[Saving]:
    rasterizer = get_rasterizer("numba", "cpu", absgrad=False)
    assert isinstance(rasterizer, PrefixRasterizer)
    gradient, levels = image_gradient(s.camera), s.num_levels
    # level 2 becomes 3, and so on: level 2 is empty then
    gap = replace(s.gaussians, level=torch.where(s.gaussians.level > 1, s.gaussians.level + 1, s.gaussians.level))

    def prefixes(through_render: bool) -> Tensor:
        g = _with_leaves(gap)
        options = {"background": s.background, "antialiased": s.antialiased}
        if through_render:
            pictures = render_prefixes(g, s.camera, levels + 1, rasterizer=rasterizer, **options)
        else:
            pictures = rasterizer.prefixes(shade(g, s.camera), g.level, levels + 1, s.camera, **options)
        torch.stack([(p.features * gradient).sum() for p in pictures]).sum().backward()
        assert g.means.grad is not None
        return g.means.grad

    with torch.no_grad():
        pictures = [
            r.features.permute(2, 0, 1)[None]
            for r in render_prefixes(s.gaussians, s.camera, levels, rasterizer=rasterizer, background=s.background)
        ]
    targets = PyramidTargets.from_image(s.image, levels)
    photograph = s.image.permute(2, 0, 1)[None].contiguous()
    all_magnitudes = torch.cat([targets.magnitudes, magnitude(photograph)])  # pyright: ignore

    def frequency(count: int) -> Tensor:
        pred = torch.cat(pictures[:count]).clone().requires_grad_()
        magnitude_distance_to(pred, all_magnitudes[:count]).backward()
        assert pred.grad is not None
        return pred.grad[: levels - 1] * count

    return [
        Saving(
            "prefix of an empty level",
            f"{levels + 1} prefixes of which one adds nothing, each composited, against {levels}; both directions",
            lambda: prefixes(False),
            lambda: prefixes(True),
        ),
        Saving(
            "frequency term of the finest level",
            f"DFT distances of {levels} prefixes against the {levels - 1} that Eq. 8 asks for; both directions",
            lambda: frequency(levels),
            lambda: frequency(levels - 1),
        ),
        Saving(
            "targets of a view that was seen before",
            "pyramid and DFT magnitudes of the photograph made anew against kept",
            lambda: _flat(PyramidTargets.from_image(s.image, levels)),
            lambda: _flat(targets),
        ),
    ]


def _flat(targets: PyramidTargets) -> Tensor:
    """One number that depends on the targets: comparing them all would take as long as making them."""
    return targets.reduced[0][0, 0, 0, :1]


# -- gradients --------------------------------------------------------------------------------------------------------


def _gradients(s: Subject) -> list[Saving]:
    rasterizer = get_rasterizer("numba", "cpu", absgrad=False)
    gradient = image_gradient(s.camera)
    options: dict[str, Any] = {"rasterizer": rasterizer, "antialiased": s.antialiased}

    def weights(everything: bool) -> Tensor:
        if not everything:
            return rendered_weight(s.gaussians, s.camera, s.num_levels, **options)
        g = _with_leaves(s.gaussians)
        probe = torch.zeros(len(g), 1, requires_grad=True)
        splats = Splats(g.means, g.quats, g.scales, g.opacities, probe)
        if s.num_levels > 1:
            assert isinstance(rasterizer, PrefixRasterizer)
            pictures = rasterizer.prefixes(splats, g.level, s.num_levels, s.camera, antialiased=s.antialiased)
        else:
            pictures = [rasterizer(splats, s.camera, antialiased=s.antialiased, depth=False)]
        torch.stack([p.features.sum() for p in pictures]).sum().backward()
        assert probe.grad is not None
        return probe.grad[:, 0]

    def means_gradient(pose: bool) -> Tensor:
        g = _with_leaves(s.gaussians)
        camera = replace(s.camera, viewmat=s.camera.viewmat.clone().requires_grad_(pose))
        splats = shade(g, replace(camera, viewmat=s.camera.viewmat))
        picture = rasterizer(splats, camera, background=s.background, antialiased=s.antialiased, depth=False)
        (picture.features * gradient).sum().backward()
        assert g.means.grad is not None
        return g.means.grad

    return [
        Saving(
            "gradients of geometry while weights are measured",
            "gradients of all of a splat's tensors against of one feature alone",
            lambda: weights(True),
            lambda: weights(False),
        ),
        Saving(
            "gradient of the view matrix where poses are not optimised",
            "with it against without it; both directions",
            lambda: means_gradient(True),
            lambda: means_gradient(False),
        ),
    ]


def _with_leaves(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians with tensors that collect gradients."""
    return replace(gaussians, **{name: getattr(gaussians, name).clone().requires_grad_() for name in LEAVES})
