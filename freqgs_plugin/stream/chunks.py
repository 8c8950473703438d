"""Chunks: some rows of a level, their core or their harmonics, deflated."""

import zlib
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.quantise import Coding, decode_column, encode_column

Columns = Mapping[str, Float[np.ndarray, "n c"]]
"""name -> numbers of some rows"""
DEFLATE_LEVEL = 9


def encode_chunk(codings: Sequence[Coding], columns: Columns) -> bytes:
    """The columns that `codings` name, one after the other, as a zlib stream."""
    return zlib.compress(b"".join(encode_column(coding, columns[coding.name]) for coding in codings), DEFLATE_LEVEL)


def decode_chunk(codings: Sequence[Coding], data: bytes, rows: int) -> dict[str, Float[np.ndarray, "n c"]]:
    """`encode_chunk`, back.

    Raises:
        StreamError: the data is no such chunk.
    """
    try:
        raw = zlib.decompress(data)
    except zlib.error as error:
        raise StreamError(f"a chunk of {len(data):,} bytes cannot be inflated ({error}); write the stream anew.") from (
            error
        )
    expected = rows * sum(coding.bytes_per_row for coding in codings)
    if len(raw) != expected:
        raise StreamError(
            f"a chunk of {rows:,} rows holds {len(raw):,} bytes instead of {expected:,}; write the stream anew."
        )
    found, start = {}, 0
    for coding in codings:
        end = start + rows * coding.bytes_per_row
        found[coding.name] = decode_column(coding, raw[start:end], rows)
        start = end
    return found


def checksum(data: bytes) -> int:
    """CRC-32, which finds damage in transit; browsers offer stronger sums on encrypted pages alone."""
    return zlib.crc32(data)
