"""`freqgs render`: pictures of a trained scene at any level of detail, as PNG files and MP4."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from freqgs_plugin.apps.amount import Amount, parse_amount
from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.apps.gaze import Point, gaze_points, salient_point
from freqgs_plugin.apps.own_filters import filter_file, find_filter
from freqgs_plugin.apps.rescaled import check_times, render_rescaled, suitable
from freqgs_plugin.apps.segmenters import SegmenterError
from freqgs_plugin.commands.focusing import focus_on
from freqgs_plugin.commands.frames import LONGEST, FrameFolder, FrameRecord, check_rate, write_video
from freqgs_plugin.commands.options import CommandError, RenderOptions
from freqgs_plugin.commands.scene import Scene, Shot, check_size, open_scene, shots
from freqgs_plugin.functional.attenuation import Attenuation, DistanceDecay, LevelCut, Product
from freqgs_plugin.functional.budget import DecayBudget, LevelBudget, in_view
from freqgs_plugin.functional.cost import RenderTime, calibrate
from freqgs_plugin.rendering.render import render
from freqgs_plugin.reports.bench.runner import check_folder
from freqgs_plugin.types import Camera, Gaussians, Rendering

if TYPE_CHECKING:
    from rich.console import Console

VIDEO = "video.mp4"


@dataclass(frozen=True)
class Look:
    """How a scene is drawn, but for the gaze."""

    gaussians: Gaussians
    attenuation: Attenuation | None


def run_render(options: RenderOptions, console: "Console") -> None:
    """Draw all frames that the folder lacks, and print what each costs.

    Raises:
        CommandError: options that contradict each other or the scene.
        OSError: inputs that are not there, or an output folder that cannot be used.
        KeyboardInterrupt: passed on, after a message.
    """
    try:
        amount = _check(options)
        check_folder(options.output_dir)
        scene = open_scene(options.load_config, options.ply, options.rasterizer)
        shot = shots(scene, options.path, options.split, options.size)
        gazes = _gazes(options, len(shot.cameras))
        rate = _rate(options, shot)
        _check_level(options, scene)
        files = [f"{name}.png" for name in shot.names] + [VIDEO] * (rate is not None)
        folder = FrameFolder(options.output_dir, _settings(options), files)
        look = _look(options, amount, scene, shot, folder, console)
    except (ValueError, SegmenterError) as error:
        raise CommandError(str(error)) from error
    try:
        _draw_all(options, scene, shot, gazes, look, folder, console)
        if rate is not None:
            path = options.output_dir / VIDEO
            write_video(path, [folder.path(name) for name in shot.names], rate)
            console.print(str(path), soft_wrap=True, highlight=False, markup=False)
    except MemoryError as error:
        width, height = max(((c.width, c.height) for c in shot.cameras), key=lambda size: size[0] * size[1])
        raise CommandError(f"{width}x{height} px do not fit into memory; give a smaller --size.") from error
    except ValueError as error:
        raise CommandError(str(error)) from error
    except KeyboardInterrupt:
        console.print("Stopped. The same command draws what is missing.")
        raise


def _check(options: RenderOptions) -> Amount | None:
    """Refuse what makes no sense for any scene, before one is loaded; the budget."""
    if options.level is not None:
        LevelCut(options.level)
    if options.detail is not None and not 0 < options.detail < float("inf"):
        raise ValueError(f"--detail {options.detail:g}: give a number above 0 (1 is the scene as it is trained).")
    if options.size is not None:
        check_size(*options.size)
    if options.fps is not None:
        check_rate(options.fps)
    _check_pairs(options)
    if options.gaze is not None:
        Foveation((0.5, 0.5), options.gaze_sigma, options.gaze_radius)
        if options.gaze_scale is not None:
            check_times(options.gaze_scale)
        if not Path(options.gaze).is_file():
            gaze_points(options.gaze, 1)
    if options.focus_outside < 0:
        raise ValueError(f"--focus-outside is {options.focus_outside}; give 0 (the object alone) or a level.")
    if options.filter != "none":
        find_filter(options.filter)
    return None if options.budget is None else parse_amount(options.budget)


def _check_pairs(options: RenderOptions) -> None:
    """Refuse what would do nothing without another option."""
    if options.path is not None and options.split != RenderOptions.split:
        raise ValueError(f"--split {options.split} does nothing with --path, whose views are drawn; leave one out.")
    pairs = {"gaze": ("gaze_scale", "gaze_sigma", "gaze_radius"), "focus": ("focus_outside", "segmenter_weights")}
    for needed, names in pairs.items():
        for name in names if getattr(options, needed) is None else ():
            if getattr(options, name) != getattr(RenderOptions, name):
                option = f"--{name.replace('_', '-')}"
                raise ValueError(f"{option} does nothing without --{needed}; give --{needed}, too, or leave it out.")


def _check_level(options: RenderOptions, scene: Scene) -> None:
    if options.detail is not None and scene.gaussians.decay is None:
        raise ValueError(f"--detail {options.detail:g}: this scene has no decay; use --level, or train clodsplat.")
    levels = int(scene.gaussians.level.max()) if len(scene.gaussians) else 0
    if options.level is None or options.level <= levels:
        return
    if scene.gaussians.decay is not None:
        raise ValueError(f"--level {options.level:g}: this scene has no levels but a decay; use --detail.")
    has = "one level" if levels == 1 else f"{levels} levels"
    raise ValueError(f"--level {options.level:g}: this scene has {has}; give at most {levels}, or leave it out.")


def _gazes(options: RenderOptions, frames: int) -> list[Point | None]:
    return [None] * frames if options.gaze is None else gaze_points(options.gaze, frames)


def _rate(options: RenderOptions, shot: Shot) -> float | None:
    """Frames per second of the video; None without one."""
    rate = options.fps if options.fps is not None else (shot.fps or 24.0)
    if options.video == "never" or (options.video == "paths" and shot.fps is None):
        return None
    check_rate(rate)
    sizes = sorted({(camera.width, camera.height) for camera in shot.cameras})
    if len(sizes) > 1:
        found = ", ".join(f"{w}x{h}" for w, h in sizes[:3])
        raise ValueError(f"a video has one size, and the views have {len(sizes)} ({found} px ...); give --size.")
    if max(sizes[0]) > LONGEST:
        raise ValueError(
            f"{sizes[0][0]}x{sizes[0][1]} px are too many for a video, whose sides have at most {LONGEST:,}; give a "
            "smaller --size, or --video never."
        )
    return rate


def _settings(options: RenderOptions) -> dict[str, Any]:
    """What decides about pictures."""
    left_out = ("output_dir", "video", "fps")
    chosen = {f.name: getattr(options, f.name) for f in fields(options) if f.name not in left_out}
    files = [options.load_config, options.ply, options.path, filter_file(options.filter)]
    if options.load_config is not None:
        files += sorted((options.load_config.parent / "nerfstudio_models").glob("step-*.ckpt"))[-1:]
    if options.focus is not None and Path(options.focus).is_dir():
        files += sorted(Path(options.focus).glob("*.png"))
    chosen["files"] = [p.stat().st_mtime for p in files if p is not None and p.is_file()]
    if options.gaze is not None and Path(options.gaze).is_file():
        chosen["gaze"] = Path(options.gaze).read_text(encoding="utf-8")
    return {key: str(value) if isinstance(value, Path) else value for key, value in chosen.items()}


def _look(
    options: RenderOptions, amount: Amount | None, scene: Scene, shot: Shot, folder: FrameFolder, console: "Console"
) -> Look:
    gaussians = scene.gaussians if options.filter == "none" else find_filter(options.filter)(scene.gaussians)
    parts: list[Attenuation] = []
    if options.focus is not None:
        shown = replace(scene, gaussians=gaussians)
        focus, found = focus_on(shown, options.focus, options.focus_outside, options.segmenter_weights)
        console.print(f"focus on {found.count:,} of {len(gaussians):,} Gaussians")
        parts.append(focus)
    if options.level is not None:
        parts.append(LevelCut(options.level))
    decays = gaussians.decay is not None
    if amount is not None and folder.budget is not None:
        console.print(f"{_allowed(amount, folder.budget, gaussians)}, as in the frames that are there", soft_wrap=True)
    elif amount is not None:
        # a time is measured, and would come out otherwise for the frames that a second start draws
        folder.budget = _count(amount, replace(scene, gaussians=gaussians), shot, console)
    count = None if amount is None else folder.budget
    if decays:
        parts.append(_decay(scene, options.detail, count))
    elif count is not None:
        parts.append(LevelBudget(count))
    if not parts:
        return Look(gaussians, None)
    return Look(gaussians, parts[0] if len(parts) == 1 else Product(tuple(parts)))


def _decay(scene: Scene, detail: float | None, count: int | None) -> Attenuation:
    reference = "frustum_max" if scene.scene_distance is None else "scene"
    least = 1.0 if detail is None else detail
    if count is not None:
        return DecayBudget(count, reference, scene.scene_distance, least=least, largest=scene.largest_scale)
    return DistanceDecay(least, reference, scene.scene_distance)


def _count(amount: Amount, scene: Scene, shot: Shot, console: "Console") -> int:
    """Gaussians that a budget allows; says so where that is less than the base, and what a time was measured as."""
    g, camera = scene.gaussians, shot.cameras[0]

    def measure() -> RenderTime:
        found = calibrate(_measured(scene, camera), max(int(in_view(g, camera).sum()), 16))
        console.print(f"measured here: {found}", soft_wrap=True)
        return found

    degree = round((g.features_rest.shape[1] + 1) ** 0.5) - 1
    count = amount.count(degree, g.decay is not None, camera.width * camera.height, measure)
    console.print(_allowed(amount, count, g), soft_wrap=True)
    base = int((in_view(g, camera) & (g.level == 1)).sum())
    if count < base and int(g.level.max()) > 1:
        console.print(f"[yellow]The base alone has {base:,} in the first view: it is drawn in part.", soft_wrap=True)
    return count


def _allowed(amount: Amount, count: int, gaussians: Gaussians) -> str:
    most = f"at most {count:,} Gaussians per view" if count < len(gaussians) else "enough for all Gaussians"
    return f"budget of {amount}: {most}"


def _measured(scene: Scene, camera: Camera) -> Callable[[int, float], tuple[int, int]]:
    """A picture of so many Gaussians, for `calibrate`."""

    def picture(count: int, _size: float) -> tuple[int, int]:
        rendering = _picture(scene, scene.gaussians, camera, LevelBudget(count))
        return int(rendering.info["drawn"]), camera.width * camera.height

    return picture


def _foveated(scene: Scene, look: Look, camera: Camera, fovea: Foveation, times: int) -> Rendering:
    drawing = {"rasterizer": scene.rasterizer, "background": scene.background, "antialiased": scene.antialiased}
    rendering = render_rescaled(look.gaussians, camera, fovea, look.attenuation, times=times, depth=False, **drawing)
    if rendering.features.is_cuda:
        torch.cuda.synchronize()
    return rendering


@torch.no_grad()
def _picture(scene: Scene, gaussians: Gaussians, camera: Camera, attenuation: Attenuation | None) -> Rendering:
    rendering = render(
        gaussians,
        camera,
        attenuation,
        rasterizer=scene.rasterizer,
        background=scene.background,
        antialiased=scene.antialiased,
        depth=False,
    )
    if rendering.features.is_cuda:
        torch.cuda.synchronize()
    return rendering


def _draw_all(
    options: RenderOptions, scene: Scene, shot: Shot, gazes: list[Point | None], look: Look, folder: FrameFolder,
    console: "Console",
) -> None:  # fmt: skip
    from rich.progress import track

    missing = [i for i, name in enumerate(shot.names) if name not in folder.records]
    if missing:
        # the first picture compiles
        _picture(scene, look.gaussians, shot.cameras[missing[0]], look.attenuation)
    for i in track(missing, "Drawing", console=console, disable=not console.is_terminal):
        camera, gaze, attenuation = shot.cameras[i], gazes[i], look.attenuation
        if options.gaze is not None and gaze is None:
            base = _picture(scene, look.gaussians, camera, LevelCut(1))
            gaze = salient_point(base.features.clamp(0, 1).cpu().numpy())
        start = time.perf_counter()
        if gaze is None:
            rendering = _picture(scene, look.gaussians, camera, attenuation)
        else:
            fovea = Foveation(gaze, options.gaze_sigma, options.gaze_radius)
            times = suitable(camera) if options.gaze_scale is None else options.gaze_scale
            rendering = _foveated(scene, look, camera, fovea, times)
        milliseconds = 1e3 * (time.perf_counter() - start)
        record = FrameRecord(shot.names[i], int(rendering.info["drawn"]), round(milliseconds, 2), gaze)
        folder.add(record, rendering.features.clamp(0, 1).cpu().numpy())
    _report(folder, shot, len(scene.gaussians), options.path is not None, console)


def _report(folder: FrameFolder, shot: Shot, total: int, along_path: bool, console: "Console") -> None:
    """A line per frame, or of many frames the range."""
    from rich.markup import escape
    from rich.table import Table

    records = [folder.records[name] for name in shot.names]
    empty = [r.name for r in records if r.drawn == 0]
    times, counts = sorted(r.milliseconds for r in records), sorted(r.drawn for r in records)
    table = Table(title=f"{len(records)} frames of {total:,} Gaussians")
    for heading in ("frame", "drawn", "ms"):
        table.add_column(heading, justify="right")
    if len(records) <= 20:
        for record in records:
            table.add_row(escape(record.name), f"{record.drawn:,}", f"{record.milliseconds:.1f}")
    for name, at in (("least", 0), ("median", len(records) // 2), ("most", -1)):
        table.add_row(name, f"{counts[at]:,}", f"{times[at]:.1f}")
    console.print(table)
    if empty:
        names = escape(", ".join(empty[:5])) + (" ..." if len(empty) > 5 else "")
        left = " The path may have left the scene." if along_path else ""
        console.print(f"[yellow]{len(empty)} frames draw no Gaussian: {names}.{left}")
