"""Training that starts from Gaussians which are there already: an exported scene, or another run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from freqgs_plugin.io.init_source import InitSource, frame_of, read_init_source
from freqgs_plugin.io.ply import SplatFileError
from freqgs_plugin.studio.viewing import psnr, show

_VIEWS = 3
_DOUBTFUL = 12.0
"""dB: about what any two pictures of one place have in common"""
_BETTER = 3.0
"""dB by which the other frame must be better to be recommended"""


@dataclass(frozen=True)
class RunFacts:
    """What a run's config.yml says about its colours and opacities; None: nothing."""

    signed_residuals: bool | None = None
    antialiased: bool | None = None


def run_facts(path: Path) -> RunFacts:
    """Read the config.yml of the run at `path` (its folder, that file, or a checkpoint) without building its objects.

    nerfstudio's own loader makes Python objects of whatever the file names.

    Raises:
        SplatFileError: the config.yml is damaged.
    """
    folders = [path, path.parent, path.parent.parent]
    config = next((folder / "config.yml" for folder in folders if (folder / "config.yml").is_file()), None)
    if config is None:
        return RunFacts()
    try:
        node = yaml.compose(config.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        reason = " ".join(str(error).split())
        raise SplatFileError(f"{config} is damaged ({reason}); copy it again, or move it away.") from error
    signed = _scalar(node, "pipeline", "model", "signed_residuals")
    mode = _scalar(node, "pipeline", "model", "rasterize_mode")
    return RunFacts(
        signed_residuals=None if signed is None else signed == "true",
        antialiased=None if mode is None else mode == "antialiased",
    )


def _scalar(node: Any, *keys: str) -> str | None:
    """The text at a path of keys; None where there is none."""
    for key in keys:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        node = next((value for name, value in pairs if name.value == key), None)
    return node.value if isinstance(node, yaml.ScalarNode) else None


def read_start(path: Path) -> InitSource:
    """The Gaussians of a PLY or run; see `read_init_source` for what is refused."""
    facts = run_facts(Path(path))
    return read_init_source(path, signed_residuals=facts.signed_residuals, antialiased=facts.antialiased)


def start_from(model: Any, path: Path, declared_frame: str, datamanager: Any) -> None:
    """Give `model` the Gaussians at `path`, in the frame of the scene that `datamanager` holds, and log what they show.

    The model has a method `take_over(RawGaussians)`. Of a source that does not say what frame it is in, both frames are
    tried, and the log tells where the other one is better than the one declared.
    """
    source = read_start(path)
    outputs = datamanager.train_dataparser_outputs
    scene = frame_of(outputs.dataparser_transform, outputs.dataparser_scale)
    CONSOLE.log(escape(f"Starting from {source.summary}"))
    for doubt in _doubts(source, model.config):
        CONSOLE.log(f"[yellow]{escape(doubt)}")
    model.take_over(source.in_frame(scene, declared_frame))
    shown = _shown(model, datamanager)
    CONSOLE.log(f"The start shows training views at {shown:.1f} dB.")
    other = {"scene": "dataset", "dataset": "scene"}[declared_frame]
    if source.frame is None and not scene.is_identity():
        model.take_over(source.in_frame(scene, other))
        better = _shown(model, datamanager)
        model.take_over(source.in_frame(scene, declared_frame))
        if better > shown + _BETTER:
            CONSOLE.log(
                f"[bold yellow]Taken to be in the frame '{other}' instead of '{declared_frame}', it would show them at "
                f"{better:.1f} dB: stop, and start again with `--pipeline.model.init-from-frame {other}`."
            )
            return
    if shown < _DOUBTFUL:
        CONSOLE.log(
            "[bold yellow]That is hardly the same scene. Gaussians of another reconstruction are in another place, "
            "even if the photographs are the same."
        )


def _doubts(source: InitSource, config: Any) -> list[str]:
    """How the scene will look different from how its source was trained."""
    doubts, raw = [], source.gaussians
    if source.antialiased is not None and source.antialiased != (config.rasterize_mode == "antialiased"):
        mode = "antialiased" if source.antialiased else "classic"
        doubts.append(
            f"It was trained with rasterize-mode {mode}; here it is {config.rasterize_mode}. "
            f"To keep its opacities, use `--pipeline.model.rasterize-mode {mode}`."
        )
    if raw.sh_degree > config.sh_degree:
        doubts.append(f"Its harmonics of degree {raw.sh_degree} are cut off at sh-degree {config.sh_degree}.")
    if raw.decay is not None and not config.use_decay:
        doubts.append("Its decays are left out, because use-decay is off: everything is as opaque as near the camera.")
    if raw.decay is not None and config.use_decay and (dead := int((raw.decay <= 0).sum())):
        then = f"they begin at {config.least_decay:g}" if config.dead_decay == "keep" else "they are pruned"
        doubts.append(f"{dead:,} of its {len(raw):,} decays are dead (0 or less), and would never be drawn: {then}.")
    return doubts


@torch.no_grad()
def _shown(model: Any, datamanager: Any) -> float:
    """Mean PSNR of a few training views, spread over all of them, dB."""
    cameras, cached = datamanager.train_dataset.cameras, datamanager.cached_train
    was_training = model.training
    model.eval()
    values = []
    for index in torch.linspace(0, len(cached) - 1, min(_VIEWS, len(cached))).round().int().tolist():
        outputs = model.get_outputs_for_camera(cameras[index : index + 1].to(model.device))
        target = model.composite_with_background(model.get_gt_img(cached[index]["image"]), outputs["background"])
        values.append(float(psnr(show(outputs["rgb"]), target)))
    model.train(was_training)
    return sum(values) / len(values)
