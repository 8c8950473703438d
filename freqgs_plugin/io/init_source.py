"""Gaussians to start a training from: a 3DGS PLY, or the checkpoint of a nerfstudio run of splatfacto or of ours.

A run stores its Gaussians in nerfstudio's frame of its scene, which is turned, moved and scaled against the data set's;
`dataparser_transforms.json` beside its config.yml says how. Of a run, only that file and the checkpoint are read.
"""

import json
import pickle
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from freqgs_plugin.functional.harmonics import MAX_DEGREE, num_coefficients
from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.io.packed import unpack
from freqgs_plugin.io.parameters import GROUPS, RawGaussians
from freqgs_plugin.io.ply import SplatFileError, read_ply

TRANSFORMS = "dataparser_transforms.json"
_CHECKPOINTS = "nerfstudio_models"
_PREFIX = "_model.gauss_params."
_OLD_PREFIX = "_model."
"""of splatfacto before nerfstudio 1.0"""


@dataclass(frozen=True)
class InitSource:
    """Gaussians of a file or run, in its own frame."""

    path: Path
    """the PLY or the checkpoint"""
    gaussians: RawGaussians
    frame: Similarity | None
    """from the data set's frame to the Gaussians'; None: the file does not say"""
    antialiased: bool | None
    """trained with opacity compensation; None: the file does not say"""
    summary: str
    """what was read, in a sentence"""

    def in_frame(self, scene: Similarity, declared: str) -> RawGaussians:
        """The Gaussians in the frame `scene` (from the data set's to the one to train in).

        Where the source does not say what frame it is in, `declared` does: `scene`, or `dataset`, as COLMAP's.

        Raises:
            ValueError: another frame is declared.
        """
        if declared not in ("scene", "dataset"):
            raise ValueError(f"the frame of {self.path} is declared as '{declared}'; choose scene or dataset.")
        frame = self.frame
        if frame is None:
            frame = scene if declared == "scene" else Similarity.identity()
        return self.gaussians.moved(scene.after(frame.inverse()))


def read_init_source(
    path: Path, *, signed_residuals: bool | None = None, antialiased: bool | None = None
) -> InitSource:
    """Read a PLY, a run (its folder, its config.yml, or a checkpoint of it), and check what it holds.

    Args:
        path: the file or folder.
        signed_residuals: whether colours above level 1 are signed residuals, which a checkpoint does not say.
        antialiased: whether the run was trained with opacity compensation, which a checkpoint does not say.

    Raises:
        FileNotFoundError: there is nothing, or no checkpoint, at `path`.
        SplatFileError: it cannot be used; the message names the file and the remedy.
    """
    path = Path(path)
    if path.suffix.lower() == ".ply":
        gaussians, summary = read_ply(path)
        return InitSource(path, gaussians, None, summary.antialiased, str(summary))
    checkpoint = find_checkpoint(path)
    gaussians, step = _read_checkpoint(checkpoint)
    _refuse_residuals(checkpoint, gaussians, signed_residuals)
    frame = _frame_beside(checkpoint)
    extras = [name for name, x in (("levels", gaussians.level), ("decay", gaussians.decay)) if x is not None]
    summary = (
        f"{checkpoint}: {len(gaussians):,} Gaussians of step {step}; SH degree {gaussians.sh_degree}"
        f"{''.join(f'; with {name}' for name in extras)}."
    )
    return InitSource(checkpoint, gaussians, frame, antialiased, summary)


def find_checkpoint(path: Path) -> Path:
    """The latest checkpoint of a run, which is named by its folder, its config.yml, or its folder of checkpoints.

    Raises:
        FileNotFoundError: there is none.
        SplatFileError: `path` is a file of another kind.
    """
    path = Path(path)
    if path.suffix == ".ckpt" and path.is_file():
        return path
    if path.is_file() and path.name != "config.yml":
        raise SplatFileError(
            f"{path} is neither a PLY nor part of a run; name a .ply file, a run's folder or its config.yml."
        )
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; name a 3DGS PLY, a run's folder or its config.yml.")
    folder = path.parent if path.is_file() else path
    found = [*(folder / _CHECKPOINTS).glob("step-*.ckpt"), *folder.glob("step-*.ckpt")]
    numbered = {int(match[1]): file for file in found if (match := re.fullmatch(r"step-(\d+)\.ckpt", file.name))}
    if not numbered:
        raise FileNotFoundError(
            f"{folder} holds no {_CHECKPOINTS}/step-*.ckpt; name the folder of a run that has saved a checkpoint (the "
            "one with config.yml in it), or a .ply file."
        )
    return numbered[max(numbered)]


