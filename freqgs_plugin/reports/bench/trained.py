"""A trained run for a benchmark."""

import io
import pickle
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import torch
import yaml

from freqgs_plugin.rendering.render import shade
from freqgs_plugin.reports.bench.options import BenchError
from freqgs_plugin.reports.bench.workloads import Workload, image_gradient

_UNREADABLE = (
    *(OSError, EOFError, RuntimeError, pickle.UnpicklingError, yaml.YAMLError),
    *(KeyError, TypeError, AttributeError, ImportError),
)
"""what damaged files and those of other versions raise: torch has no one error for them"""


def load(config_path: Path) -> Any:
    """`studio.checkpoint.load_run` without nerfstudio's remarks. nerfstudio asserts that the data is there.

    Raises:
        BenchError: there is no such run, it is of another method, or its files are damaged.
    """
    try:
        with quiet():
            from freqgs_plugin.studio.checkpoint import load_run

            return load_run(config_path)
    except UnicodeError as error:
        raise BenchError(f"{config_path} is no text ({error}); name the config.yml of a trained run.") from error
    except (FileNotFoundError, ValueError, AssertionError) as error:
        raise BenchError(str(error)) from error
    except SystemExit as error:
        raise BenchError(f"nerfstudio could not load {config_path}; `ns-eval --load-config` tells why") from error
    except torch.OutOfMemoryError:
        raise
    except _UNREADABLE as error:
        reason = " ".join(str(error).split())[:300]
        raise BenchError(
            f"the run {config_path} cannot be loaded: config.yml or the checkpoint in nerfstudio_models is damaged, or "
            f"another version wrote it ({type(error).__name__}: {reason}). Copy the run again, or load it with the "
            "version that trained it; where a checkpoint was cut off, remove it, and the one before it is used."
        ) from error


def views_of(run: Any) -> list[Any]:
    """The held-out views, or those trained on where none is held out."""
    with quiet():
        return run.cameras("test") or run.cameras("train")


def views_of_split(run: Any, split: str) -> list[Any]:
    """The views of `train` or `test`."""
    with quiet():
        return run.cameras(split)


@contextmanager
def quiet() -> Iterator[None]:
    """What nerfstudio has to say goes nowhere."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@torch.no_grad()
def trained_workload(run: Any) -> Workload:
    """The run's splats for its first held-out view, on the CPU."""
    view = views_of(run)[0]
    splats, background = shade(run.gaussians, view.camera), run.background
    there = Workload("trained view", splats, view.camera, background, image_gradient(view.camera), run.antialiased)
    return there.to("cpu")
