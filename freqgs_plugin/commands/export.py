"""`freqgs export`: a trained scene as files for others, each with what it loses against our own pictures."""

import os
import shlex
import time
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.commands.export_files import check_targets, put_in_place, staging, targets, write_manifest
from freqgs_plugin.commands.export_formats import FORMATS, Format, Work
from freqgs_plugin.commands.export_loss import Loss, Shown, Written
from freqgs_plugin.commands.export_options import ExportOptions
from freqgs_plugin.commands.export_source import Source, open_source
from freqgs_plugin.commands.options import CommandError
from freqgs_plugin.reports.bench.page import check_places, circumstances, fill, read_page
from freqgs_plugin.reports.bench.runner import write_all
from freqgs_plugin.reports.bench.tables import BenchTable, number
from freqgs_plugin.reports.timing import environment

if TYPE_CHECKING:
    from rich.console import Console

VERSION = 1
"""of the manifest"""


def run_export(options: ExportOptions, console: "Console") -> list[Path]:
    """Write all files of the format, or none, and print what each loses. Returns what was written, in place.

    Raises:
        CommandError: options that contradict each other or the scene.
        OSError: the run is not there, files exist already, or cannot be written.
    """
    try:
        return _export(options, console)
    except ValueError as error:
        raise CommandError(str(error)) from error


def _export(options: ExportOptions, console: "Console") -> list[Path]:
    if options.format not in FORMATS:
        raise ValueError(f"--format {options.format}: unknown. Choose one of: {', '.join(FORMATS)}.")
    chosen = FORMATS[options.format]
    _check_use(options)
    paths = targets(options.output_dir, chosen.name, "json")
    check_targets(paths, options.overwrite)
    source = open_source(options)
    chosen.check(source, options)
    place = _place(source, options)
    if options.docs is not None:
        page = read_page(options.docs)
        check_places(page, [place], options.docs)
    load, begun = _load(), time.perf_counter()
    with staging(options.output_dir) as folder:
        work = Work(folder, console)
        written = chosen.write(source, options, work)
        record = {**_record(options, source, load), "seconds": round(time.perf_counter() - begun, 1)}
        manifest = _manifest(chosen, written, work, source, options, record)
        beside = folder / f"{chosen.name}.json" if len(paths) > 1 else folder / chosen.name / chosen.manifest
        write_manifest(beside, manifest)
        table = _table(written, folder / chosen.name, source, options, place)
        put_in_place([folder / path.name for path in paths], paths)
    if options.docs is not None:
        text = "\n\n".join([f"*{table.title}.* {circumstances(record)}", table.markdown(), table.note]) + "\n"
        # another export may have filled its place meanwhile
        page = read_page(options.docs)
        check_places(page, [place], options.docs)
        write_all({options.docs: fill(page, place, text).encode()})
    _tell(table, source, paths, console)
    return paths


_OF_FORMATS = {"variant": ("stream", "html"), "sog": ("levels",)}
"""options and the formats that heed them"""


def _check_use(options: ExportOptions) -> None:
    """Refuse what would do nothing, and numbers that are none."""
    for name, formats in _OF_FORMATS.items():
        if getattr(options, name) != getattr(ExportOptions, name) and options.format not in formats:
            option = f"--variant {options.variant}" if name == "variant" else "--no-sog"
            raise ValueError(f"{option} does nothing with --format {options.format}, but with {', '.join(formats)}.")
    if options.distance is not None and not 0 <= options.distance < float("inf"):
        raise ValueError(f"--distance {options.distance:g}: give a number of 0 or more (1 is the scene's distance).")
    if not 0 < options.detail < float("inf"):
        raise ValueError(f"--detail {options.detail:g}: give a number above 0 (1 is as seen from --distance).")
    if options.crop is not None and not all(a < b for a, b in zip(options.crop[:3], options.crop[3:], strict=True)):
        given = " ".join(f"{x:g}" for x in options.crop)
        raise ValueError(f"--crop {given}: each least value must be under its greatest one.")
    if options.bake and "decay" in options.extra:
        raise ValueError("--extra decay stores opacities as they are trained, and --bake changes them; leave one out.")
    if options.bake_steps < 0:
        raise ValueError(f"--bake-steps {options.bake_steps}: give 0 (only convert colours) or more.")
    for name in ("bake_steps", "seed") if not options.bake else ():
        if getattr(options, name) != getattr(ExportOptions, name):
            option = f"--{name.replace('_', '-')} {getattr(options, name)}"
            raise ValueError(f"{option} does nothing without --bake; add --bake, or leave it out.")