def read_frame(path: Path) -> Similarity:
    """nerfstudio's `dataparser_transforms.json`: from the data set's frame to the scene's.

    Raises:
        SplatFileError: it cannot be read, or is no rotation, translation and scale.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        return frame_of(content["transform"], content["scale"])
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise SplatFileError(
            f"{path} is no dataparser transform of nerfstudio ({error}). Without that file, the source is taken to be "
            "in the frame that init-from-frame names."
        ) from error


def frame_of(transform: Any, scale: float | int) -> Similarity:
    """nerfstudio's dataparser transform, [3 4] or [4 4], and its scale."""
    matrix = torch.as_tensor(transform, dtype=torch.float64)
    if matrix.dim() != 2 or matrix.shape[0] not in (3, 4) or matrix.shape[1] != 4:
        raise ValueError(f"a transform is 3 by 4 or 4 by 4, not {list(matrix.shape)}")
    return Similarity(matrix[:3, :3], matrix[:3, 3], float(scale))


def _frame_beside(checkpoint: Path) -> Similarity | None:
    for folder in (checkpoint.parent.parent, checkpoint.parent):
        if (folder / TRANSFORMS).is_file():
            return read_frame(folder / TRANSFORMS)
    return None


def _read_checkpoint(path: Path) -> tuple[RawGaussians, int]:
    content = load_checkpoint(path)
    if not isinstance(content, dict) or not isinstance(content.get("pipeline"), dict):
        raise SplatFileError(f"{path} is no checkpoint of nerfstudio's trainer: it holds no 'pipeline'. Name another.")
    # distributed training puts `module.` into the names
    tensors = {str(name).replace("module.", ""): value for name, value in content["pipeline"].items()}
    try:
        tensors = unpack(tensors, "_model.")
    except ValueError as error:
        raise SplatFileError(f"{path}: {error}") from error
    prefix = _PREFIX if f"{_PREFIX}means" in tensors else _OLD_PREFIX
    missing = [name for name in GROUPS if not isinstance(tensors.get(prefix + name), Tensor)]
    if missing:
        some = ", ".join(sorted(tensors)[:3]) or "nothing"
        raise SplatFileError(
            f"{path} holds no Gaussians: it lacks {', '.join(missing)}, and has {some} ... "
            "Name a run of splatfacto, lapsplat or clodsplat."
        )
    known = {*GROUPS, "decay"}
    other = [name.removeprefix(_PREFIX) for name in tensors if name.startswith(_PREFIX)]
    other = sorted(set(other) - known)
    if other:
        raise SplatFileError(
            f"{path} is of another method: its Gaussians have {', '.join(other)} too, which cannot be taken over. "
            "Export a 3DGS PLY with that method's own commands, and start from it."
        )
    level, decay = tensors.get("_model.level"), tensors.get(f"{_PREFIX}decay")
    raw = _shaped(path, {name: tensors[prefix + name] for name in GROUPS}, level, decay)
    _check_values(path, raw)
    step = content.get("step", 0)
    if not isinstance(step, int):
        raise SplatFileError(f"{path}: its step is {step!r}, no whole number; name another checkpoint of the run.")
    return raw, step


def load_checkpoint(path: Path) -> Any:
    """The checkpoint without running any code in it; memory-mapped, so that optimizer states are not read.

    Raises:
        SplatFileError: it is truncated, or holds more than tensors and numbers.
    """
    try:
        with torch.serialization.safe_globals(_numpy_scalars()):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL (\S+)", str(error))
        what = f"objects of {found[1]}" if found else "something"
        raise SplatFileError(
            f"{path} holds {what} beside tensors and numbers, which are not loaded because that could run code. "
            "Export a 3DGS PLY from that run (`ns-export gaussian-splat`), and start from it."
        ) from error
    except (RuntimeError, OSError, EOFError, ValueError) as error:
        raise SplatFileError(
            f"{path} cannot be read ({str(error).splitlines()[0]}): it is truncated, or no checkpoint of torch. "
            "Name an earlier checkpoint of the run, or copy it again."
        ) from error


