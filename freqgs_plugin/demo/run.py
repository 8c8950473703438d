"""The demo from end to end: write the scene, train lapsplat through nerfstudio, show and measure the levels."""

import time
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freqgs_plugin.demo.dataset import MANIFEST, SceneOptions, write_scene
from freqgs_plugin.demo.training import TrainingRun, train
from freqgs_plugin.io.check_images import SceneError

if TYPE_CHECKING:
    from rich.console import Console

SHEET_VIEWS = 3


@dataclass(frozen=True)
class DemoOptions:
    """What the demo does."""

    output_dir: Path
    scene: SceneOptions
    steps: int
    """training steps"""
    levels: int


def run_demo(options: DemoOptions, console: "Console") -> None:
    """Write scene/, runs/, train.log, contact_sheet.png and report.json into the output folder.

    Raises:
        SceneError: options that make no sense.
        FileExistsError: the output folder holds something else.
        TrainingError: ns-train failed.
        KeyboardInterrupt: passed on, after a message on how to go on.
    """
    if options.steps < 1 or options.levels < 1:
        raise SceneError(f"the demo needs at least one step and one level, not {options.steps} and {options.levels}")
    out = options.output_dir
    claim_output(out)
    seconds: dict[str, float] = {}
    with _timed(seconds, "scene"):
        write_scene(out / "scene", options.scene)
    run = TrainingRun(
        scene=(out / "scene").resolve(),
        output_dir=(out / "runs").resolve(),
        steps=options.steps,
        seed=options.scene.seed,
        levels=options.levels,
        timestamp=datetime.now().strftime("%Y-%m-%d_%H%M%S"),
    )
    with _timed(seconds, "training"):
        _train(run, out / "train.log", console)
    _report(run, options, seconds, console)


def claim_output(folder: Path) -> None:
    """Make the output folder; refuse one that holds anything but an earlier demo.

    Raises:
        FileExistsError: with the folder's name and the remedy.
    """
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} is a file; choose another --output-dir")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "scene" / MANIFEST).is_file():
        raise FileExistsError(
            f"{folder} is not empty and holds no earlier demo. Nothing was changed. "
            "Choose another --output-dir, or remove this one first."
        )
    folder.mkdir(parents=True, exist_ok=True)


class _timed:
    """Notes how many seconds a block took."""

    def __init__(self, seconds: dict[str, float], name: str) -> None:
        self._seconds, self._name = seconds, name

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._seconds[self._name] = round(time.perf_counter() - self._start, 1)


def _train(run: TrainingRun, log: Path, console: "Console") -> None:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        with Progress(*columns, TimeRemainingColumn(), console=console) as bar:
            task = bar.add_task("starting ns-train", total=run.steps)

            def on_step(step: int, stage: str | None) -> None:
                if stage is not None:
                    bar.update(task, description=stage)
                elif step > 0 or bar.tasks[0].description.startswith("starting"):
                    bar.update(task, completed=step)
                    if bar.tasks[0].description.startswith("starting"):
                        bar.update(task, description=f"training level 1 of {run.levels}")

            train(run, log, on_step)
            bar.update(task, completed=run.steps)
    except KeyboardInterrupt:
        console.print(
            f"Stopped. The scene is kept in {run.scene}. {run.resume_hint()}",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
        raise


def _report(run: TrainingRun, options: DemoOptions, seconds: dict[str, float], console: "Console") -> None:
    from freqgs_plugin.reports.contact_sheet import contact_sheet
    from freqgs_plugin.reports.tables import prefix_rows, prefix_table, write_report

    out = options.output_dir
    # nerfstudio's remarks on loading belong to the log
    with (out / "train.log").open("a", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
        from freqgs_plugin.studio.checkpoint import load_run

        # pyright sees no property in a cached_property
        trained: Any = load_run(run.config_path)
        views, num_train = trained.cameras("test"), len(trained.cameras("train"))
    shown = sorted({round(i * (len(views) - 1) / (SHEET_VIEWS - 1)) for i in range(SHEET_VIEWS)})
    contact_sheet(out / "contact_sheet.png", trained, [views[i] for i in shown])
    rows = prefix_rows(trained, views)
    write_report(
        out / "report.json",
        rows,
        command="freqgs demo",
        method="lapsplat",
        rasterizer=trained.rasterizer.name,
        steps=options.steps,
        scene=asdict(options.scene),
        views={"train": num_train, "test": len(views)},
        seconds=seconds,
    )
    console.print(prefix_table(rows))
    for name, what in (
        ("contact_sheet.png", "what each level holds"),
        ("report.json", "these numbers, with hardware and versions"),
        ("train.log", "the trainer's output"),
    ):
        console.print(f"{out / name}: {what}", soft_wrap=True, highlight=False, markup=False)
    console.print(
        f"To look around: ns-viewer --load-config {run.config_path}", soft_wrap=True, highlight=False, markup=False
    )
