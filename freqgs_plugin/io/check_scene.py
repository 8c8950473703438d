"""Looks at a COLMAP folder before training starts, so that what is wrong is said at once and by file name.

The rules are those of nerfstudio 1.1.5: its `colmap` dataparser (downscaled folders, splits) and its full-image
datamanager. Fast: image headers are read, and at most about a hundred megapixels decoded.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from freqgs_plugin.io.check_images import Rounding, SceneError, check_images, some
from freqgs_plugin.io.colmap import check_lengths

if TYPE_CHECKING:
    from pycolmap import Reconstruction

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""camera models that nerfstudio turns into pinholes"""

EvalMode = Literal["fraction", "filename", "interval", "all"]


@dataclass(frozen=True)
class SceneSummary:
    """What a scene holds."""

    num_views: int
    num_train: int
    num_eval: int
    sizes: dict[tuple[int, int], int]
    """how many views have each (width, height), pixels, after downscaling"""
    downscale_factor: int
    num_points: int
    num_duplicate_points: int
    """points at exactly the place of another one"""
    warnings: list[str] = field(default_factory=list)


def check_colmap_scene(
    data: Path,
    *,
    colmap_path: Path,
    images_path: Path,
    downscale_factor: int | None = None,
    downscale_rounding_mode: Rounding = "floor",
    eval_mode: EvalMode = "interval",
    eval_interval: int = 8,
    train_split_fraction: float = 0.9,
    load_3D_points: bool = True,
) -> SceneSummary:
    """Check the scene in `data` as the dataparser with these settings (its own names and defaults) would read it.

    Raises:
        SceneError: training would fail, or would use pictures or cameras other than those meant.
    """
    model = _read_model(data, colmap_path)
    views = [model.images[i] for i in sorted(model.images)]
    names = [view.name for view in views]
    _check_cameras(model, data / colmap_path)
    if len(views) < 2:
        raise SceneError(
            f"{data / colmap_path} holds {len(views)} view(s); training needs at least two. Add photographs."
        )
    num_train, num_eval = _count_split(data, images_path, names, eval_mode, eval_interval, train_split_fraction)
    full = {view.name: (model.cameras[view.camera_id].width, model.cameras[view.camera_id].height) for view in views}
    factor, sizes, warnings = check_images(data / images_path, full, downscale_factor, downscale_rounding_mode)
    if num_eval < 1:
        warnings.append(f"no view of {data} is held out: training works, evaluation does not")
    num_points, num_duplicates = _check_points(model, data / colmap_path, load_3D_points, warnings)
    return SceneSummary(
        num_views=len(views),
        num_train=num_train,
        num_eval=num_eval,
        sizes=dict(Counter(sizes.values())),
        downscale_factor=factor,
        num_points=num_points,
        num_duplicate_points=num_duplicates,
        warnings=warnings,
    )


def _read_model(data: Path, colmap_path: Path) -> "Reconstruction":
    """The model, read in the form (text before binary) that the dataparser prefers."""
    if not data.is_dir():
        raise SceneError(f"the data folder {data} does not exist")
    folder = data / colmap_path
    form = next((f for f in ("txt", "bin") if (folder / f"cameras.{f}").is_file()), None)
    if form is None:
        raise SceneError(f"no COLMAP model (cameras.bin or cameras.txt) in {folder}. {_hint(data)}")
    for part in ("images", "points3D"):
        if not (folder / f"{part}.{form}").is_file():
            raise SceneError(f"{folder / part}.{form} is missing; copy or export the whole COLMAP model again")
    import pycolmap

    model = pycolmap.Reconstruction()
    try:
        if form == "txt":
            model.read_text(str(folder))
        else:
            check_lengths(folder)
            model.read_binary(str(folder))
    except Exception as error:
        raise SceneError(
            f"the COLMAP model in {folder} is damaged ({error}); copy it again or export it anew from COLMAP"
        ) from error
    return model


_CANDIDATES = ("colmap/sparse/0", "sparse/0", "sparse", "colmap/sparse", "colmap", ".")


