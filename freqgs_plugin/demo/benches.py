"""Commands of `freqgs bench` that need the demo scene's truth. Heavy imports happen inside of them."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from freqgs_plugin.reports.bench.options import BenchError, BenchOptions

if TYPE_CHECKING:
    from freqgs_plugin.demo.dataset import SceneOptions
    from freqgs_plugin.reports.bench.focus_cases import FocusSubject, TrueView

Options = Annotated[BenchOptions, tyro.conf.arg(name="")]

OBJECTS = ("astronaut box", "moon", "red ball", "table", "brick pot", "tissue box", "book", "blue pillar", "dice 1",
           "marble 1")  # fmt: skip
"""solids of the demo scene that are selected"""


def focus(load_config: Path, options: Options = BenchOptions()) -> None:  # noqa: B008
    """Select objects of the demo scene from masks, boxes and points, and compare with what is truly there.

    Args:
        load_config: config.yml of a run trained on a scene of `freqgs demo`.
        options: where to write, and how to measure.
    """
    from rich.console import Console

    from freqgs_plugin.reports.bench.focus import TABLES, focus_bench
    from freqgs_plugin.reports.bench.runner import check_options, run_bench
    from freqgs_plugin.reports.bench.trained import load

    check_options(options, TABLES)
    bench = focus_bench(options, subject_of(load(load_config)))
    # tables are not folded to the 80 columns that a file or a pipe would have
    console = Console() if sys.stdout.isatty() else Console(width=200)
    run_bench(bench, options, console, "--load-config", "RUN/config.yml")


BENCHES = {"focus": focus}
"""name on the command line -> function"""


def subject_of(run: Any) -> "FocusSubject":
    """The run with the objects that its views show.

    Raises:
        BenchError: its scene was not made by `freqgs demo`, or has no held-out view.
    """
    from freqgs_plugin.demo.scene import build_world, orbit
    from freqgs_plugin.reports.bench.focus_cases import FocusSubject
    from freqgs_plugin.reports.bench.trained import views_of_split

    scene = scene_of(run)
    world, cameras = build_world(scene.seed), orbit(scene.num_views, scene.width, scene.height, scene.seed)
    train, test = (
        [_true_view(view, world, cameras) for view in views_of_split(run, split)] for split in ("train", "test")
    )
    if not train or not test:
        raise BenchError(f"the run has {len(train)} training and {len(test)} held-out views; both are needed.")
    numbers = {solid.name: i for i, solid in enumerate(world.solids)}
    seen = [(name, numbers[name]) for name in OBJECTS]
    objects = [
        (name, i) for name, i in seen if all(any(bool((v.ids == i).any()) for v in part) for part in (train, test))
    ]
    return FocusSubject(run.gaussians, run.rasterizer, run.antialiased, train, test, objects)


def scene_of(run: Any) -> "SceneOptions":
    """What the scene on disk was made from.

    Raises:
        BenchError: it has no manifest of ours.
    """
    from freqgs_plugin.demo.dataset import MANIFEST, SceneOptions

    folder = Path(run.config.pipeline.datamanager.data)
    manifest = folder / MANIFEST
    if not manifest.is_file():
        raise BenchError(
            f"{folder} has no {MANIFEST}: true masks are known for scenes of `freqgs demo` alone. Name a run of one."
        )
    written = json.loads(manifest.read_text(encoding="utf-8"))
    return SceneOptions(**{name: value for name, value in written.items() if name != "written_by"})


def _true_view(view: Any, world: Any, cameras: list[Any]) -> "TrueView":
    import torch

    from freqgs_plugin.demo.raytrace import object_ids
    from freqgs_plugin.reports.bench.focus_cases import TrueView

    camera = cameras[int(Path(view.name).stem.removeprefix("view_"))]
    found, wanted = (view.camera.width, view.camera.height), (camera.width, camera.height)
    if found != wanted:
        raise BenchError(f"{view.name} is used at {found} px, and was made at {wanted}; train at full size.")
    return TrueView(view.camera, view.image, torch.from_numpy(object_ids(world, camera)))
