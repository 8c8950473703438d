"""The commands of `freqgs experiment`: scenes, ns-train and trained runs, handed to the experiments in `reports`.

Heavy imports happen inside of the commands.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from freqgs_plugin.reports.experiments.options import ClaimsOptions, ClodOptions, ExperimentError, TrialOptions

if TYPE_CHECKING:
    from rich.console import Console

    from freqgs_plugin.reports.experiments.lab import Tools
    from freqgs_plugin.reports.experiments.training import ExperimentScene, Training

EVALUATIONS = 12
"""of the held-out views, in the course of each training"""
ClodFlags = Annotated[ClodOptions, tyro.conf.arg(name="")]
ClaimsFlags = Annotated[ClaimsOptions, tyro.conf.arg(name="")]


def clod(options: ClodFlags = ClodOptions()) -> None:  # noqa: B008
    """Train and measure what clodsplat is said to do: quality against count, a plain model, pops, ablations.

    Trains many runs, one at a time: hours for the defaults on a CPU. Whatever is finished is kept, and the same command
    goes on from there.
    """
    from freqgs_plugin.reports.experiments.runner import check_clod, run_clod

    check_clod(options)
    run_clod(options, *_laboratory(options))


def claims(options: ClaimsFlags = ClaimsOptions()) -> None:  # noqa: B008
    """Put each claim of the two papers to the test, beside a plain model: holds or not, with its figures.

    Trains 19 runs for each scene and seed, one at a time: hours on a CPU. Whatever is finished is kept, and the same
    command goes on from there.
    """
    from freqgs_plugin.reports.experiments.claims_runner import check_claims, run_claims

    check_claims(options, [folder.resolve().name for folder in options.scenes] + ["demo"] * options.demo)
    run_claims(options, *_laboratory(options))


def _laboratory(options: TrialOptions) -> tuple[list["ExperimentScene"], "Tools", "Console"]:
    """Scenes, what touches nerfstudio, and where to speak to the user."""
    import sys

    from rich.console import Console

    from freqgs_plugin.reports.bench.runner import check_folder
    from freqgs_plugin.reports.experiments.lab import Tools

    scenes = [scene_of(folder, options.output_dir) for folder in options.scenes]
    check_folder(options.output_dir)
    if options.demo:
        scenes.append(demo_scene(options))
    runs = options.output_dir / "runs"
    tools = Tools(lambda training, name, on_step: train_run(runs, training, name, on_step), _load, method_defaults)
    # loading sends standard output to a log; what is for the user keeps going to the terminal
    return scenes, tools, Console(file=sys.stdout)


EXPERIMENTS = {"clod": clod, "claims": claims}
"""name on the command line -> function"""


def scene_of(folder: Path, output_dir: Path | None = None) -> "ExperimentScene":
    """A scene by its folder, whatever lies in `output_dir`.

    Raises:
        ExperimentError: it holds neither a COLMAP model nor a transforms.json.
    """
    from freqgs_plugin.reports.experiments.training import ExperimentScene, fingerprint

    folder = folder.resolve()
    parser_of(folder)
    return ExperimentScene(folder.name, folder, fingerprint(folder, output_dir))


def demo_scene(options: TrialOptions) -> "ExperimentScene":
    """The demo scene, ray-traced unless it is there, with a camera that goes from 0.3 to 3.1 m."""
    from freqgs_plugin.demo.dataset import MANIFEST, SceneOptions, write_scene
    from freqgs_plugin.demo.scene import build_world, zoom_path
    from freqgs_plugin.reports.experiments.store import alone
    from freqgs_plugin.reports.experiments.training import ExperimentScene

    width, height = options.size
    scene = SceneOptions(num_views=options.views, width=width, height=height)
    folder = options.output_dir.resolve() / "scenes" / f"demo-{options.views}-{width}x{height}"
    manifest = folder / MANIFEST
    written = json.loads(manifest.read_text(encoding="utf-8")) if manifest.is_file() else {}
    identity = {"written_by": "freqgs demo", **asdict(scene)}
    # the model is written last
    complete = written == identity and (folder / "sparse" / "0" / "points3D.bin").is_file()
    # a page alone needs no photographs
    if not complete and not options.page_only:
        options.output_dir.mkdir(parents=True, exist_ok=True)
        # another start in the same folder would find it half written, and remove it
        with alone(options.output_dir):
            write_scene(folder, scene)
    path = zoom_path(build_world(scene.seed), options.frames + 1, width, height)
    return ExperimentScene("demo", folder, json.dumps(identity, sort_keys=True), tuple(path))


def parser_of(folder: Path) -> tuple[str, ...]:
    """How ns-train reads a scene; every eighth view is held out.

    Raises:
        ExperimentError: it cannot.
    """
    from freqgs_plugin.io.check_scene import find_model

    model = find_model(folder)
    interval = ("--eval-mode", "interval", "--eval-interval", "8")
    if model is not None:
        return ("colmap", "--colmap-path", model, *interval)
    if (folder / "transforms.json").is_file():
        return ("nerfstudio-data", *interval)
    raise ExperimentError(f"{folder} holds neither a COLMAP model nor a transforms.json; name the folder of a scene")


def train_run(runs: Path, training: "Training", name: str, on_step: Callable[[int], object]) -> Path:
    """Train from nothing; what an earlier try left is removed. Returns config.yml.

    Raises:
        TrainingError: ns-train failed.
    """
    from freqgs_plugin.demo.training import TrainingRun, train

    run = TrainingRun(
        scene=training.scene.folder.resolve(),
        output_dir=runs.resolve(),
        steps=training.steps,
        seed=training.seed,
        levels=None,
        timestamp=name,
        method=training.method,
        experiment=training.scene.name,
        options=training.arguments(),
        # so that `freqgs report` has error against training time
        evaluations=EVALUATIONS,
        parser=parser_of(training.scene.folder),
    )
    shutil.rmtree(run.folder, ignore_errors=True)
    run.output_dir.mkdir(parents=True, exist_ok=True)

    def report(step: int, stage: str | None) -> None:
        on_step(step)

    train(run, run.output_dir / f"{name}.log", report)
    return run.config_path


@lru_cache
def method_defaults(method: str) -> Mapping[str, str]:
    """The fields of a method's model config, and its optimizers, as `repr` shows them."""
    (found,) = entry_points(group="nerfstudio.method_configs", name=method)
    config = found.load().config
    model = config.pipeline.model
    optimizers = {"optimizers": repr(config.optimizers)}
    return {**{field.name: repr(getattr(model, field.name)) for field in fields(model)}, **optimizers}


def _load(config_path: Path) -> Any:
    from freqgs_plugin.studio.checkpoint import load_run

    return load_run(config_path)
