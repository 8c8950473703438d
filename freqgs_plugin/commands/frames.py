"""Frames on disk: PNG files that a second start finds again, and an MP4 of them."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from freqgs_plugin.io.images import read_image, to_uint8, write_image

RECORD = "frames.json"


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
    """A folder of frames made with one set of settings, and a record of them that is written after each.

    Raises:
        FileExistsError: it holds frames of other settings.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]):
        self.folder, self._settings = folder, settings
        self._key = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:16]
        self.records: dict[str, FrameRecord] = {}
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / RECORD).is_file():
            self.records = self._read()

    def _read(self) -> dict[str, FrameRecord]:
        path = self.folder / RECORD
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            found = [{**r, "gaze": r["gaze"] and tuple(r["gaze"])} for r in stored["frames"]]
            records = {r["name"]: FrameRecord(**r) for r in found}
        except (ValueError, KeyError, TypeError) as error:
            raise FileExistsError(f"{path} is damaged ({error}); remove it, and all frames are drawn again.") from error
        if stored.get("key") != self._key:
            raise FileExistsError(
                f"{self.folder} holds frames of other settings; name another --output-dir, or remove {path}."
            )
        return {name: record for name, record in records.items() if self.path(name).is_file()}

    def path(self, name: str) -> Path:
        """Of a frame's PNG."""
        return self.folder / f"{name}.png"

    def add(self, record: FrameRecord, picture: Float[np.ndarray, "h w 3"]) -> None:
        """Write one frame and the record of all so far, each in one piece."""
        image = to_uint8(picture)
        partial = self.folder / f".{record.name}.png"
        write_image(partial, image)
        os.replace(partial, self.path(record.name))
        self.records[record.name] = record
        frames = [vars(r) for r in self.records.values()]
        text = json.dumps({"key": self._key, "settings": self._settings, "frames": frames}, indent=1, default=str)
        partial = self.folder / f".{RECORD}"
        partial.write_text(text + "\n", encoding="utf-8")
        os.replace(partial, self.folder / RECORD)


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
    partial = path.with_name(f".{path.name}")
    with av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"}) as video:
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
    os.replace(partial, path)
