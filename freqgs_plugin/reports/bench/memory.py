"""Peak memory of one rendering, in a process of its own: nothing else has touched its memory.

Run as `python -m freqgs_plugin.reports.bench.memory WORKLOAD BACKEND DEVICE THREADS QUICK`; prints one line of JSON.
"""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

_RESET, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
TIMEOUT = 300
"""seconds"""


def peak_memory(
    workload: str, backend: str, device: str, threads: int, quick: bool
) -> dict[str, float] | dict[str, str]:
    """`forward` and `forward_backward`, MiB above what the process held before; or `error`, why there is no number."""
    arguments = [workload, backend, device, str(threads), str(int(quick))]
    command = [sys.executable, "-m", __name__, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return {"error": f"over {TIMEOUT} s"}
    if done.returncode:
        return {"error": (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]}
    return json.loads(done.stdout.strip().splitlines()[-1])


def peak_mib(function: Callable[[], object], device: str = "cpu") -> float:
    """Greatest memory that `function` adds, MiB: resident memory by Linux's own high-water mark, or CUDA's allocator.

    Raises:
        OSError: the system keeps no such mark.
    """
    import torch

    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        function()
        torch.cuda.synchronize()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    _RESET.write_text("5")  # sets the high-water mark to what is resident now
    before = _resident_mib("VmRSS")
    function()
    return max(_resident_mib("VmHWM") - before, 0.0)


def _resident_mib(field: str) -> float:
    for line in _STATUS.read_text().splitlines():
        if line.startswith(field + ":"):
            return float(line.split()[1]) / 1024
    raise OSError(f"{_STATUS} has no {field}")


def main(workload_name: str, backend: str, device: str, threads: str, quick: str) -> None:
    from freqgs_plugin.rendering.base import get_rasterizer
    from freqgs_plugin.reports.bench.runner import use_threads
    from freqgs_plugin.reports.bench.workloads import draw, draw_and_differentiate, random_workload, workload

    with use_threads(int(threads)):
        rasterizer = get_rasterizer(backend, device, absgrad=False)
        draw_and_differentiate(rasterizer, random_workload("warm up", 500, 64, 48, (0.01, 0.08)).to(device))
        of = workload(workload_name, bool(int(quick))).to(device)
        forward = peak_mib(lambda: draw(rasterizer, of), device)
        both = peak_mib(lambda: draw_and_differentiate(rasterizer, of), device)
    print(json.dumps({"forward": forward, "forward_backward": both}))


if __name__ == "__main__":
    main(*sys.argv[1:])
