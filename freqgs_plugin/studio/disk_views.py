"""A data set's photographs on disk, at the size used: written once, mapped into memory while they are looked at."""

import hashlib
import json
import shutil
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor

from freqgs_plugin.io.check_images import SceneError
from freqgs_plugin.io.view_file import DamagedViewError, open_view, read_about, write_view
from freqgs_plugin.studio.view_reading import ImageType, file_state, read_view, view_bytes, view_settings

WORKERS = 2
"""threads that read and write, as in nerfstudio; so many photographs are in memory at once"""


class CacheError(SceneError):
    """Photographs cannot be kept on disk; the message names the place and the remedy."""


class DiskViews(Sequence[dict[str, Any]]):
    """What nerfstudio's `_load_images` returns, with every tensor mapped from its view's file anew at each look.

    As nerfstudio does, it undistorts the cameras of `dataset`. Each file stands for itself: one that is missing or
    damaged is written again, also in the middle of a run, and runs with another split of the scene share them.
    """

    def __init__(self, dataset: Any, image_type: ImageType, folder: Path):
        self._dataset, self._folder = dataset, folder
        self._image_type: ImageType = image_type
        self._cameras = deepcopy(dataset.cameras)  # as they were before any undistortion
        self._settings = [self._settings_now(i) for i in range(len(dataset))]
        names = (hashlib.sha256(json.dumps(s, sort_keys=True).encode()).hexdigest()[:24] for s in self._settings)
        self._files = [folder / f"{name}.view" for name in names]
        self._checked: set[int] = set()
        self._fill()
        for index, file in enumerate(self._files):
            for name, value in (read_about(file)["camera"] or {}).items():
                getattr(dataset.cameras, name)[index] = value

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> dict[str, Any]:  # pyright: ignore
        index = range(len(self))[index]
        try:
            tensors = open_view(self._files[index], index not in self._checked)
        except (FileNotFoundError, DamagedViewError) as error:
            CONSOLE.log(f"[yellow]{error}; {self._dataset.image_filenames[index].name} is read and cached again.")
            with self._alone():
                self._write([index])
            tensors = open_view(self._files[index], True)
        self._checked.add(index)
        return {"image_idx": index, **tensors}

    def _settings_now(self, index: int) -> dict[str, Any]:
        return view_settings(self._dataset, self._cameras, index, self._image_type)

    def _fill(self) -> None:
        """Write what is not there, and say what was done."""
        started, removed, written = time.perf_counter(), (0, 0), 0
        missing = self._missing(range(len(self)), say=False)
        if missing:
            with self._alone():
                missing = self._missing(missing, say=True)  # another process may have written them by now
                removed = self._remove_stale()
                written = self._write(missing)
        total = sum(file.stat().st_size for file in self._files)
        text = f"{len(self)} views, {megabytes(total)} in {self._folder}: {len(self) - len(missing)} were there, "
        text += f"{len(missing)} written ({megabytes(written)}), {time.perf_counter() - started:.1f} s."
        if removed[0]:
            text += f" {removed[0]} files that no run can use any more were removed ({megabytes(removed[1])})."
        CONSOLE.log(text)

    def _missing(self, views: Sequence[int], say: bool) -> list[int]:
        found = []
        for index in views:
            try:
                if read_about(self._files[index])["settings"] == self._settings[index]:
                    continue
            except FileNotFoundError:
                pass
            except DamagedViewError as error:
                if say:
                    CONSOLE.log(f"[yellow]{error}; it is written again.")
            except OSError as error:
                raise self._trouble(error) from error
            found.append(index)
        return found

    def _write(self, views: Sequence[int]) -> int:
        """Read and write these views; returns bytes. If one cannot be written, none of them stays."""
        needed = sum(view_bytes(self._dataset, self._cameras, i, self._image_type) for i in views)
        free = shutil.disk_usage(self._folder).free
        if needed > free:
            raise self._trouble(f"{megabytes(needed)} are needed, and {megabytes(free)} are free")
        try:
            with ThreadPoolExecutor(WORKERS) as threads:
                sizes = threads.map(self._write_one, views)
                # in the middle of a run there may be another progress bar
                bar = {"description": "Caching photographs", "transient": True, "disable": len(views) == 1}
                return sum(track(sizes, total=len(views), **bar))
        except CacheError:
            for index in views:
                self._files[index].unlink(missing_ok=True)
            raise

    def _write_one(self, index: int) -> int:
        data, camera = read_view(self._dataset, self._cameras, index, self._image_type)
        if self._settings_now(index) != self._settings[index]:
            name = self._dataset.image_filenames[index]
            raise SceneError(f"{name} has changed since the run began; start the run again.")
        tensors = {name: value for name, value in data.items() if isinstance(value, Tensor)}
        assert data.keys() - tensors.keys() == {"image_idx"}, data.keys()
        about = {"settings": self._settings[index], "camera": camera}
        try:
            return write_view(self._files[index], about, tensors)
        except OSError as error:
            raise self._trouble(error) from error

    def _remove_stale(self) -> tuple[int, int]:
        """Remove what no run can use any more; returns files and bytes. Only while no other process writes."""
        count = freed = 0
        others = set(self._folder.glob("*.view")) - set(self._files)
        for file in [*others, *self._folder.glob("*.part")]:
            if file.suffix == ".part" or _is_stale(file):
                count, freed = count + 1, freed + file.stat().st_size
                file.unlink()
        return count, freed

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """No other process writes into the folder meanwhile."""
        lock = FileLock(self._folder / "writing.lock")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                CONSOLE.log(f"Another process is caching photographs in {self._folder}; waiting for it.")
                lock.acquire()
        except OSError as error:
            raise self._trouble(error) from error
        try:
            yield
        finally:
            lock.release()

    def _trouble(self, cause: OSError | str) -> CacheError:
        return CacheError(
            f"photographs cannot be cached in {self._folder}: {cause}. Make room or name another folder with "
            "`--pipeline.datamanager.cache-images-dir`, keep them in memory with "
            "`--pipeline.datamanager.cache-images-where memory`, or use a larger downscale factor."
        )


def _is_stale(file: Path) -> bool:
    """Whether a photograph that the file was made of has changed or gone, or the file is damaged."""
    try:
        sources = read_about(file)["settings"]["sources"]
        return any(file_state(Path(name)) != [name, *state] for name, *state in sources)
    except (FileNotFoundError, NotADirectoryError, DamagedViewError):
        return True


def megabytes(count: int) -> str:
    """Bytes as text, in millions."""
    return f"{count / 1e6:,.1f} MB"
