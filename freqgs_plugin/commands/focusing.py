"""`--focus` of `freqgs render`: from masks, a box, a point or a text to the Gaussians of an object."""

import re
from pathlib import Path
from typing import Any

from freqgs_plugin.apps.focus import Focus, Selection, vote, vote_in_folder
from freqgs_plugin.apps.grabcut import mask_from_box, mask_from_point
from freqgs_plugin.apps.propagate import propagate
from freqgs_plugin.apps.segmenters import MissingWeightsError, SegmenterError, get_segmenter, prompt_masks
from freqgs_plugin.commands.scene import Scene
from freqgs_plugin.reports.bench.trained import views_of_split

TEXT = "text:"


def focus_on(scene: Scene, text: str, outside_level: int, weights: Path | None) -> tuple[Focus, Selection]:
    """The focus that `text` describes: a folder of masks, `VIEW:left,top,right,bottom`, `VIEW:x,y` or `text:PROMPT`.

    Masks are matched to all views of the run; a box, a point and a text are looked for in those trained on.

    Raises:
        ValueError (MaskError among them): another form, no run, no such view, or nothing found.
        SegmenterError: no segmenter for a text.
    """
    if scene.run is None:
        raise ValueError("--focus needs the photographs of a run: give --load-config.")
    drawing = {"rasterizer": scene.rasterizer, "antialiased": scene.antialiased}
    views = views_of_split(scene.run, "train")
    if text.startswith(TEXT):
        prompt = text.removeprefix(TEXT).strip()
        if not prompt:
            raise ValueError(f"--focus {text} names nothing; say what to look for, as in {TEXT}the red ball.")
        try:
            segmenter = get_segmenter("clipseg", **({} if weights is None else {"weights": weights}))
        except MissingWeightsError as error:
            raise SegmenterError(
                f"{error.what} Name a folder with a saved model with --segmenter-weights; nothing is downloaded."
            ) from error
        masks = prompt_masks(segmenter, [view.image for view in views], prompt)
        found = vote(scene.gaussians, [view.camera for view in views], masks, **drawing)
        return Focus(found.rows, outside_level), found
    marked = re.fullmatch(r"(.+):(\d+(?:,\d+){1,3})", text)
    if marked is None:
        views = [*views, *views_of_split(scene.run, "test")]
        names, cameras = [view.name for view in views], [view.camera for view in views]
        found = vote_in_folder(scene.gaussians, names, cameras, Path(text), **drawing)
        return Focus(found.rows, outside_level), found
    found = _from_one_view(scene, views, marked[1], [int(n) for n in marked[2].split(",")], drawing)
    return Focus(found.rows, outside_level), found


def _from_one_view(scene: Scene, views: list[Any], name: str, numbers: list[int], drawing: dict[str, Any]) -> Selection:
    names = [view.name for view in views]
    first = next((i for i, known in enumerate(names) if name in (known, Path(known).stem)), None)
    if first is None:
        known = ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")
        raise ValueError(f"--focus names the view '{name}'; those trained on are {known}.")
    image = views[first].image
    if len(numbers) == 4:
        mask = mask_from_box(image, (numbers[0], numbers[1], numbers[2], numbers[3]))
    elif len(numbers) == 2:
        mask = mask_from_point(image, (numbers[0], numbers[1]))
    else:
        raise ValueError(
            f"--focus has {len(numbers)} numbers; a point has two (x,y), a box four (left,top,right,bottom)."
        )
    cameras, images = [view.camera for view in views], [view.image for view in views]
    return propagate(scene.gaussians, cameras, images, first, mask, **drawing)[0]
