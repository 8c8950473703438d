"""An experiment without ns-train: trainings write a line, and loading one makes random Gaussians."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import torch
from fake_run import fake_run, fake_views

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.experiments.lab import Lab, Tools
from freqgs_plugin.reports.experiments.progress import Silent
from freqgs_plugin.reports.experiments.store import Store
from freqgs_plugin.reports.experiments.training import DEFAULT_SCALE, PLAIN, ExperimentScene

SCENE = ExperimentScene("room", Path("room"), "what is in room")


def decaying_run(decay=2.0, n=60, views=2):
    """A `LoadedRun` with decays around `decay`; None: without."""
    run = fake_run(levels=1, n=n)
    run.rasterizer = get_rasterizer("numba", "cpu")
    if decay is not None:
        spread = torch.rand(n, generator=torch.Generator().manual_seed(1)) + 0.5
        run.gaussians = replace(run.gaussians, decay=decay * spread)
    run.scene_distance = None if decay is None else 2.5
    held_out = fake_views(views)
    return SimpleNamespace(**vars(run), cameras=lambda split: held_out, levels_left_out=list)


def levels_run(n=60, views=2, said=()):
    """A `LoadedRun` of three levels, without decay, that says so much of its levels."""
    run = fake_run(levels=3, n=n)
    run.rasterizer = get_rasterizer("numba", "cpu")
    held_out = fake_views(views)
    return SimpleNamespace(
        **vars(run), scene_distance=None, cameras=lambda split: held_out, levels_left_out=lambda: list(said)
    )


class FakeTools:
    """Counts what it is asked for; `stop_at` raises `error` instead of the training of that number."""

    def __init__(self, folder, stop_at=None, error=KeyboardInterrupt, changed=()):
        self.folder, self.stop_at, self.error = folder, stop_at, error
        self.trained, self.loaded = [], []
        self.changed = dict(changed)

    def train(self, training, name, on_step):
        if len(self.trained) == self.stop_at:
            raise self.error
        on_step(training.steps)
        self.trained.append(training)
        path = self.folder / training.method / name / "config.yml"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({"method": training.method, **training.options}))
        print("what nerfstudio says")
        return path

    def load(self, path):
        self.loaded.append(path)
        said = json.loads(path.read_text())
        if said["method"].startswith("lapsplat") and said.get("num_levels") in (None, "auto", 5):
            return levels_run(said=[f"chosen by {said}"] if said.get("num_levels") == "auto" else ())
        decays = said["method"].startswith("clodsplat") and said.get("use_decay", True)
        return decaying_run(said.get("largest_scale", DEFAULT_SCALE) if decays else None)

    def defaults(self, method):
        ours = {"largest_scale": DEFAULT_SCALE, "use_decay": True, "weigh_scales": True}
        ours |= {"reg_weight": 1.0, "reg_gradient": "ste"}
        levels = {"dft_weight": 0.001, "lower_level_weight": 0.1, "signed_residuals": True}
        levels |= {"num_levels": 3, "base_share": 1.0, "level_interval": 2500, "coarse_growth_factor": 1.8}
        levels |= {"least_level_gain": 0.0}
        more = ours if method.startswith("clodsplat") else {**PLAIN, **levels}
        fields = {"seed": 42, "max_gaussians": 0, **more}
        return {name: repr(value) for name, value in {**fields, **self.changed}.items()}

    def tools(self):
        return Tools(self.train, self.load, self.defaults)


def fake_lab(folder, **more):
    tools = FakeTools(folder / "runs", **more)
    return Lab(Store(folder / "steps"), tools.tools(), Silent(), folder / "load.log"), tools
