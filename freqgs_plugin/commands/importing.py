"""`freqgs import`: a run that every command accepts, of an exported scene."""

from pathlib import Path
from typing import TYPE_CHECKING

from freqgs_plugin.commands.export_options import ImportOptions
from freqgs_plugin.commands.options import CommandError
from freqgs_plugin.io.exported import Exported, read_exported
from freqgs_plugin.reports.bench.runner import check_folder
from freqgs_plugin.reports.bench.trained import quiet

if TYPE_CHECKING:
    from rich.console import Console


def run_import(options: ImportOptions, console: "Console") -> Path:
    """Write the run and return its config.yml.

    Raises:
        CommandError: the file cannot be used, or the photographs are not known.
        OSError: something is not there, or cannot be written.
    """
    try:
        exported = read_exported(options.path)
        data = _data(options, exported)
        check_folder(options.output_dir)
        with quiet():
            from freqgs_plugin.studio.importing import RunSettings, write_run
        settings = RunSettings(
            data=data,
            output_dir=options.output_dir,
            experiment=options.experiment_name or data.resolve().name,
            method=options.method or _method(exported),
            frame=exported.frame or options.frame or "scene",
            dataparser=options.dataparser,
        )
        if options.frame is not None and exported.frame not in (None, options.frame):
            raise ValueError(
                f"--frame {options.frame}: by its JSON, {options.path} is in the frame '{exported.frame}'."
            )
        with quiet():
            config = write_run(exported, settings)
    except ValueError as error:
        raise CommandError(str(error)) from error
    raw = exported.gaussians
    levels = 1 if raw.level is None else int(raw.level.max())
    kind = f"{levels} levels" if levels > 1 else "decay" if raw.decay is not None else "one level"
    console.print(f"{len(raw):,} Gaussians with {kind}, as a run of {settings.method}:", soft_wrap=True)
    console.print(str(config), soft_wrap=True, highlight=False, markup=False)
    return config


def _data(options: ImportOptions, exported: Exported) -> Path:
    named = exported.origin.get("data")
    if options.data is not None:
        if not options.data.is_dir():
            raise FileNotFoundError(f"--data {options.data} is no folder; name the one that ns-train was given.")
        return options.data
    if not isinstance(named, str):
        raise ValueError(f"{options.path} does not say where its photographs are: add --data FOLDER, as for ns-train.")
    if not Path(named).is_dir():
        raise ValueError(f"its photographs were in {named}, which is no folder here: add --data FOLDER.")
    return Path(named)


def _method(exported: Exported) -> str:
    if exported.gaussians.decay is not None:
        return "clodsplat"
    known = exported.origin.get("method")
    several = exported.gaussians.level is not None and int(exported.gaussians.level.max()) > 1
    return "lapsplat" if several or known != "clodsplat" else "clodsplat"
