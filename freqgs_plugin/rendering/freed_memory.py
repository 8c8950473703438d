"""The C library's allocator, told to keep the memory that pictures leave behind."""

import ctypes
import os
import sys

# of glibc's malloc.h
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST = 256 * 2**20
"""bytes; larger blocks come from the system and go back to it"""
_KEPT = 512 * 2**20
"""bytes at the end of the heap that are kept"""
_SETTINGS = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


def keep_freed_memory() -> bool:
    """Have glibc keep freed blocks of up to 256 MiB for the next picture. Returns whether it does.

    As it is, glibc gives pictures of a few megabytes back to the system, and the next one is faulted in page by page:
    a third of the time of five 400x300 px prefixes. Environment variables that set the allocator win. Other C libraries
    are left as they are.
    """
    if not sys.platform.startswith("linux") or any(name in os.environ for name in _SETTINGS):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST)) and bool(mallopt(_M_TRIM_THRESHOLD, _KEPT))