def _place(source: Source, options: ExportOptions) -> str:
    """Name of the table's place in a page."""
    words = ["export", source.method, source.experiment, options.format, *["baked"] * options.bake]
    return " ".join([*words, *([] if options.viewer is None else [options.viewer])])


def _manifest(
    chosen: Format, written: list[Written], work: Work, source: Source, options: ExportOptions, record: dict[str, Any]
) -> dict[str, Any]:
    from freqgs_plugin.studio.origin import origin_of

    root = work.folder / chosen.name
    return {
        "format": f"freqgs {options.format}",
        "version": VERSION,
        "frame": options.frame,
        "files": {_name(item, root): item.json() for item in written},
        "left_out": source.left_out,
        "origin": origin_of(source.scene.run),
        **work.notes,
        "made": record,
    }


def _name(item: Written, root: Path) -> str:
    return item.path.name if item.path == root else item.path.relative_to(root).as_posix()


def _record(options: ExportOptions, source: Source, load: float | None) -> dict[str, Any]:
    """How and where it was made."""
    shown = ["freqgs", "export", "--load-config", f"{source.method}/{source.experiment}/config.yml"]
    for option in fields(options):
        value = getattr(options, option.name)
        if option.name in ("load_config", "output_dir", "docs", "overwrite") or value == option.default:
            continue
        name = option.name.replace("_", "-")
        values = value if isinstance(value, tuple) else () if isinstance(value, bool) else (value,)
        shown += [f"--no-{name}" if value is False else f"--{name}", *map(str, values)]
    return {**environment(), "command": shlex.join(shown), "load": load, "quick": False}


def _load() -> float | None:
    return round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None


def _table(written: list[Written], root: Path, source: Source, options: ExportOptions, place: str) -> BenchTable:
    def loss(item: Any) -> Loss | None:
        return item["written"].loss

    def to_ours(shown: Shown | None) -> str:
        if shown is None:
            return "-"
        return "the same" if shown.same else f"{shown.to_ours:.2f} dB"

    def lost(found: Loss | None, shown: Shown | None) -> str:
        return "-" if found is None or shown is None else f"{_plain_zero(found.ours - shown.to_photographs)} dB"

    def of(kind: str, found: Loss | None) -> Shown | None:
        return None if found is None else getattr(found, kind)

    # sizes must be read before the files are moved
    rows = [
        {"written": item, "name": _name(item, root), "size": item.size, "loss": item.json()["loss"]} for item in written
    ]
    views = next((item.loss.views for item in written if item.loss is not None), 0)
    return BenchTable(
        name=place,
        title=f"{source.method}, {source.experiment}, as {options.format}" + ", baked" * options.bake,
        rows=rows,
        columns=[
            ("file", lambda row: row["name"]),
            ("Gaussians", lambda row: f"{row['written'].count:,}"),
            ("kB", lambda row: number(row["size"] / 1000)),
            ("mip viewers: to our pictures", lambda row: to_ours(of("mip", loss(row)))),
            ("mip viewers: lost", lambda row: lost(loss(row), of("mip", loss(row)))),
            ("classic viewers: to our pictures", lambda row: to_ours(of("classic", loss(row)))),
            ("classic viewers: lost", lambda row: lost(loss(row), of("classic", loss(row)))),
            ("seconds", lambda row: number(row["written"].seconds)),
            ("Gaussians are", lambda row: row["written"].note),
        ],
        note=f"Means of PSNR over {views} views. *lost*: what our own pictures reach against the photographs, less "
        "what the file's reach.",
    )


def _plain_zero(value: float) -> str:
    text = f"{value:.2f}"
    return "0.00" if text == "-0.00" else text


def _tell(table: BenchTable, source: Source, paths: list[Path], console: "Console") -> None:
    if source.left_out:
        console.print(f"[yellow]Left out: {source.left_out}.", soft_wrap=True)
    for row in table.rows:
        item: Written = row["written"]
        text = f"{row['name']}: {item.count:,} Gaussians, {row['size']:,} bytes, {item.note}, {item.seconds:.1f} s"
        console.print(text + ("" if item.loss is None else f"; {_sentence(item.loss)}"), soft_wrap=True, markup=False)
    for path in paths:
        console.print(str(path), soft_wrap=True, highlight=False, markup=False)


def _sentence(loss: Loss) -> str:
    def against(shown: Shown) -> str:
        close = "the same as our pictures" if shown.same else f"{shown.to_ours:.2f} dB to our pictures"
        return f"{close}, {_plain_zero(loss.ours - shown.to_photographs)} dB lost against photographs"

    if loss.mip is None:
        return f"any viewer: {against(loss.classic)}"
    return f"mip viewers: {against(loss.mip)}; classic viewers: {against(loss.classic)}"
