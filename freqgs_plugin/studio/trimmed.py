"""Writes a trimmed run: a folder beside the old one, with everything that nerfstudio's commands read."""

import copy
import io
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from freqgs_plugin.apps.trimming import Draft, without_empty_levels
from freqgs_plugin.io.init_source import TRANSFORMS
from freqgs_plugin.io.packed import pack, packing_order
from freqgs_plugin.studio.checkpoint import Run
from freqgs_plugin.studio.run_files import CHECKPOINTS, in_one_piece, save_checkpoint

_MODEL = "_model."


def check_place(folder: Path, method: str) -> None:
    """Refuse a folder where nerfstudio would not find the run, or that is there.

    Raises:
        ValueError, FileExistsError
    """
    if folder.parent.name != method:
        raise ValueError(
            f"{folder} does not lie in a folder called {method}; nerfstudio finds runs as EXPERIMENT/{method}/NAME. "
            "Name such a folder."
        )
    if folder.exists():
        raise FileExistsError(f"{folder} is there already; name another --output-dir, or remove it.")


def trimmed_state(run: Run, draft: Draft) -> dict[str, Any]:
    """The pipeline's state with nothing but the draft in it, packed."""
    pipeline = {name: value for name, value in run.state().items() if not name.startswith(_MODEL)}
    model = {name.removeprefix(_MODEL): value for name, value in run.state().items() if name.startswith(_MODEL)}
    gaussians = draft.gaussians
    order = packing_order(gaussians.features_rest)
    rows = draft.rows[order]
    for name in [name for name in model if name.startswith("gauss_params.")]:
        model[name] = model[name].detach()[rows]
    model["gauss_params.features_dc"] = gaussians.features_dc.detach()[order]
    model["gauss_params.features_rest"] = gaussians.features_rest.detach()[order]
    model["level"], levels = without_empty_levels(gaussians.level[order].int())
    extra = {**model["_extra_state"], "trimmed": True, "strategy": {}}
    extra["sh_degree"] = min(int(extra["sh_degree"]), sh_degree(draft))
    if "num_levels" in extra:
        extra["stage"] = extra["num_levels"] = len(levels)
    config: Any = run.model.config
    if gaussians.decay is None and extra.get("decays"):
        extra["decays"] = False
        model["gauss_params.decay"] = torch.full_like(model["gauss_params.decay"], config.initial_decay)
    model["_extra_state"] = extra
    return {**pipeline, **{f"{_MODEL}{name}": _on_cpu(value) for name, value in pack(model).items()}}


def sh_degree(draft: Draft) -> int:
    """The largest degree of its Gaussians' harmonics that is stored."""
    return round((draft.gaussians.features_rest.shape[1] + 1) ** 0.5) - 1


def checkpoint_of(run: Run, draft: Draft) -> dict[str, Any]:
    """As nerfstudio's trainer writes it, without what only training needs."""
    state = trimmed_state(run, draft)
    return {"step": run.step, "pipeline": state, "optimizers": {}, "schedulers": {}, "scalers": {}}


class _Counter(io.RawIOBase):
    """Where bytes are counted, and nothing is written."""

    count = 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        size = memoryview(data).nbytes
        self.count += size
        return size


def checkpoint_bytes(run: Run, draft: Draft) -> int:
    """Size of the checkpoint that `write_trimmed` would write."""
    counter = _Counter()
    file: Any = counter
    torch.save(checkpoint_of(run, draft), file)
    return counter.count


def write_trimmed(run: Run, draft: Draft, old: Path, folder: Path, more: Mapping[str, str]) -> Path:
    """Write the run to `folder`, which appears in one piece, and return its config.yml.

    `old` is the folder of the run, of which nothing is changed. `more` are further files: name -> text.

    Raises:
        ValueError, FileExistsError: see `check_place`.
        OSError: it cannot be written, or the disk is full. Nothing is left behind then, nor after an interrupt.
    """
    method = run.config.method_name
    check_place(folder, method)
    folder = folder.resolve()
    with in_one_piece(folder) as partial:
        (partial / "config.yml").write_text(yaml.dump(_config(run, draft, folder)), encoding="utf-8")
        if (old / TRANSFORMS).is_file():
            shutil.copy2(old / TRANSFORMS, partial / TRANSFORMS)
        (partial / CHECKPOINTS).mkdir()
        save_checkpoint(checkpoint_of(run, draft), partial / CHECKPOINTS / f"step-{run.step:09d}.ckpt", folder)
        for name, text in more.items():
            (partial / name).write_text(text, encoding="utf-8")
    return folder / "config.yml"


def _config(run: Run, draft: Draft, folder: Path) -> Any:
    """The run's, for where the new one lies and for what is left of its scene."""
    config = copy.deepcopy(run.config)
    config.output_dir, config.experiment_name = folder.parents[2], folder.parents[1].name
    config.timestamp = folder.name
    config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
    model = config.pipeline.model
    model.sh_degree = sh_degree(draft)
    if hasattr(model, "num_levels"):
        model.num_levels = len(without_empty_levels(draft.gaussians.level)[1])
    return config


def _on_cpu(value: Any) -> Any:
    if not isinstance(value, Tensor) or value.device.type == "cpu":
        return value
    # a view of one row stays one
    strides = value.stride()
    return value[:1].cpu().expand(value.shape) if strides and strides[0] == 0 and len(value) else value.cpu()
