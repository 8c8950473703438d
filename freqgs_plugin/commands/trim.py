"""`freqgs trim`: a trained run without what its scene does not need, as a new run beside it."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.commands.options import CommandError
from freqgs_plugin.commands.trim_options import TrimOptions
from freqgs_plugin.reports.bench.page import check_places, fill, read_page
from freqgs_plugin.reports.bench.runner import check_folder, write_all
from freqgs_plugin.reports.bench.trained import load, quiet
from freqgs_plugin.reports.tables import finite_json
from freqgs_plugin.reports.trim.page import markdown, place_name, record_of, remarks, summary, trim_table
from freqgs_plugin.reports.trim.steps import trim
from freqgs_plugin.reports.trim.trimmer import Step, Trimmer

if TYPE_CHECKING:
    from rich.console import Console


def run_trim(options: TrimOptions, console: "Console") -> None:
    """Measure what can go, leave it out, and write the new run.

    Raises:
        CommandError: options or a run with which that cannot be done.
        OSError: inputs that are not there, or a folder that cannot be written.
        KeyboardInterrupt: passed on, after a message.
    """
    if not (math.isfinite(options.max_loss_db) and options.max_loss_db >= 0):
        raise CommandError(f"max-loss-db is {options.max_loss_db:g}; give a loss of PSNR in dB, 0 or more.")
    written: list[Path] = []
    try:
        _trim(options, console, written)
    except ValueError as error:
        raise CommandError(str(error)) from error
    except KeyboardInterrupt:
        what = f"{written[0]} is complete, and no more was written." if written else "Nothing was written."
        console.print(f"Stopped. {what}", soft_wrap=True, highlight=False, markup=False)
        raise


def _trim(options: TrimOptions, console: "Console", written: list[Path]) -> None:
    """`written` then holds the new run's config.yml."""
    run = load(options.load_config)
    # loading keeps quiet what nerfstudio says as it is imported
    from freqgs_plugin.studio.run_files import latest_checkpoint
    from freqgs_plugin.studio.trimmed import check_place, checkpoint_bytes, write_trimmed

    old = options.load_config.resolve().parent
    checkpoint, _ = latest_checkpoint(old)
    folder = options.output_dir or old.with_name(f"{old.name}-trimmed")
    if not options.dry_run:
        check_place(folder.absolute(), run.config.method_name)
        check_folder(folder.absolute().parent)
    with quiet():
        views = run.num_views("train"), run.num_views("test")
    if not views[0]:
        raise CommandError(f"{options.load_config}: there are no training views to measure on.")
    if options.docs is not None:
        check_places(read_page(options.docs), [place_name(run)], options.docs)
    with console.status("Trimming") as status:
        trimmer = Trimmer(
            run, options.max_loss_db, lambda draft: checkpoint_bytes(run, draft), lambda what: status.update(what)
        )
        steps = trim(trimmer, checkpoint.stat().st_size)
    _report(run, steps, options, console)
    text = markdown(f"{old.name}, trimmed", steps, options.max_loss_db)
    record = record_of(str(old), run.config.method_name, options.max_loss_db, steps)
    if options.dry_run:
        console.print("Nothing was written (--dry-run).")
        return
    more = {
        "trim.json": json.dumps(finite_json(record), indent=1, default=str) + "\n",
        "trim.md": f"# {old.name}, trimmed\n\n{text}",
    }
    config = write_trimmed(run, steps[-1].draft, old, folder.absolute(), more)
    written.append(config)
    if options.docs is not None:
        _fill(options.docs, place_name(run), _with_circumstances(text, record))
    console.print(f"{config}", soft_wrap=True, highlight=False, markup=False)


def _report(run: Any, steps: list[Step], options: TrimOptions, console: "Console") -> None:
    name = options.load_config.resolve().parent.name
    console.print(trim_table("", f"{run.config.method_name} run {name}, trimmed", steps).rich())
    for line in remarks(steps):
        console.print(line, soft_wrap=True, markup=False)
    console.print(summary(steps, options.max_loss_db), soft_wrap=True, markup=False)


def _with_circumstances(text: str, record: dict[str, Any]) -> str:
    hardware, versions = record["hardware"], record["versions"]
    said = (
        f"*Measured {record['date'][:10]}, commit {record['commit']}, {hardware['processor']}, "
        f"{hardware['threads']} thread{'s' if hardware['threads'] > 1 else ''}, {hardware['gpu'] or 'no GPU'}, torch "
        f"{versions['torch']}: `freqgs trim --max-loss-db {record['max_loss_db']:g}`.*"
    )
    return f"{said}\n\n{text}"


def _fill(path: Path, name: str, text: str) -> None:
    """The page as it is now, with the run's part made anew; in one piece."""
    page = read_page(path)
    check_places(page, [name], path)
    write_all({path: fill(page, name, text).encode()})
