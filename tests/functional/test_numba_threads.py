import os
import platform
import subprocess
import sys

import pytest

RENDER = """
from freqgs_plugin.rendering.numba_backend import NumbaRasterizer
import numba
NumbaRasterizer()
print(numba.threading_layer())
"""


def run(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, text=True, timeout=240
    )


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="tbb has no wheel for this processor")
def test_tbb_by_default():
    assert run(RENDER).stdout.split() == ["tbb"]


def test_an_old_tbb_in_the_process_leaves_a_thread_safe_layer():
    """open3d brings one, and nerfstudio's exporter imports open3d."""
    done = run("import open3d" + RENDER)
    assert done.stdout.split()[-1] in ("tbb", "omp"), done.stderr


def test_the_layer_that_aborts_is_refused():
    done = run(RENDER, NUMBA_THREADING_LAYER="workqueue")
    assert done.returncode != 0 and "pip install tbb" in done.stderr


def test_the_users_choice_wins():
    assert run(RENDER, NUMBA_THREADING_LAYER="omp").stdout.split() == ["omp"]
