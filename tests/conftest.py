"""Fixtures that all tests share. A skip names a missing device, folder or browser, never a missing dependency."""

import os
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# a slow machine is no failure
settings.register_profile("freqgs", deadline=None)
settings.load_profile("freqgs")

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent / "rendering")]

PRECISIONS = {torch.float32: (1e-4, 1e-5), torch.float64: (1e-9, 1e-11)}
"""(relative, absolute) tolerance per dtype, for quantities of order one"""


@pytest.fixture
def assert_close():
    """`assert_close(actual, expected, loosen=1)`: tolerances from the table, by the less precise dtype."""

    def check(actual, expected, loosen=1.0, message=""):
        rtol, atol = PRECISIONS[actual.dtype]
        assert torch.isfinite(actual).all(), f"{message}: not finite"
        torch.testing.assert_close(
            actual.double(),
            expected.double(),
            rtol=rtol * loosen,
            atol=atol * loosen,
            msg=lambda text: f"{message}: {text}",
        )

    return check


@pytest.fixture(scope="session")
def scenes_folder():
    """Folder with real scenes, from the environment variable FREQGS_SCENES."""
    if "FREQGS_SCENES" not in os.environ:
        pytest.skip("FREQGS_SCENES is not set: name the folder that holds the real scenes")
    return Path(os.environ["FREQGS_SCENES"])


LONGEST = ("test_viewer.py", "test_commands.py", "test_export_command.py", "test_trim_command.py", "test_clodsplat.py")
"""files that take minutes: begun first, so that no process is left alone with one of them"""


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("cuda"):
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))
