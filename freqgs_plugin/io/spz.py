"""The flag of an SPZ file that says which viewers it was made for: splat-transform 2.7 neither writes nor reads it.

Niantic's header: magic, version and number of points of four bytes each, then a byte each of the harmonics' degree, the
positions' fractional bits, and flags. From version 4 on it is not compressed; before, all of the file is one gzip.
"""

import gzip
import zlib
from pathlib import Path

from freqgs_plugin.io.ply import SplatFileError

ANTIALIASED = 0x1
"""the flag's bit: opacities are compensated (Mip-Splatting)"""
_MAGIC, _FLAGS, _HEADER = b"NGSP", 14, 16


def read_antialiased(path: Path) -> bool:
    """Whether the flag is set.

    Raises:
        SplatFileError: it is no SPZ file.
    """
    return bool(_content(path)[0][_FLAGS] & ANTIALIASED)


def mark_antialiased(path: Path) -> None:
    """Set the flag.

    Raises:
        SplatFileError: it is no SPZ file.
        OSError: it cannot be written.
    """
    content, packed = _content(path)
    changed = bytearray(content)
    changed[_FLAGS] |= ANTIALIASED
    path.write_bytes(gzip.compress(bytes(changed), mtime=0) if packed else bytes(changed))


def _content(path: Path) -> tuple[bytes, bool]:
    """What the file holds, and whether it was one gzip."""
    content = path.read_bytes()
    packed = content[:2] == b"\x1f\x8b"
    try:
        content = gzip.decompress(content) if packed else content
    except (EOFError, OSError, zlib.error) as error:
        raise SplatFileError(f"{path} is damaged ({error}); export or copy it again.") from error
    if len(content) < _HEADER or content[:4] != _MAGIC:
        raise SplatFileError(f"{path} is no SPZ file; name one, or a PLY.")
    return content, packed
