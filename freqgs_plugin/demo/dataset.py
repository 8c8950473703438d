"""Writes the demo scene as a COLMAP folder: images/, sparse/0 and a manifest that marks the folder as ours."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from freqgs_plugin.demo.raytrace import World, depth_map, render_truth, unproject
from freqgs_plugin.demo.scene import build_world, orbit
from freqgs_plugin.demo.vectors import transform
from freqgs_plugin.io.check_images import SceneError
from freqgs_plugin.io.colmap import Points, write_colmap
from freqgs_plugin.io.images import to_uint8, write_image
from freqgs_plugin.types import Camera

MANIFEST = "freqgs-demo.json"


@dataclass(frozen=True)
class SceneOptions:
    """What the scene on disk depends on; the same options give the same files."""

    num_views: int = 36
    width: int = 320
    """pixels"""
    height: int = 240
    """pixels"""
    num_points: int = 4000
    """seed points in points3D.bin"""
    samples: int = 3
    """side of the grid of rays in a pixel"""
    seed: int = 0


def write_scene(folder: Path, options: SceneOptions | None = None, *, progress: bool = True) -> None:
    """Ray-trace the demo scene into `folder`. A scene of ours that lies there already is replaced.

    The model in sparse/0 comes last, so a folder left half-written is not mistaken for a scene.

    Raises:
        SceneError: fewer than two views, or a size of zero.
        FileExistsError: the folder holds something that this function did not write.
    """
    options = options or SceneOptions()
    if options.num_views < 2 or min(options.width, options.height, options.samples, options.num_points) < 1:
        raise SceneError(f"a scene needs at least two views, one pixel, one ray and one seed point, not {options}")
    _claim(folder, options)
    world, cameras = build_world(options.seed), orbit(options.num_views, options.width, options.height, options.seed)
    names = [f"view_{i:03d}.png" for i in range(len(cameras))]
    (folder / "images").mkdir()

    def render(i: int) -> Float[np.ndarray, "h w 3"]:
        image = render_truth(world, cameras[i], options.samples)
        write_image(folder / "images" / names[i], image)
        return image

    with _progress_bar("ray-tracing the scene", len(cameras), progress) as advance, ThreadPoolExecutor(2) as threads:
        images = []
        for image in threads.map(render, range(len(cameras))):
            images.append(image)
            advance()
    points = seed_points(world, cameras, images, options.num_points, options.seed)
    write_colmap(folder / "sparse" / "0", cameras, names, points)


def _claim(folder: Path, options: SceneOptions) -> None:
    """Empty `folder` of an earlier scene of ours and mark it; refuse anything else that lies there."""
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; name a folder for the demo scene")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / MANIFEST).is_file():
            raise FileExistsError(
                f"{folder} is not empty and was not written by freqgs demo (it has no {MANIFEST}). "
                "Nothing was changed. Name another folder, or remove this one first."
            )
        ours = (folder / "sparse" / "0", folder / "sparse", folder / "images")
        for part in ours:
            for file in part.glob("*.bin") if part.name == "0" else part.glob("view_*.png"):
                file.unlink()
            if part.is_dir() and not any(part.iterdir()):
                part.rmdir()
        left = [str(p) for p in ours if p.exists()]
        if left:
            raise FileExistsError(f"{', '.join(left)} also holds files that freqgs demo did not write. Move them away.")
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"written_by": "freqgs demo", **asdict(options)}, indent=2)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


@contextmanager
def _progress_bar(title: str, total: int, shown: bool) -> Iterator[Callable[[], None]]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, disable=not shown) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)


def project(
    camera: Camera, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Pixel positions and camera z of world points; positions are meaningless where z <= 0."""
    viewmat, intrinsics = camera.viewmat.cpu().double().numpy(), camera.K.cpu().double().numpy()
    local = transform(viewmat[:3, :3], points) + viewmat[:3, 3]
    z = local[:, 2]
    image = transform(intrinsics, local)
    return image[:, :2] / np.where(z > 0, z, 1)[:, None], z


def seed_points(
    world: World, cameras: list[Camera], images: list[Float[np.ndarray, "h w 3"]], count: int, seed: int = 0
) -> Points:
    """Points like a structure-from-motion tool would give: on visible surfaces, mostly where there is texture, noisy.

    Each has the colour of the picture it was drawn from, a position error of half a pixel seen from there, and an
    observation in every view that sees it; points seen by one view only are left out, so fewer than `count` may
    remain.
    """
    rng = np.random.default_rng(seed + 200)
    depths = [depth_map(world, camera) for camera in cameras]
    share = np.bincount(np.arange(2 * count) % len(cameras), minlength=len(cameras))
    drawn = [_draw(c, i, d, int(n), rng) for c, i, d, n in zip(cameras, images, depths, share, strict=True)]
    xyz, rgb = np.concatenate([x for x, _ in drawn]), np.concatenate([c for _, c in drawn])
    chosen = rng.permutation(len(xyz))
    xyz, rgb = xyz[chosen], rgb[chosen]
    positions = [project(camera, xyz) for camera in cameras]
    seen = np.stack([_visible(xy, z, d) for (xy, z), d in zip(positions, depths, strict=True)], axis=1)
    keep = np.flatnonzero(seen.sum(1) >= 2)[:count]
    point, view = np.nonzero(seen[keep])
    xy = np.stack([xy for xy, _ in positions], axis=1)[keep][point, view]
    return Points(xyz[keep], rgb[keep], point, view, xy + rng.normal(0, 0.3, xy.shape))


def _draw(
    camera: Camera,
    image: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    count: int,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """World positions and 8-bit colours of random pixels, likelier where the picture changes."""
    grey = image.mean(2)
    slope = np.hypot(*np.gradient(grey)) if min(grey.shape) > 1 else np.zeros_like(grey)
    weight = np.minimum(slope, 0.1) + 0.02
    pixel = rng.choice(weight.size, size=count, p=(weight / weight.sum()).ravel())
    y, x = np.divmod(pixel, image.shape[1])
    z = depth[y, x].astype(np.float64)
    viewmat, intrinsics = camera.viewmat.cpu().double().numpy(), camera.K.cpu().double().numpy()
    local = unproject(intrinsics, x + 0.5, y + 0.5) * z[:, None]
    local += rng.normal(0, 0.5, local.shape) * (z / intrinsics[0, 0])[:, None]
    return transform(viewmat[:3, :3].T, local - viewmat[:3, 3]), to_uint8(image)[y, x]


def _visible(
    xy: Float[np.ndarray, "n 2"], z: Float[np.ndarray, " n"], depth: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, " n"]:
    """In front of the camera, inside of the image and within 3 % of the depth seen there."""
    h, w = depth.shape
    inside = (z > 0) & (xy >= 0).all(1) & (xy[:, 0] < w) & (xy[:, 1] < h)
    column, row = np.where(inside[:, None], xy, 0).astype(np.int64).T
    return inside & (np.abs(z - depth[row, column]) < 0.03 * depth[row, column])
