"""Frames on disk: PNG files that a second start finds again, and an MP4 of them."""

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from freqgs_plugin.io.images import read_image, to_uint8, write_image

RECORD = "frames.json"
LONGEST = 16384
"""side of a video that libx264 encodes, pixels"""


@dataclass(frozen=True)
class FrameRecord:
    """What was measured of one frame."""

    name: str
    drawn: int
    """Gaussians passed to the rasterizer"""
    milliseconds: float
    """of the picture alone"""
    gaze: tuple[float, float] | None = None


class FrameFolder:
    """A folder of frames made with one set of settings, and a record of them that is written with each.

    `names` are those of all files that are going to be written.

    Raises:
        FileExistsError: it holds frames of other settings, or files of these names that are no such frames.
    """

    budget: int | None
    """Gaussians per view that these frames were drawn with, where a budget was given; kept with the frames"""

    def __init__(self, folder: Path, settings: dict[str, Any], names: Sequence[str] = ()):
        self.folder, self._settings, self.budget = folder, settings, None
        self._key = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:16]
        self.records: dict[str, FrameRecord] = {}
        if (folder / RECORD).is_file():
            self.records = self._read()
        elif there := [name for name in names if (folder / name).exists()]:
            raise FileExistsError(
                f"{folder / there[0]} is there already, and no {RECORD} says that it is a frame; name another "
                "--output-dir, or move it away."
            )

    def _read(self) -> dict[str, FrameRecord]:
        path = self.folder / RECORD
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            found = [{**r, "gaze": r["gaze"] and tuple(r["gaze"])} for r in stored["frames"]]
            records = {r["name"]: FrameRecord(**r) for r in found}
            budget = stored.get("budget")
            if budget is not None and not (isinstance(budget, int) and budget > 0):
                raise ValueError(f"budget {budget!r}")
        except (ValueError, KeyError, TypeError) as error:
            raise FileExistsError(
                f"{path} is damaged ({error}); remove it and the frames beside it, and they are drawn again."
            ) from error
        if stored.get("key") != self._key:
            raise FileExistsError(
                f"{self.folder} holds frames of other settings; name another --output-dir, or remove that folder."
            )
        self.budget = budget
        return {name: record for name, record in records.items() if self.path(name).is_file()}

    def path(self, name: str) -> Path:
        """Of a frame's PNG."""
        return self.folder / f"{name}.png"

    def add(self, record: FrameRecord, picture: Float[np.ndarray, "h w 3"]) -> None:
        """Write the record of all frames so far and then this one, each in one piece."""
        self.folder.mkdir(parents=True, exist_ok=True)
        image = to_uint8(picture)
        self.records[record.name] = record
        frames = [vars(r) for r in self.records.values()]
        stored = {"key": self._key, "settings": self._settings, "budget": self.budget, "frames": frames}
        text = json.dumps(stored, indent=1, default=str)
        # first, so that a PNG in a folder without it is not ours; one that is recorded and not there is drawn again
        with _in_one_piece(self.folder / RECORD) as partial:
            partial.write_text(text + "\n", encoding="utf-8")
        with _in_one_piece(self.path(record.name)) as partial:
            write_image(partial, image)


def check_rate(fps: float | int) -> None:
    """Refuse, with a ValueError, rates that a video cannot have."""
    if not 0.01 <= fps <= 1000:
        raise ValueError(f"fps is {fps:g}; give frames per second from 0.01 to 1000, with --fps.")


@contextmanager
def _in_one_piece(path: Path) -> Iterator[Path]:
    """A file beside `path` of this process alone, which becomes it at the end, and is gone in any case."""
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_video(path: Path, frames: Sequence[Path], fps: float | int) -> None:
    """An H.264 MP4 of PNG files of one size, which any browser plays. An odd side repeats its last row or column.

    Raises:
        ValueError: no frames, or frames of several sizes.
    """
    import av

    if not frames:
        raise ValueError("no frames for a video.")
    height, width = read_image(frames[0]).shape[:2]
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    options = {"movflags": "faststart"}
    with _in_one_piece(path) as partial, av.open(str(partial), "w", format="mp4", options=options) as video:
        stream = video.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        stream.options = {"crf": "16"}
        for frame in frames:
            image = read_image(frame)
            if image.shape[:2] != (height, width):
                found = f"{image.shape[1]}x{image.shape[0]}"
                raise ValueError(f"{frame} is {found} px, the first frame {width}x{height}; give --size for a video.")
            video.mux(stream.encode(av.VideoFrame.from_ndarray(np.pad(image, padding, mode="edge"), format="rgb24")))
        video.mux(stream.encode(None))
