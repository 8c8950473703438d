"""What `freqgs render` can be told. Imports nothing heavy: the command line reads it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


class CommandError(RuntimeError):
    """A command that cannot be done as asked; the message holds the remedy."""


@dataclass(frozen=True)
class RenderOptions:
    """What is drawn, from where, and into which folder."""

    load_config: Path | None = None
    """config.yml of a trained run"""
    ply: Path | None = None
    """3DGS PLY, drawn instead of the run's Gaussians; alone it needs --path"""
    output_dir: Path = Path("renders")
    """folder for PNG frames, frames.json and video.mp4; a second start draws what is missing"""
    path: Path | None = None
    """camera path that the viewer's Render tab saved; without it the views of --split are drawn"""
    split: Literal["test", "train"] = "test"
    """views of the data set: held out, or trained on"""
    size: tuple[int, int] | None = None
    """width and height, pixels; without it the views' own"""
    level: float | None = None
    """levels up to this one; a fraction fades the next one in"""
    detail: float | None = None
    """s_v, for scenes with decay: as if seen from so many times as far"""
    budget: str | None = None
    """at most so much per view: Gaussians (20k), memory (5MB) or time (16ms, measured here first)"""
    gaze: str | None = None
    """full detail where one looks: x,y (shares of the image), a file with a line per frame, or auto (most salient)"""
    gaze_radius: float = 0.1
    """of the disc without loss, share of the longer side"""
    gaze_sigma: float = 0.1
    """how fast detail falls off beyond, share of the longer side"""
    gaze_scale: int | None = None
    """how many times smaller the picture outside of the fovea is drawn, and enlarged; 1: at full size; without it the
    most of 4, 2 and 1 that leaves it 960 px on the longer side"""
    focus: str | None = None
    """all levels for one object: a folder of masks, VIEW:left,top,right,bottom or VIEW:x,y (pixels, grown by GrabCut),
    or text:PROMPT (needs the extra `prompt`)"""
    focus_outside: int = 1
    """levels that are drawn outside of the object; 0: the object alone"""
    segmenter_weights: Path | None = None
    """folder with CLIPSeg's weights for --focus text:...; without it the Hugging Face cache"""
    filter: str = "none"
    """artistic filter by level: xray, brush, sharp, or one of your own as FILE.py:FUNCTION"""
    video: Literal["paths", "always", "never"] = "paths"
    """when to write video.mp4 as well: of camera paths, always or never"""
    fps: float | None = None
    """of the video, frames per second; without it the path's, or 24"""
    rasterizer: str = "auto"
    """torch, numba, gsplat or auto"""


@dataclass(frozen=True)
class FilterOptions:
    """Whose filters are shown, from where, and in which file."""

    load_config: Path
    """config.yml of a trained run"""
    output: Path = Path("filters.png")
    """the sheet: a row per view, a column per filter"""
    views: int = 3
    """how many views, spread evenly over those held out (over all, where these are too few)"""
    filters: tuple[str, ...] = ("xray", "brush", "sharp")
    """names, or FILE.py:FUNCTION for a filter of your own"""
