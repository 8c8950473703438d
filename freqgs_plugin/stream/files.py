"""Files that are written in one piece, and folders that are left as they were where that fails."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def folder_for(*files: Path) -> Iterator[None]:
    """Makes the files' folder. Where what follows fails, files and folders that were not there before are removed."""
    folder = files[0].parent
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    new = [path for path in files if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for path in new:
            path.unlink(missing_ok=True)
        for path in missing:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()
        raise
