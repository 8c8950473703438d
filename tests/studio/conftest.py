"""A small scene, runs that the real `ns-train` made of it, and trainers to be stepped by hand."""

import copy
import os
import shutil
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from running import DECAY_START, EVERY, SCALE, SIZE, STEPS, command, train_arguments

from freqgs_plugin.demo.dataset import SceneOptions, write_scene


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """`shared(name, make)`: a folder that `make(folder)` fills, once for all processes of this test run.

    The first process that asks makes it, others wait. Nobody else writes into it.
    """
    root = tmp_path_factory.getbasetemp()
    # a process of pytest-xdist has a folder of its own in that of the test run
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root

    def once(name, make):
        folder, done = root / f"shared-{name}", root / f"shared-{name}.done"
        with FileLock(root / f"shared-{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return once


@pytest.fixture(scope="session")
def scene(shared):
    """Nine views, of which three are held out; nobody writes into it."""
    options = SceneOptions(num_views=9, width=SIZE[0], height=SIZE[1], num_points=300, samples=1)
    return shared("scene", lambda folder: write_scene(folder / "scene", options, progress=False)) / "scene"


@pytest.fixture
def own_scene(scene, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(scene, tmp_path / "scene"))


@pytest.fixture(scope="session")
def trained(scene, shared):
    """config.yml of a finished run of three levels, with the checkpoints of every stage; nobody writes beside it."""
    return run_of("lapsplat", scene, shared)


@pytest.fixture(scope="session")
def faded(scene, shared):
    """config.yml of a finished run of clodsplat, with a checkpoint from before its decay begins and some from after."""
    more = ["--pipeline.model.decay-start-step", round(DECAY_START / SCALE), "--pipeline.model.export-distance", 0.6]
    return run_of("clodsplat", scene, shared, *more)


def run_of(method, scene, shared, *more):
    """config.yml of a run with checkpoints of every 25 steps; beside it `log.txt`, and `peak.txt` with GB of memory."""
    every = ("--max-num-iterations", STEPS, "--steps-per-save", 25, "--save-only-latest-checkpoint", False)
    place = Path("small", method, "run", "config.yml")

    def make(output):
        done = command("ns-train", *train_arguments(scene, output, *every, *more, method=method))
        assert done.code == 0 and (output / place).is_file(), str(done)
        (output / place).with_name("log.txt").write_text(done.text)
        (output / place).with_name("peak.txt").write_text(str(done.peak))

    return shared(method, make) / place


@pytest.fixture
def said(monkeypatch):
    """What is logged through nerfstudio's console, unwrapped."""
    from nerfstudio.utils.rich_utils import CONSOLE

    lines = []
    monkeypatch.setattr(CONSOLE, "log", lambda *parts, **_: lines.append(" ".join(map(str, parts))))
    return lines


@pytest.fixture
def make_config(scene, tmp_path):
    """`make_config(data=scene, parser={}, method="lapsplat", **model)`: a registered method for the small scene."""

    def make(data=None, parser=None, camera_optimizer=None, method="lapsplat", **model):
        from nerfstudio.configs.method_configs import all_methods
        from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

        config = copy.deepcopy(all_methods[method])
        manager = config.pipeline.datamanager
        manager.dataparser = ColmapDataParserConfig(**{"eval_mode": "interval", "eval_interval": 4, **(parser or {})})
        config.data = manager.data = data or scene
        config.output_dir, config.experiment_name, config.timestamp = tmp_path / "runs", "small", "now"
        config.max_num_iterations, config.vis = STEPS, "tensorboard"
        config.machine.device_type = "cpu"
        if camera_optimizer:
            config.pipeline.model.camera_optimizer.mode = camera_optimizer
        for name, value in {"steps_scale": SCALE, "least_refine_interval": EVERY, **model}.items():
            assert hasattr(config.pipeline.model, name), name
            setattr(config.pipeline.model, name, value)
        return config

    return make


@pytest.fixture
def manager(make_config, tmp_path):
    """`manager(data=None, parser=None, **fields)`: a datamanager whose photographs are on disk."""

    def make(data=None, parser=None, **fields):
        config = make_config(data=data, parser=parser).pipeline.datamanager
        ours = {"cache_images_where": "disk", "cache_images_dir": tmp_path / "cache"}
        for name, value in {**ours, **fields}.items():
            assert hasattr(config, name), name
            setattr(config, name, value)
        return config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)

    return make


@pytest.fixture
def make_trainer(make_config, monkeypatch):
    """`make_trainer(load_dir=None, ...)`: nerfstudio's own Trainer, set up and ready to step."""
    # the trainer imports the writer, which cannot be imported before it
    import nerfstudio.engine.trainer  # noqa: F401
    from nerfstudio.utils import writer

    monkeypatch.setattr(writer, "EVENT_WRITERS", [])

    def make(load_dir=None, load_step=None, edit=lambda config: None, **settings):
        config = make_config(**settings)
        config.load_dir, config.load_step = load_dir, load_step
        edit(config)
        torch.manual_seed(0)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    yield make
    writer.EVENT_STORAGE.clear()
