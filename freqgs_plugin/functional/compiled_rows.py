"""What compiled kernels of several modules do with a row."""

from freqgs_plugin.functional.numba_threads import njit


@njit(fastmath={"reassoc"}, error_model="numpy", cache=True, nogil=True)
def row_sum(line):
    """Sum in float64, in the order that vectors take: fast, and the same bits on each call."""
    total = 0.0
    for i in range(line.size):
        total += line[i]
    return total
