"""What `freqgs export` and `freqgs import` can be told. Imports nothing heavy: the command line reads it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True)
class ExportOptions:
    """What is written of which run, how, and where to."""

    load_config: Path | None = None
    """config.yml of a trained run"""
    format: str = "ply"
    """ply: one file for any 3DGS viewer; levels: a PLY for each prefix and for each level; spz: Niantic's compressed
    format, through splat-transform; stream: a folder for `freqgs serve`, shown as it arrives; html: one file with the
    page and the scene in it"""
    output_dir: Path = Path("exports")
    """folder for splat.ply, levels/, splat.spz, stream/ or scene.html, each with a JSON that says what was lost"""
    variant: Literal["exact", "fine", "balanced", "small"] = "balanced"
    """stream and html: float32 bit for bit, or quantised; the documentation has bytes and errors"""
    overwrite: bool = False
    """replace what an earlier export wrote there"""
    level: int | None = None
    """levels up to this one; without it all"""
    distance: float | None = None
    """clodsplat: opacities as seen from this normalised distance; without it the run's export-distance"""
    detail: float = 1.0
    """clodsplat: s_v, as if seen from so many times that distance"""
    frame: Literal["scene", "dataset"] = "scene"
    """coordinates: nerfstudio's scene, as ns-export writes them, or those of the data set (COLMAP's)"""
    crop: tuple[float, float, float, float, float, float] | None = None
    """box of centres that are kept, in the scene's coordinates: least x y z, then greatest x y z"""
    extra: tuple[Literal["level", "decay"], ...] = ()
    """further properties of the PLY. With decay, opacities are stored as they are trained, not as seen from afar"""
    bake: bool = False
    """optimise plain Gaussians against our own pictures: needed for signed residuals"""
    bake_steps: int = 400
    """steps of that; 0: convert colours only"""
    viewer: Literal["mip", "classic"] | None = None
    """whom to bake for: viewers that heed SplatRenderMode: mip, or others; without it as the run is trained"""
    sog: bool = True
    """levels: run splat-transform where it is installed (minutes for a large scene); off: only print its command"""
    seed: int = 0
    """of baking's cameras"""
    rasterizer: str = "auto"
    """torch, numba, gsplat or auto"""
    docs: Path | None = None
    """Markdown page to fill: the place `export METHOD EXPERIMENT FORMAT` (then `baked`, then the viewer)"""


@dataclass(frozen=True)
class ImportOptions:
    """Which file becomes a run, and where."""

    path: Positional[Path]
    """splat.ply or splat.spz, or a folder `levels` that freqgs export wrote; other 3DGS PLYs do, too"""
    data: Path | None = None
    """the scene's photographs, as ns-train takes them; without it those that the export names"""
    output_dir: Path = Path("outputs")
    """the run is written to OUTPUT_DIR/EXPERIMENT/METHOD/import-TIME"""
    experiment_name: str | None = None
    """without it the data folder's name"""
    method: Literal["lapsplat", "clodsplat"] | None = None
    """without it clodsplat for Gaussians with decay, else lapsplat"""
    frame: Literal["scene", "dataset"] | None = None
    """coordinates of a file without its JSON: nerfstudio's scene (as without this), or the data set's"""
    dataparser: str | None = None
    """colmap, nerfstudio-data ...; without it that of the export, or by what the data folder holds"""