def _numpy_scalars() -> list[Any]:
    """What numpy scalars are made of: nerfstudio's learning rates are some, and torch refuses them from 2.6 on.

    Checkpoints that were written with numpy 2 name the function that makes them by another module.
    """

    def scalar(*args: Any) -> Any:
        return np.core.multiarray.scalar(*args)  # pyright: ignore[reportAttributeAccessIssue]

    scalar.__module__, scalar.__qualname__, scalar.__name__ = "numpy._core.multiarray", "scalar", "scalar"
    kinds = [type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64, np.int32, np.bool_)]
    return [np.core.multiarray.scalar, scalar, np.dtype, *kinds]  # pyright: ignore[reportAttributeAccessIssue]


def _shaped(path: Path, tensors: dict[str, Tensor], level: Any, decay: Any) -> RawGaussians:
    """The tensors as float32 copies in the shapes that they must have."""
    n = len(tensors["means"]) if tensors["means"].dim() else 0
    if n == 0:
        raise SplatFileError(f"{path} holds no Gaussians; name another checkpoint of the run.")
    rest = tensors["features_rest"].shape
    allowed = [num_coefficients(degree) - 1 for degree in range(MAX_DEGREE + 1)]
    shapes = {
        "means": (n, 3),
        "scales": (n, 3),
        "quats": (n, 4),
        "features_dc": (n, 3),
        "features_rest": (n, rest[1] if len(rest) == 3 and rest[1] in allowed else allowed[-2], 3),
        "opacities": (n, 1),
    }
    for name, shape in shapes.items():
        if tuple(tensors[name].shape) != shape:
            raise SplatFileError(
                f"{path}: {name} has shape {list(tensors[name].shape)} in place of {list(shape)}; it is of another "
                "method. Export a 3DGS PLY with that method's own commands, and start from it."
            )
    for name, extra in (("level", level), ("decay", decay)):
        if extra is not None and not isinstance(extra, Tensor):
            raise SplatFileError(f"{path}: {name} is no tensor but {extra!r:.60}; the run is damaged.")
        if extra is not None and extra.numel() != n:
            raise SplatFileError(f"{path}: {name} has {extra.numel()} values for {n} Gaussians; the run is damaged.")
    return RawGaussians(
        **{name: tensor.detach().float().clone() for name, tensor in tensors.items()},
        level=None if level is None else level.to(torch.int32).clone(),
        decay=None if decay is None else decay.detach().float().reshape(n).clone(),
    )


def _check_values(path: Path, raw: RawGaussians) -> None:
    for name in (*GROUPS, "decay"):
        value = getattr(raw, name)
        bad = 0 if value is None else int((~torch.isfinite(value)).reshape(len(raw), -1).any(-1).sum())
        if bad:
            raise SplatFileError(
                f"{path}: {name} of {bad} of {len(raw)} Gaussians is NaN or infinite. Name an earlier checkpoint of "
                "the run, or export a PLY, which leaves such Gaussians out (`ns-export gaussian-splat`)."
            )
    if bool((raw.quats == 0).all(-1).any()):
        raise SplatFileError(f"{path}: a quaternion is zero, which is no rotation. Name an earlier checkpoint.")
    if raw.level is not None and int(raw.level.min()) < 1:
        raise SplatFileError(f"{path}: levels begin with 1, but one is {int(raw.level.min())}; the run is damaged.")


def _refuse_residuals(path: Path, raw: RawGaussians, signed: bool | None) -> None:
    if raw.level is None or int(raw.level.max()) == 1 or signed is False:
        return
    levels = int(raw.level.max())
    how = (
        "signed residuals" if signed else "signed residuals, unless its config.yml (which was not found) says otherwise"
    )
    raise SplatFileError(
        f"{path} has {levels} levels, whose colours above level 1 are {how}: without their levels they would be drawn "
        "as plain colours, wrongly. Start from a run with `--pipeline.model.signed-residuals False` or with "
        "`--pipeline.model.num-levels 1`."
    )
