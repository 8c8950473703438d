"""What several compiled losses share."""

from torch import Tensor

from freqgs_plugin.functional.numba_threads import njit


@njit(fastmath={"reassoc"}, error_model="numpy", cache=True, nogil=True)
def row_sum(line):
    """Sum in float64, in the order that vectors take: fast, and the same bits on each call."""
    total = 0.0
    for i in range(line.size):
        total += line[i]
    return total


def scaled(gradient: Tensor, upstream: Tensor) -> Tensor:
    """`gradient` times a number; not copied where that is 1."""
    return gradient if float(upstream) == 1 else gradient * upstream
