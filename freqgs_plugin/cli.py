"""The `freqgs` command. Heavy imports happen inside of the commands, so that `--help` is quick."""

import errno
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Union

from tyro.conf import arg

from freqgs_plugin.commands.export_options import ExportOptions, ImportOptions
from freqgs_plugin.commands.options import CommandError, FilterOptions, RenderOptions
from freqgs_plugin.commands.serve import serve
from freqgs_plugin.commands.stream import stream
from freqgs_plugin.commands.trim_options import TrimOptions
from freqgs_plugin.demo.benches import BENCHES as DEMO_BENCHES
from freqgs_plugin.demo.experiments import EXPERIMENTS
from freqgs_plugin.reports.bench.commands import BENCHES
from freqgs_plugin.reports.report.options import ReportError, ReportOptions


def demo(
    output_dir: Path = Path("demo-out"),
    scene_only: Path | None = None,
    steps: int = 2500,
    levels: int = 3,
    seed: int = 0,
    views: int = 36,
    size: tuple[int, int] = (320, 240),
) -> None:
    """Show what levels of detail are, on a scene made on the spot: no downloads, no GPU needed.

    Ray-traces photographs of a small room, trains lapsplat on them through ns-train, and writes a contact sheet of the
    levels and a table of what each costs.

    Args:
        output_dir: folder for the scene, the trained run, the contact sheet and the report.
        scene_only: write only the scene, a COLMAP folder, here, and stop.
        steps: training steps.
        levels: levels of detail.
        seed: of the scene and of training.
        views: photographs; every eighth is held out.
        size: width and height of the photographs, pixels.
    """
    from rich.console import Console

    from freqgs_plugin.demo.dataset import SceneOptions, write_scene

    scene = SceneOptions(num_views=views, width=size[0], height=size[1], seed=seed)
    if scene_only is not None:
        write_scene(scene_only, scene)
        print(f"{scene_only}: {views} photographs. Train with: ns-train lapsplat --data {scene_only} "
              "colmap --colmap-path sparse/0")  # fmt: skip
        return
    from freqgs_plugin.demo.run import DemoOptions, run_demo

    run_demo(DemoOptions(output_dir, scene, steps, levels), Console())


def render(options: Annotated[RenderOptions, arg(name="")] = RenderOptions()) -> None:  # noqa: B008
    """Draw a trained scene at any level of detail: PNG files, and an MP4 of a camera path.

    Prints how many Gaussians each frame draws, and how long it takes. Levels, budgets, gaze and filters combine.
    """
    from rich.console import Console

    from freqgs_plugin.commands.render import run_render

    run_render(options, Console())


def filters(options: Annotated[FilterOptions, arg(name="")]) -> None:
    """Draw artistic filters side by side from several views, as one PNG file; one's own filters, too.

    Prints how much each changes the pictures, and how far it is the same from a step aside.
    """
    from rich.console import Console

    from freqgs_plugin.commands.filters import run_filters

    run_filters(options, Console())


def export(options: Annotated[ExportOptions, arg(name="")] = ExportOptions()) -> None:  # noqa: B008
    """Write a trained scene as files for other programs, and tell what each loses against our own pictures.

    Files are read back and drawn as viewers draw them, colours clamped at 0, by viewers that heed SplatRenderMode: mip
    and by those that do not.
    """
    from rich.console import Console

    from freqgs_plugin.commands.export import run_export

    run_export(options, Console())


def import_(options: Annotated[ImportOptions, arg(name="")]) -> None:
    """Make a run of an exported scene: ns-eval, ns-viewer, ns-export and freqgs take its config.yml.

    A round trip is exact where the format is.
    """
    from rich.console import Console

    from freqgs_plugin.commands.importing import run_import

    run_import(options, Console())


def trim(options: Annotated[TrimOptions, arg(name="")]) -> None:
    """Leave out of a trained run what its scene does not need, and write the rest as a new run beside it.

    Gaussians, harmonics, decays and levels go as far as a stated loss of PSNR on the training views allows; every step
    is measured, and undone where it costs more. Held-out views are measured too, but nothing is chosen by them.
    """
    from rich.console import Console

    from freqgs_plugin.commands.trim import run_trim

    run_trim(options, Console())


