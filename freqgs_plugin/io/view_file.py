"""A view's tensors in a file: written in one piece, checked, and mapped into memory only while somebody holds them.

Layout: magic, length and CRC-32 of the header (little-endian), the header (JSON, padded), the tensors' bytes.
"""

import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

MAGIC = b"freqgsv1"
_START = struct.Struct("<8sII")
_ALIGNMENT = 64
"""of the tensors in the file, bytes"""


class DamagedViewError(ValueError):
    """A file that is truncated, altered or of another kind; the message names it."""


def write_view(path: Path, about: dict[str, Any], tensors: dict[str, Tensor]) -> int:
    """Write `tensors` and the JSON object `about`; returns the size of the file, bytes.

    Written beside its name first, so that no reader ever sees a part of it. What was at `path` is replaced; who has
    that open keeps it. One process at a time may write a path.
    """
    assert tensors, "a view without tensors"
    # not ascontiguousarray: that gives a scalar an axis
    arrays = {name: np.asarray(tensor.numpy(), order="C") for name, tensor in tensors.items()}
    places, blocks, end, check = {}, [], 0, 0
    for name, array in arrays.items():
        places[name] = [array.dtype.str, list(array.shape), end]
        for block in (array.reshape(-1).view(np.uint8).data, bytes(-array.nbytes % _ALIGNMENT)):
            blocks.append(block)
            check, end = zlib.crc32(block, check), end + len(block)
    header = json.dumps({"about": about, "tensors": places, "bytes": end, "check": check}).encode()
    header += b" " * (-(_START.size + len(header)) % _ALIGNMENT)
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            for block in (_START.pack(MAGIC, len(header), zlib.crc32(header)), header, *blocks):
                file.write(block)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return _START.size + len(header) + end


def read_about(path: Path) -> dict[str, Any]:
    """What was given as `about`. Looks at the header and the size of the file, not at the tensors.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedViewError: the header is damaged, or the file has another size.
    """
    return _header(path)[0]["about"]


def open_view(path: Path, check: bool) -> dict[str, Tensor]:
    """The tensors, mapped from the file. What is written into them changes a copy in memory, not the file.

    Args:
        check: read all of it, and compare with the checksum.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedViewError: it is damaged.
    """
    header, start = _header(path)
    data = np.asarray(np.memmap(path, np.uint8, mode="c", offset=start, shape=(header["bytes"],)))
    if check and zlib.crc32(data.data) != header["check"]:
        raise DamagedViewError(f"{path} is damaged: its checksum is another one")
    tensors = {}
    for name, (kind, shape, begin) in header["tensors"].items():
        dtype = np.dtype(kind)
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        tensors[name] = torch.from_numpy(data[begin : begin + size].view(dtype).reshape(shape))
    return tensors


def _header(path: Path) -> tuple[dict[str, Any], int]:
    """The header, and where the tensors begin, bytes."""
    with path.open("rb") as file:
        size, start = os.fstat(file.fileno()).st_size, file.read(_START.size)
        if len(start) < _START.size:
            raise DamagedViewError(f"{path} is damaged: it ends after {size} bytes")
        magic, length, check = _START.unpack(start)
        if magic != MAGIC:
            raise DamagedViewError(f"{path} is damaged, or no file of this kind: it begins with {magic!r}")
        text = file.read(min(length, size))
    if len(text) < length or zlib.crc32(text) != check:
        raise DamagedViewError(f"{path} is damaged: its header is not what was written")
    header, begin = json.loads(text), _START.size + length
    if size != begin + header["bytes"]:
        raise DamagedViewError(f"{path} is damaged: it has {size} bytes instead of {begin + header['bytes']}")
    return header, begin
