"""What the views of a scene are called."""

import os
from collections.abc import Sequence
from pathlib import Path


def view_names(files: Sequence[Path | str]) -> list[str]:
    """The names of all photographs of a scene: frames that are drawn, masks and --focus are called after them.

    Where two files have the same name but for their endings, as of two cameras with a folder each, all names begin with
    their folders: `left_001.png`. Where only endings differ, they are part of the name: `001_jpg.jpg`.
    """
    paths = [Path(file) for file in files]
    stems = [(path.stem,) for path in paths]
    if _differ(stems, paths):
        return [path.name for path in paths]
    common = os.path.commonpath([path.parent for path in paths])
    stems = [path.relative_to(common).with_suffix("").parts for path in paths]
    if not _differ(stems, paths):
        stems = [(*parts, path.suffix.removeprefix(".")) for parts, path in zip(stems, paths, strict=True)]
    return ["_".join(parts) + path.suffix for parts, path in zip(stems, paths, strict=True)]


def _differ(stems: Sequence[tuple[str, ...]], paths: Sequence[Path]) -> bool:
    """A view that is both trained on and held out is one view."""
    return len({"_".join(parts) for parts in stems}) == len(set(paths))