def stability(
    output_dir: Path = Path("stability-out"),
    only: Literal["geometry", "compositing", "decay", "losses", "autocast", "training"] | None = None,
    quick: bool = False,
) -> None:
    """Run a grid of extremes through every backend and dtype: value and gradient errors, finite or not, time.

    Each case has one outcome that is right: a value, zero, or a named error. Writes stability.json and stability.md;
    the exit status is 1 if any outcome is another one.

    Args:
        output_dir: folder for both files; groups that are not run keep what the files hold.
        only: run one group of cases.
        quick: leave out the cases that take long.
    """
    from rich.console import Console

    from freqgs_plugin.reports.stability.runner import run_stability

    run_stability(output_dir, only, quick, Console())


def report(options: Annotated[ReportOptions, arg(name="")]) -> None:
    """Compare trained runs: held-out error against render time, bytes, Gaussians and training time, with plots.

    For every prefix of levels (lapsplat), a sweep of s_v (clodsplat) and cuts of a plain model. Writes JSON, CSV,
    Markdown, PNG plots and one HTML page with all of it, and says whether the runs' numbers are sound.
    """
    from freqgs_plugin.commands.report import report_on

    report_on(options)


COMMANDS = {
    "demo": demo,
    "report": report,
    "render": render,
    "filters": filters,
    "trim": trim,
    "export": export,
    "import": import_,
    "stream": stream,
    "serve": serve,
    "stability": stability,
    "bench": {**BENCHES, **DEMO_BENCHES},
    "experiment": EXPERIMENTS,
}
"""name on the command line -> function, whose signature and docstring become the options and the help, or -> a table of
such commands"""

GROUPS = {
    "bench": "Measure times, memory and errors, and write them as JSON, Markdown and pictures.",
    "experiment": "Train and measure what a method is said to do, and write it as JSON, Markdown and pictures.",
}
"""help of each table in COMMANDS"""


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Errors that name their remedy are printed without a traceback; the exit status is then 1."""
    import tyro

    from freqgs_plugin.reports.child import ended_by_exception

    try:
        # what is half written is removed, as with Ctrl-C
        with ended_by_exception():
            tyro.cli(
                _one_of(COMMANDS), prog="freqgs", description="Level of detail for Gaussian splatting.", args=arguments
            )
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        if not _expected(error):
            raise
        print(f"freqgs: {_told(error)}", file=sys.stderr)
        sys.exit(1)


def _told(error: Exception) -> str:
    """The message, with the remedy where the system's own has none."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT) and error.filename is None:
        return f"the disk is full ({error.strerror}). Make room there, or write to another one."
    return str(error)


def _one_of(commands: Mapping[str, Any]) -> Any:
    """The type of which tyro makes subcommands: a union with one member per command."""
    from tyro.conf import Suppress, subcommand

    # a union of one would be no choice, and ask for no name
    members: list[Any] = [Annotated[None, Suppress]]
    for name, command in commands.items():
        constructor = command if callable(command) else _group(GROUPS[name], command)
        members.append(Annotated[Any, subcommand(name=name, constructor=constructor)])
    return Union[tuple(members)]  # noqa: UP007


def _group(description: str, commands: Mapping[str, Any]) -> Callable[..., None]:
    """A command that has commands: by the time it is called, tyro has called the one that was chosen."""
    from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes

    def group(command: Any) -> None:
        del command

    group.__doc__ = description
    group.__annotations__["command"] = OmitSubcommandPrefixes[OmitArgPrefixes[_one_of(commands)]]
    return group


def _expected(error: Exception) -> bool:
    """Errors raised for the user to read."""
    from freqgs_plugin.demo.training import TrainingError
    from freqgs_plugin.io.check_images import SceneError
    from freqgs_plugin.reports.bench.options import BenchError
    from freqgs_plugin.reports.experiments.options import ExperimentError
    from freqgs_plugin.reports.stability.runner import StabilityError
    from freqgs_plugin.stream.errors import StreamError

    ours = (
        CommandError,
        TrainingError,
        SceneError,
        StabilityError,
        BenchError,
        ExperimentError,
        ReportError,
        StreamError,
    )
    return isinstance(error, (OSError, *ours))


if __name__ == "__main__":
    main()
