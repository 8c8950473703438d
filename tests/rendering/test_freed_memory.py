"""Memory of pictures is kept for the next one, unless the environment says how the allocator is to behave."""

import json
import os
import platform
import subprocess
import sys

import pytest

CHILD = """
import json, resource, torch
from freqgs_plugin.rendering.freed_memory import keep_freed_memory
kept = keep_freed_memory()
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def pictures():
    return [torch.ones(3, 600, 800) for _ in range(10)]
pictures(), pictures()
before = faults()
for _ in range(10):
    pictures()
pages = 10 * 10 * 3 * 600 * 800 * 4 // resource.getpagesize()
print(json.dumps([kept, (faults() - before) / pages]))
"""


def faulted(**environment: str) -> tuple[bool, float]:
    """Whether memory is kept, and the share of pages that were faulted in anew."""
    command = [sys.executable, "-c", CHILD]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=True)
    kept, share = json.loads(done.stdout)
    return kept, share


def test_pictures_are_not_faulted_in_again():
    kept, share = faulted()
    assert kept == (platform.libc_ver()[0] == "glibc")
    assert share < 0.2 or not kept


@pytest.mark.parametrize("name", ["MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"])
def test_the_environment_wins(name: str):
    kept, share = faulted(**{name: "65536"})
    assert not kept and share > 0.5
