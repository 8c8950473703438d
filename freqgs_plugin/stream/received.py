"""What has arrived of a stream, as a scene."""

import math

import numpy as np
import torch

from freqgs_plugin.stream.chunks import checksum, decode_chunk
from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.manifest import Chunk, Manifest
from freqgs_plugin.types import Gaussians

_WIDTHS = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "features_dc": 3}


class Received:
    """Rows of a stream. What has not arrived is not drawn; harmonics that have not are 0.

    While part of the base is missing, the axes are larger (see `enlarging`): by the least factor of what has arrived.
    """

    def __init__(self, manifest: Manifest):
        self.manifest = manifest
        widths = {**_WIDTHS, "features_rest": 3 * ((manifest.sh_degree + 1) ** 2 - 1)}
        if manifest.scene_distance is not None:
            widths["decay"] = 1
        self._columns = {name: np.zeros((manifest.count, width), np.float32) for name, width in widths.items()}
        self._enlarge = math.inf
        self._present = np.zeros(manifest.count, bool)
        self._level = np.concatenate([np.full(level.count, level.level) for level in manifest.levels])

    def add(self, chunk: Chunk, data: bytes) -> None:
        """Take a chunk, in any order.

        Raises:
            StreamError: it is damaged; nothing is taken.
        """
        if len(data) != chunk.bytes or checksum(data) != chunk.crc32:
            raise StreamError(
                f"the chunk at byte {chunk.offset:,} is damaged: its checksum is {checksum(data):08x}, not "
                f"{chunk.crc32:08x}. Fetch it again."
            )
        columns = decode_chunk(self.manifest.level(chunk.level).part(chunk.part), data, chunk.count)
        rows = slice(chunk.first, chunk.first + chunk.count)
        for name, values in columns.items():
            self._columns[name][rows] = values
        self._enlarge = min(self._enlarge, chunk.enlarge)
        if chunk.part == "core":
            self._present[rows] = True

    @property
    def count(self) -> int:
        """Gaussians that have arrived."""
        return int(self._present.sum())

    def gaussians(self) -> Gaussians:
        """The scene so far, in the stream's order."""
        rows = np.flatnonzero(self._present)
        take = {name: torch.from_numpy(values[rows]) for name, values in self._columns.items()}
        return Gaussians(
            means=take["means"],
            quats=take["quats"],
            scales=take["scales"] if self._enlarge == 1 or not len(rows) else take["scales"] * self._enlarge,
            opacities=take["opacities"][:, 0],
            features_dc=take["features_dc"],
            features_rest=take["features_rest"].reshape(len(rows), -1, 3),
            level=torch.from_numpy(self._level[rows].astype(np.int32)),
            signed_residuals=self.manifest.signed_residuals,
            decay=take["decay"][:, 0] if "decay" in take else None,
        )
