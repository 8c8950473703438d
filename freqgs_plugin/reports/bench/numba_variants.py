"""The numba rasterizer with other constants, in a process of its own: its kernels have constants compiled in.

The process has a cache folder of its own, because numba's cache does not see that a constant changed. It compiles what
one picture without depth needs, then answers lines on its standard input: `forward` and `both` with a time in ms,
`save PATH` with the picture and gradients as a file.

Run as `python -m freqgs_plugin.reports.bench.numba_variants WORKLOAD THREADS JSON`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from freqgs_plugin.reports.bench.options import BenchError


@dataclass(frozen=True)
class NumbaConstants:
    """What the kernels are compiled with; None: as they are."""

    alpha_min: float | None = None
    stop: float | None = None
    exact_exponential: bool = False
    """the C library's exponential instead of the polynomial"""
    tile: int | None = None
    """side, px; 8 or 16"""


class NumbaVariant:
    """A process with one variant, for a block. Workloads travel as files, so that a trained view can be one."""

    def __init__(self, workload_file: Path, threads: int, chosen: NumbaConstants):
        self._chosen = chosen
        self._arguments = [str(workload_file), str(threads), json.dumps(asdict(chosen))]

    def __enter__(self) -> "NumbaVariant":
        self._folder = tempfile.TemporaryDirectory(prefix="freqgs-bench-")
        self._errors = (Path(self._folder.name) / "stderr").open("w+")
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *self._arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | ({} if self._chosen == NumbaConstants() else {"NUMBA_CACHE_DIR": self._folder.name}),
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            assert stream is not None
            stream.close()
        self._folder.cleanup()

    def begin(self, line: str) -> None:
        """Send a line, to be answered in `finish`."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # finish tells why
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()

    def finish(self) -> float:
        """The answer to the line: milliseconds.

        Raises:
            BenchError: the process ended; the message holds the end of its errors.
        """
        assert self._process.stdout is not None
        answer = self._process.stdout.readline()
        if not answer:
            self._process.wait()
            self._errors.seek(0)
            raise BenchError(f"a variant of the numba kernels failed: {self._errors.read()[-2000:]}")
        return float(answer)

    def milliseconds(self, way: str) -> float:
        """Duration of one `forward` or `both`."""
        self.begin(way)
        return self.finish()

    def result(self) -> tuple[Any, Any]:
        """Picture and gradients."""
        import torch

        path = Path(self._folder.name) / "result.pt"
        self.milliseconds(f"save {path}")
        stored = torch.load(path, weights_only=True)
        return stored["picture"], stored["gradients"]


def prepare(chosen: NumbaConstants) -> None:
    """Set the constants; nothing that uses them may have been imported or compiled before."""
    from freqgs_plugin.rendering import base

    if chosen.alpha_min is not None:
        base.ALPHA_MIN = chosen.alpha_min
    if chosen.stop is not None:
        base.TRANSMITTANCE_MIN = chosen.stop
    if chosen.tile is not None:
        from freqgs_plugin.rendering import numba_binning

        numba_binning.TILE = chosen.tile
    if chosen.exact_exponential:
        from freqgs_plugin.rendering import numba_compositing

        numba_compositing._alpha = _exact_alpha()


def _exact_alpha() -> Any:
    """`numba_compositing._alpha` with the exponential of the C library."""
    import numpy as np
    from llvmlite import ir
    from numba.core import cgutils

    from freqgs_plugin.functional.numba_lanes import LANES, intrinsic, lanes, lanes_type, minimum, select
    from freqgs_plugin.functional.numba_threads import njit
    from freqgs_plugin.rendering.base import ALPHA_MAX, ALPHA_MIN

    f4 = np.float32
    zero, most, least, scale = f4(0), f4(ALPHA_MAX), f4(ALPHA_MIN), f4(16)

    @intrinsic
    def exponential(typingctx, x):
        def build(context, builder, sig, args):
            vector = ir.VectorType(ir.FloatType(), LANES)
            kind = ir.FunctionType(vector, [vector])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.exp.v{LANES}f32"), args)

        return lanes_type(lanes_type), build

    @njit(error_model="numpy", inline="always")
    def alpha(u, v2, opacity):
        """u and v2 are scaled by 1/4 and 1/16."""
        value = minimum(exponential((lanes(zero) - u * u - v2) * scale) * opacity, lanes(most))
        return select(value >= least, value, lanes(zero))

    return alpha


def serve(workload_file: str, threads: str, chosen: str) -> None:
    """Answer lines until the input ends."""
    prepare(NumbaConstants(**json.loads(chosen)))
    import torch

    from freqgs_plugin.rendering.numba_backend import NumbaRasterizer
    from freqgs_plugin.reports.bench.runner import use_threads
    from freqgs_plugin.reports.bench.workloads import draw, draw_and_differentiate, load_workload

    of = load_workload(Path(workload_file))
    # without warming up, which compiles the kernels of several prefixes too
    rasterizer = object.__new__(NumbaRasterizer)
    rasterizer.absgrad = False
    with use_threads(int(threads)):
        for line in sys.stdin:
            way, _, path = line.strip().partition(" ")
            start = time.perf_counter()
            if way == "forward":
                draw(rasterizer, of)
            else:
                picture, gradients = draw_and_differentiate(rasterizer, of)
                if way == "save":
                    torch.save({"picture": picture, "gradients": gradients}, path)
            print(1000 * (time.perf_counter() - start), flush=True)


if __name__ == "__main__":
    serve(*sys.argv[1:])
