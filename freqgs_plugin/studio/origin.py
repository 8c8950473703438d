"""Where a run's Gaussians come from, in plain values that an export carries along and an import reads."""

from dataclasses import fields
from pathlib import Path
from typing import Any

from nerfstudio.configs.dataparser_configs import dataparsers

from freqgs_plugin.studio.checkpoint import Run

_NEVER = {"init_from", "steps_scale"}
"""settings of a model that an imported run must not repeat"""


def origin_of(run: Run) -> dict[str, Any]:
    """Method, data, dataparser, model settings and frame of a run."""
    manager = run.config.pipeline.datamanager
    parser = manager.dataparser
    data = manager.data if manager.data is not None else parser.data
    return {
        "method": run.config.method_name,
        "experiment": run.config.experiment_name,
        "step": run.step,
        "data": str(Path(data).resolve()),
        "dataparser": parser_name(parser),
        "dataparser_settings": _settings(parser),
        "model_settings": {k: v for k, v in _settings(run.config.pipeline.model).items() if k not in _NEVER},
        "scene_distance": run.scene_distance,
        "transform": run.frame_matrix,
        "scale": run.frame.scale,
    }


def parser_name(parser: Any) -> str | None:
    """What the dataparser is called on ns-train's command line; None: none of nerfstudio's own."""
    return next((name for name, known in dataparsers.items() if type(known) is type(parser)), None)


def _settings(config: Any) -> dict[str, Any]:
    """Fields that are numbers, texts or paths, or tuples of these."""
    found: dict[str, Any] = {}
    for field in fields(config):
        value = getattr(config, field.name)
        if field.name == "data":
            continue
        if isinstance(value, Path):
            found[field.name] = str(value)
        elif value is None or isinstance(value, bool | int | float | str):
            found[field.name] = value
        elif isinstance(value, tuple) and all(isinstance(x, int | float | str) for x in value):
            found[field.name] = list(value)
    return found
