"""Where photographs are kept, memory or disk, by what they take and what is available."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE

from freqgs_plugin.io.available import available_memory
from freqgs_plugin.studio.disk_views import megabytes
from freqgs_plugin.studio.view_reading import view_bytes

Where = Literal["auto", "memory", "disk"]


def choose_place(config: Any, datasets: Sequence[Any], device: torch.device | str) -> Literal["memory", "disk"]:
    """Where `config` has the photographs of `datasets` kept. Says so, with what they take.

    nerfstudio reads all of them into the machine's memory, also those that it moves to a GPU (`cache_images` gpu);
    there, both must have room.
    """
    count = sum(len(dataset) for dataset in datasets)
    needed = sum(view_bytes(d, d.cameras, i, config.cache_images_type) for d in datasets for i in range(len(d)))
    place, share = config.cache_images_where, config.cache_images_share
    room, device = available_memory(), torch.device(device)
    reason = f"as cache-images-where says; {megabytes(room)} of memory are available"
    if place == "auto":
        if device.type == "cuda" and config.cache_images == "gpu":
            room = min(room, torch.cuda.mem_get_info(device)[0])
        fits = needed <= share * room
        place = "memory" if fits else "disk"
        reason = f"{'at most' if fits else 'more than'} {share:.0%} of the {megabytes(room)} that are available"
    saved = "" if place == "memory" else "; memory holds only the photographs in use"
    CONSOLE.log(f"{count} photographs take {megabytes(needed)}; they are kept {_IN[place]} ({reason}){saved}.")
    return place


_IN = {"memory": "in memory", "disk": "on disk"}


def scene_folder(config: Any) -> Path:
    """Where the files of a scene lie: a folder of its name and a hash of its full path."""
    data = Path(config.data).resolve()
    scene = data.parent if data.suffix == ".json" else data
    top = config.cache_images_dir or Path(
        os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "freqgs", "images"
    )
    return Path(top).expanduser() / f"{scene.name}-{hashlib.sha256(str(scene).encode()).hexdigest()[:8]}"


class EvalPairs(Sequence[tuple[Cameras, dict[str, Any]]]):
    """What nerfstudio's `fixed_indices_eval_dataloader` lists: cameras and photographs, each read when asked for."""

    def __init__(self, views: Sequence[dict[str, Any]], cameras: Cameras, device: torch.device | str):
        self._views, self._cameras, self._device = views, cameras, device

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> tuple[Cameras, dict[str, Any]]:  # pyright: ignore
        index = range(len(self))[index]
        data = dict(self._views[index])
        data["image"] = data["image"].to(self._device)
        return self._cameras[index : index + 1].to(self._device), data
