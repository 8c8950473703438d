"""What lies in a run's folder: looked at before nerfstudio loads it, since what that says of damage names no remedy;
and written whole, or not at all."""

import os
import re
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig

CHECKPOINTS = "nerfstudio_models"
"""folder in a run's"""


def read_config(path: Path) -> Any:
    """nerfstudio's TrainerConfig.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it holds something else.
        yaml.YAMLError, and whatever else a damaged description of Python objects leads to.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file; name the config.yml of a trained run.")
    config = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.Loader)
    if not isinstance(config, TrainerConfig):
        raise ValueError(
            f"{path} holds no settings of ns-train but {config!r:.40}: it is damaged, or no config.yml of a run. Name "
            "the config.yml of a trained run, or copy the run again."
        )
    return config


def latest_checkpoint(run: Path) -> tuple[Path, int]:
    """The newest checkpoint in a run's folder, and its step. Files of other names beside it do not matter.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is cut off, or its contents have changed since it was written.
    """
    folder = run / CHECKPOINTS
    found = [re.fullmatch(r"step-(\d{9,})\.ckpt", path.name) for path in folder.glob("step-*.ckpt")]
    steps = [int(match[1]) for match in found if match]
    if not steps:
        raise FileNotFoundError(f"{folder} holds no step-000000000.ckpt; the run has not saved a checkpoint yet.")
    path = folder / f"step-{max(steps):09d}.ckpt"
    check_whole(path)
    return path, max(steps)


@contextmanager
def in_one_piece(run: Path) -> Iterator[Path]:
    """A folder beside `run`, which becomes it at the end; where that fails, nothing is left of it.

    Raises:
        FileExistsError: `run` is there by then.
    """
    missing = [path for path in run.parents if not path.exists()]
    run.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{run.name}-", dir=run.parent))
    try:
        partial.chmod(0o755)
        yield partial
        if run.exists():
            raise FileExistsError(f"{run} has appeared meanwhile; name another --output-dir, or remove it.")
        os.rename(partial, run)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        for path in missing:
            if not any(path.iterdir()):
                path.rmdir()


@contextmanager
def naming_the_disk(name: str, folder: Path, run: Path, remedy: str) -> Iterator[None]:
    """torch writes the file `name` into `folder`; it ends up in `run`.

    Raises:
        OSError: the disk is full; what torch says of that does not name it.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        free = shutil.disk_usage(folder).free
        reason = str(error).splitlines()[0]
        raise OSError(
            f"{name} cannot be written to {run} ({reason}); {free / 1e6:,.0f} MB are free there. {remedy}"
        ) from error


def save_checkpoint(content: dict[str, Any], path: Path, run: Path) -> None:
    """Write a checkpoint of the run that is going to lie at `run`.

    Raises:
        OSError: the disk is full.
    """
    with naming_the_disk(path.name, path.parent, run, "Make room, or name another --output-dir."):
        torch.save(content, path)


def check_whole(path: Path) -> None:
    """By the checksums that torch writes and does not look at: else lost blocks become parameters, mostly zeros.

    Raises:
        ValueError: the file is cut off, or its contents have changed since it was written.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        damaged = str(error)
    if damaged is not None:
        raise ValueError(
            f"{path} cannot be loaded: it is truncated or damaged ({damaged}). Copy it again, or remove it: then the "
            "checkpoint before it is used, where there is one."
        )
