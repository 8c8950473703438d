"""From a run's Gaussians to plain ones: colours of at least 0, and opacities that do not fade."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from freqgs_plugin.commands.export_options import ExportOptions
from freqgs_plugin.commands.export_source import Source, select
from freqgs_plugin.functional.fading import faded_logits
from freqgs_plugin.io.parameters import RawGaussians
from freqgs_plugin.training.baking import Baked, BakeOptions, bake, signed_refusal, unsigned
from freqgs_plugin.types import Gaussians

if TYPE_CHECKING:
    from rich.console import Console

FAINTEST_LOGIT = -5.5373
"""logit of 1/255, as nerfstudio rounds it: fainter Gaussians are drawn nowhere, and not exported"""


@dataclass(frozen=True)
class Plain:
    """Plain Gaussians in the scene's frame."""

    raw: RawGaussians
    mip: bool
    """for viewers that compensate opacities (`SplatRenderMode: mip`)"""
    note: str
    """what was done to them"""
    baked: Baked | None = None


def viewer_of(source: Source, options: ExportOptions) -> str:
    """mip or classic."""
    trained = "mip" if source.scene.antialiased else "classic"
    return options.viewer or trained


def check_plain(source: Source, options: ExportOptions) -> None:
    """Refuse what needs baking, before anything is done.

    Raises:
        ValueError: with the remedy.
    """
    if source.signed and not options.bake:
        raise ValueError(signed_refusal(source.levels, options.format))
    trained = "mip" if source.scene.antialiased else "classic"
    if viewer_of(source, options) != trained and not options.bake:
        raise ValueError(f"--viewer {options.viewer}: the run was trained for {trained} viewers; add --bake.")


def plain(source: Source, options: ExportOptions, console: "Console", what: str = "") -> Plain:
    """What an ordinary viewer is given of `source`. An interrupt during baking keeps the best so far.

    Raises:
        ValueError: as `check_plain`.
    """
    check_plain(source, options)
    mip = viewer_of(source, options) == "mip"
    raw, note = replace(source.raw, level=None, decay=None), "as it is"
    if source.raw.decay is not None:
        raw, note = _unfading(source, options)
    baked = None
    if options.bake and (source.signed or source.raw.decay is not None or mip != source.scene.antialiased):
        baked = _bake(_activated(raw, source.gaussians), source, options, console, what)
        raw, note = _raw(baked.gaussians), _told(baked, mip)
    extras = {name: getattr(source.raw, name) for name in options.extra}
    raw = replace(raw, **extras)
    seen = raw.opacities[:, 0] >= FAINTEST_LOGIT
    if not bool(seen.any()):
        faded = source.raw.decay is not None and "decay" not in options.extra
        remedy = f"Choose a smaller {_seen_from(source, options)[1]}" if faded else "Export another run"
        raise ValueError(f"nothing is left to export: every Gaussian is fainter than 1/255. {remedy}.")
    return Plain(raw if bool(seen.all()) else select(raw, seen), mip, note, baked)


def _unfading(source: Source, options: ExportOptions) -> tuple[RawGaussians, str]:
    raw = replace(source.raw, level=None, decay=None)
    assert source.raw.decay is not None
    if "decay" in options.extra:
        return raw, "opacities as trained, decay beside them"
    distance, said = _seen_from(source, options)
    if not distance * options.detail < float("inf"):
        raise ValueError(f"{said}: so far away is nothing; choose smaller ones.")
    logits = faded_logits(raw.opacities[:, 0], source.raw.decay, distance * options.detail)
    far = f"opacities as seen from {distance:g} of the scene's distance"
    return replace(raw, opacities=logits[:, None]), far + (f", at detail {options.detail:g}" * (options.detail != 1))


def _seen_from(source: Source, options: ExportOptions) -> tuple[float, str]:
    """The normalised distance, and how the options that matter were given."""
    distance = source.scene.run.model.config.export_distance if options.distance is None else options.distance
    given = [f"--distance {distance:g}"] * (options.distance is not None)
    given += [f"--detail {options.detail:g}"] * (options.detail != ExportOptions.detail)
    return distance, " or ".join(given) or f"--distance (the run's is {distance:g})"


def _activated(raw: RawGaussians, like: Gaussians) -> Gaussians:
    """`raw` with exponentials taken; levels and the sign of colours are those of `like`."""
    return replace(
        like,
        features_dc=raw.features_dc,
        features_rest=raw.features_rest,
        opacities=raw.opacities[:, 0].sigmoid(),
        decay=None,
    )


def _bake(start: Gaussians, source: Source, options: ExportOptions, console: "Console", what: str) -> Baked:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    # how much a classic viewer thickens small Gaussians depends on the size of the picture
    mip = viewer_of(source, options) == "mip"
    small = 0.5 if mip == source.scene.antialiased else 0.0
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(f"Baking {what}".strip(), total=options.bake_steps)
        return bake(
            unsigned(start),
            source.picture,
            source.cameras,
            source.scene.rasterizer,
            source.scene.background,
            antialiased=mip,
            options=BakeOptions(options.bake_steps, options.seed, small=small),
            on_step=lambda done, best: bar.update(task, completed=done, description=f"Baking {what}: {best:.1f} dB"),
        )


def _raw(gaussians: Gaussians) -> RawGaussians:
    """Logarithms and logits again."""
    with torch.no_grad():
        return RawGaussians(
            means=gaussians.means,
            scales=gaussians.scales.log(),
            quats=gaussians.quats,
            features_dc=gaussians.features_dc,
            features_rest=gaussians.features_rest,
            opacities=gaussians.opacities.clamp(1e-4, 1 - 1e-6).logit()[:, None],
        )


def _told(baked: Baked, mip: bool) -> str:
    stopped = f", stopped by the user after {baked.steps} steps" if baked.interrupted else f", {baked.steps} steps"
    return f"baked for {'mip' if mip else 'classic'} viewers{stopped}, {baked.seconds:.0f} s"