def find_model(data: Path, candidates: tuple[str, ...] = _CANDIDATES) -> str | None:
    """The first of `candidates`, folders within `data`, that holds a COLMAP model; None where none does."""
    for candidate in candidates:
        if any((data / candidate / f"cameras.{form}").is_file() for form in ("txt", "bin")):
            return candidate
    return None


def _hint(data: Path) -> str:
    """What to do about a missing model."""
    found = find_model(data)
    if found is not None:
        return f"There is one in {data / found}: end the command with `colmap --colmap-path {found}`."
    if (data / "transforms.json").is_file():
        return "There is a transforms.json: use the `nerfstudio-data` dataparser in place of `colmap`."
    return "Run COLMAP, or `ns-process-data images`, on the photographs first."


def _check_cameras(model: "Reconstruction", folder: Path) -> None:
    for number, camera in model.cameras.items():
        if camera.model_name not in PINHOLES:
            raise SceneError(
                f"camera {number} of {folder} has the model {camera.model_name}, which does not become a pinhole. "
                f"Undistort the photographs with `colmap image_undistorter`. Usable models: {', '.join(PINHOLES)}."
            )
        numbers = np.asarray(camera.params)
        if camera.width < 1 or camera.height < 1 or not np.isfinite(numbers).all() or camera.mean_focal_length() <= 0:
            raise SceneError(
                f"camera {number} of {folder} is {camera.width}x{camera.height}, parameters {numbers.tolist()}: "
                "the model is damaged, copy or export it again"
            )


def _count_split(
    data: Path, images_path: Path, names: list[str], mode: EvalMode, interval: int, fraction: float
) -> tuple[int, int]:
    """Number of views to train on and to evaluate with."""
    lists = [data / f"{split}_list.txt" for split in ("train", "val", "test")]
    if any(path.exists() for path in (*lists, data / "validation_list.txt")):
        train, evaluation = _count_lists(lists, names)
        reason, remedy = f"{lists[0].name} and {lists[1].name} name", "Edit these files or remove them."
    elif mode == "interval":
        evaluation = len(range(0, len(names), max(interval, 1)))
        train = len(names) - evaluation
        reason, remedy = f"--eval-interval {interval} leaves", "Choose an interval of 2 or more."
    elif mode == "fraction":
        train = math.ceil(len(names) * fraction)
        evaluation = len(names) - train
        reason, remedy = f"--train-split-fraction {fraction} leaves", "Choose a fraction above 0."
    elif mode == "filename":
        train = sum("train" in Path(n).name for n in names)
        odd = [n for n in names if "train" not in Path(n).name and "eval" not in Path(n).name]
        if odd:
            raise SceneError(
                f"--eval-mode filename, but {some(odd)} in {data / images_path} hold neither train nor eval"
            )
        evaluation = len(names) - train
        reason, remedy = "--eval-mode filename leaves", "Rename images or choose another --eval-mode."
    else:
        return len(names), len(names)
    if train < 1:
        raise SceneError(f"{reason} {train} of {len(names)} views of {data} to train on. {remedy}")
    return train, evaluation


def _count_lists(lists: list[Path], names: list[str]) -> tuple[int, int]:
    counts = []
    for path in lists:
        if not path.is_file():
            raise SceneError(
                f"{path} is missing; where one of train, val and test_list.txt exists, all three are needed"
            )
        listed = set(path.read_text(encoding="utf8").splitlines())
        unknown = sorted(listed - set(names))
        if unknown:
            raise SceneError(f"{path} names views that the COLMAP model does not have: {some(unknown)}")
        counts.append(len(listed))
    return counts[0], counts[1]


def _check_points(model: "Reconstruction", folder: Path, wanted: bool, warnings: list[str]) -> tuple[int, int]:
    """Number of points, and of those that repeat another one's place."""
    xyz = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    if not np.isfinite(xyz).all():
        raise SceneError(
            f"{(~np.isfinite(xyz)).any(1).sum()} points of {folder} are not finite; export the model again"
        )
    if len(xyz) == 0 or not wanted:
        warnings.append(f"no points are read from {folder}: Gaussians start at random places")
        return 0, 0
    duplicates = len(xyz) - len(np.unique(xyz, axis=0))
    if duplicates:
        warnings.append(f"{duplicates} of {len(xyz)} points of {folder} lie exactly on another one")
    return len(xyz), duplicates
