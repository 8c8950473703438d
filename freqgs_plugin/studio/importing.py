"""Gaussians of a file as a trained run: config.yml, the frame and a checkpoint."""

import copy
import statistics
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfstudio.configs.dataparser_configs import dataparsers
from nerfstudio.configs.method_configs import all_methods

from freqgs_plugin.functional.attenuation import frustum_distance
from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.check_images import SceneError
from freqgs_plugin.io.exported import Exported
from freqgs_plugin.io.init_source import TRANSFORMS, frame_of
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.run_files import in_one_piece, save_checkpoint


@dataclass(frozen=True)
class RunSettings:
    """Where the run goes, and what it draws."""

    data: Path
    output_dir: Path
    experiment: str
    method: str
    """lapsplat or clodsplat"""
    frame: str
    """scene or dataset: of the file's coordinates"""
    dataparser: str | None = None


def write_run(exported: Exported, settings: RunSettings) -> Path:
    """Write the run in one piece, and return its config.yml.

    Raises:
        ValueError: Gaussians and method do not fit.
        SceneError: the photographs cannot be read.
        OSError: the run cannot be written.
    """
    if Path(settings.experiment).name != settings.experiment or settings.experiment == "..":
        raise ValueError(f"--experiment-name {settings.experiment}: give the name of a folder, without a path.")
    config = _config(exported, settings)
    pipeline = _pipeline(config, settings.data)
    outputs = pipeline.datamanager.train_dataparser_outputs
    here = frame_of(outputs.dataparser_transform, outputs.dataparser_scale)
    raw = _in_scene(exported, settings.frame, here)
    state = _state(pipeline, raw, exported, settings.method)
    pipeline.load_pipeline(state, 0)
    base = config.get_base_dir()
    with in_one_piece(base) as folder:
        (folder / config.relative_model_dir).mkdir(parents=True)
        (folder / "config.yml").write_text(yaml.dump(config), encoding="utf-8")
        outputs.save_dataparser_transform(folder / TRANSFORMS)
        checkpoint = {"step": 0, "pipeline": state, "optimizers": {}, "schedulers": {}, "scalers": {}}
        save_checkpoint(checkpoint, folder / config.relative_model_dir / "step-000000000.ckpt", base)
    return base / "config.yml"


def _config(exported: Exported, settings: RunSettings) -> Any:
    """nerfstudio's configuration of the method, with what is known of the run that was exported."""
    raw, origin = exported.gaussians, exported.origin
    config = copy.deepcopy(all_methods[settings.method])
    manager, model = config.pipeline.datamanager, config.pipeline.model
    manager.dataparser = _parser(settings, origin)
    config.data = manager.data = settings.data.resolve()
    config.output_dir, config.experiment_name = settings.output_dir.resolve(), settings.experiment
    config.timestamp = datetime.now().strftime("import-%Y-%m-%d_%H%M%S")
    if origin.get("method") == settings.method:
        _set(model, origin.get("model_settings"))
    model.sh_degree = raw.sh_degree
    model.rasterize_mode = "antialiased" if exported.antialiased else "classic"
    levels = 1 if raw.level is None else int(raw.level.max())
    if settings.method == "lapsplat":
        if raw.decay is not None:
            raise ValueError("these Gaussians have a decay, which lapsplat cannot hold: import them as clodsplat.")
        model.num_levels, model.signed_residuals = levels, exported.signed_residuals
    else:
        if exported.signed_residuals:
            raise ValueError("these Gaussians have signed residuals, which clodsplat cannot hold: import as lapsplat.")
        model.use_decay = raw.decay is not None
    if origin.get("method") != settings.method:
        background = (origin.get("model_settings") or {}).get("background_color")
        _set(model, {} if background is None else {"background_color": background})
    return config


def _parser(settings: RunSettings, origin: dict[str, Any]) -> Any:
    known = origin.get("dataparser")
    name = settings.dataparser or known
    if name is None:
        name = "nerfstudio-data" if (settings.data / "transforms.json").is_file() else "colmap"
    if name not in dataparsers:
        raise ValueError(f"dataparser '{name}' is unknown; choose one of: {', '.join(dataparsers)}.")
    ours = all_methods[settings.method].pipeline.datamanager.dataparser
    parser = copy.deepcopy(ours if type(ours) is type(dataparsers[name]) else dataparsers[name])
    if name == known:
        _set(parser, origin.get("dataparser_settings"))
    parser.data = settings.data.resolve()
    return parser


def _set(config: Any, values: Any) -> None:
    """Plain values of a manifest into the fields that `config` has, as the types that they have there."""
    for field in fields(config):
        if not isinstance(values, dict) or field.name not in values or field.name.startswith("_"):
            continue
        value, now = values[field.name], getattr(config, field.name)
        if isinstance(now, Path) and isinstance(value, str):
            value = Path(value)
        elif isinstance(now, tuple) and isinstance(value, list):
            value = tuple(value)
        if now is None or value is None or isinstance(value, type(now)) or isinstance(now, int | float):
            setattr(config, field.name, value)


def _pipeline(config: Any, data: Path) -> Any:
    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        pipeline = config.pipeline.setup(device=device, test_mode="test", world_size=1, local_rank=0)
    except (AssertionError, FileNotFoundError, KeyError, RuntimeError, SystemExit) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{data} cannot be read as a scene ({reason}); name what ns-train takes.") from error
    pipeline.eval()
    return pipeline


def _in_scene(exported: Exported, declared: str, here: Similarity) -> RawGaussians:
    """In the frame of the scene as it is read here."""
    if declared == "dataset":
        return exported.gaussians.moved(here)
    there = exported.scene
    return exported.gaussians if there is None else exported.gaussians.moved(here.after(there.inverse()))


def _state(pipeline: Any, raw: RawGaussians, exported: Exported, method: str) -> dict[str, Any]:
    """The pipeline's state with these Gaussians in place of its own."""
    state = dict(pipeline.state_dict())
    for name in list(state):
        if name.startswith("_model.gauss_params."):
            del state[name]
    groups = {name: getattr(raw, name) for name in GROUPS}
    if raw.decay is not None:
        groups["decay"] = raw.decay[:, None]
    state.update({f"_model.gauss_params.{name}": value for name, value in groups.items()})
    level = raw.level if raw.level is not None and method == "lapsplat" else torch.ones(len(raw), dtype=torch.int32)
    state["_model.level"] = level
    extra = {**state["_model._extra_state"], "step": 0, "sh_degree": raw.sh_degree, "strategy": {}, "imported": True}
    if method == "lapsplat":
        extra.update(stage=int(level.max()), num_levels=int(level.max()))
    else:
        extra.update(decays=raw.decay is not None, started=True)
        if raw.decay is not None:
            extra["scene_distance"] = _scene_distance(pipeline, raw, exported)
    state["_model._extra_state"] = extra
    return state


def _scene_distance(pipeline: Any, raw: RawGaussians, exported: Exported) -> float:
    """What decay divides distances by, in the scene's units here."""
    known = exported.origin.get("scene_distance")
    outputs = pipeline.datamanager.train_dataparser_outputs
    there = exported.scene
    if isinstance(known, int | float) and known > 0 and there is not None:
        return float(known) * float(outputs.dataparser_scale) / there.scale
    cameras = pipeline.datamanager.train_dataset.cameras
    gaussians = replace(pipeline.model.gaussians().select(torch.zeros(1, dtype=torch.int64)), means=raw.means.cpu())
    distances = [frustum_distance(gaussians, to_camera(cameras[i : i + 1])) for i in range(len(cameras))]
    return statistics.median(distances) or 1.0
