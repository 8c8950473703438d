"""Writes what photographs in memory and on disk cost into docs/trim.md: peak memory, time to load, time of a step.

`python docs/measure_photographs.py make SCENE` writes a scene of random textures, `... measure SCENE ...` measures each
scene in memory, on disk and once more on disk, in a process each, and fills the place `photographs NAME` of the page,
where NAME is that of the scene's folder.
"""

import itertools
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "trim.md"
VIEWS, WIDTH, HEIGHT = 300, 1600, 1000
STEPS = 60


def make(folder: Path) -> None:
    """A COLMAP scene of JPEG photographs that show nothing, but compress about as photographs do."""
    import cv2
    import numpy as np

    from freqgs_plugin.demo.scene import orbit
    from freqgs_plugin.io.colmap import Points, write_colmap

    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    names = [f"view_{i:03d}.jpg" for i in range(VIEWS)]
    for name in names:
        image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
        for size in (8, 32, 128, 512):
            grain = rng.normal(0, 20, (size, size, 3)).astype(np.float32)
            image += cv2.resize(grain, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / "images" / name), (image + 128).clip(0, 255).astype(np.uint8))
    seen = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))
    points = Points(rng.normal(0, 0.5, (500, 3)), rng.integers(0, 256, (500, 3), np.uint8), *seen)
    write_colmap(folder / "sparse" / "0", orbit(VIEWS, WIDTH, HEIGHT), names, points)


def resident() -> dict[str, float]:
    """MB that this process has resident: its own (RssAnon), and mapped files', which the system takes back at need."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {key: int(lines[key].split()[0]) * 1024 / 1e6 for key in ("RssAnon", "RssFile", "VmRSS")}


def made(scene: Path, where: str, cache: Path) -> Any:
    """A trainer before its set-up: full size, one level, and no target kept, so that each step needs a photograph."""
    from nerfstudio.utils.rich_utils import CONSOLE

    from freqgs_plugin.studio.step_profile import ProfileSpec, trainer_config

    CONSOLE.quiet = True
    config = trainer_config(ProfileSpec(data=str(scene), output=str(cache / "runs"), steps=2 * STEPS))
    manager, model = config.pipeline.datamanager, config.pipeline.model
    manager.cache_images_where, manager.cache_images_dir = where, cache
    model.num_levels, model.target_cache_mb, model.num_downscales = 1, 0, 0
    return config.setup(local_rank=0, world_size=1)


def load(scene: Path, where: str, cache: Path) -> dict[str, float]:
    """Read all photographs and train a little: seconds until they are read, and the most memory that it adds, MB."""
    trainer = made(scene, where, cache)
    before, most, done = resident(), resident(), threading.Event()

    def watch() -> None:
        while not done.wait(0.005):
            most.update({key: max(most[key], value) for key, value in resident().items()})

    watcher = threading.Thread(target=watch)
    watcher.start()
    began = time.perf_counter()
    trainer.pipeline = trainer.config.pipeline.setup(device="cpu", test_mode="val")
    trainer.pipeline.datamanager.named_cameras()
    seconds = time.perf_counter() - began
    trainer.optimizers = trainer.setup_optimizers()
    for step in range(STEPS // 3):
        trainer.train_iteration(step)
    done.set()
    watcher.join()
    return {"load": seconds, **{key: most[key] - before[key] for key in most}}


def turns(scene: Path, cache: Path) -> dict[str, float]:
    """Median time of a step with photographs in memory and on disk, taking turns in one training, ms."""
    from freqgs_plugin.reports.timing import interleaved

    trainer = made(scene, "memory", cache)
    trainer.pipeline = trainer.config.pipeline.setup(device="cpu", test_mode="val")
    trainer.optimizers = trainer.setup_optimizers()
    managers = {"memory": trainer.pipeline.datamanager}
    config = made(scene, "disk", cache).config.pipeline.datamanager
    managers["disk"] = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    for manager in managers.values():
        manager.named_cameras()
    step = itertools.count()

    def train(where: str) -> None:
        trainer.pipeline.datamanager = managers[where]
        trainer.train_iteration(next(step))

    times = interleaved({where: lambda where=where: train(where) for where in managers}, STEPS)
    return {where: timing.median_ms for where, timing in times.items()}


def compile_kernels(scene: Path) -> None:
    """Where numba's cache lacks them, the first process would be charged with compiling them: time and memory."""
    with tempfile.TemporaryDirectory() as cache:
        child("load", scene, "memory", cache)


def child(*arguments: object) -> dict[str, float]:
    """What this file prints in a process of its own."""
    command = [sys.executable, "-W", "ignore", __file__, *map(str, arguments)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


def measured(scene: Path) -> str:
    """A table of one scene."""
    rows = ["| photographs | to load, s | peak of own memory, MB | of mapped files, MB | of both, MB |"]
    rows.append("| --- | ---: | ---: | ---: | ---: |")
    with tempfile.TemporaryDirectory() as cache:
        for name, where in (("in memory", "memory"), ("on disk, first run", "disk"), ("on disk, later run", "disk")):
            found = child("load", scene, where, cache)
            values = (f"{found['load']:.1f}", *(f"{found[k]:,.0f}" for k in ("RssAnon", "RssFile", "VmRSS")))
            rows.append(f"| {name} | {' | '.join(values)} |")
        times = child("turns", scene, cache)
        sizes = [file.stat().st_size for file in Path(cache).rglob("*.view")]
    head = f"{scene.name}: {len(sizes)} photographs, {sum(sizes) / 1e6:,.1f} MB on disk. A step takes "
    head += f"{times['memory']:.1f} ms with photographs in memory and {times['disk']:.1f} ms with photographs on disk "
    return f"{head}(medians of {STEPS} each, taking turns).\n\n" + "\n".join(rows)


def measure(scenes: list[Path]) -> None:
    """One scene after another; each is in the page as soon as it is measured."""
    from freqgs_plugin.reports.bench.page import check_places, fill, read_page
    from freqgs_plugin.reports.timing import environment

    check_places(read_page(PAGE), [f"photographs {scene.name}" for scene in scenes], PAGE)
    compile_kernels(scenes[0])
    for scene in scenes:
        text, now, load_average = measured(scene), environment(), os.getloadavg()[1]
        hardware = now["hardware"]
        machine = f"{hardware['processor']}, {hardware['cores']} cores, {hardware['threads']} thread, no GPU"
        head = f"*Measured {now['date'][:10]}, commit {now['commit']}, {machine}, load average of the last minutes "
        head += f"{load_average:.1f}: `python docs/measure_photographs.py measure {scene.name}`.*"
        page = fill(read_page(PAGE), f"photographs {scene.name}", f"{head}\n\n{text}")
        PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    command, *rest = sys.argv[1:]
    if command == "make":
        make(Path(rest[0]))
    elif command == "load":
        print("\n" + json.dumps(load(Path(rest[0]), rest[1], Path(rest[2]))))
    elif command == "turns":
        print("\n" + json.dumps(turns(Path(rest[0]), Path(rest[1]))))
    else:
        measure([Path(scene) for scene in rest])
