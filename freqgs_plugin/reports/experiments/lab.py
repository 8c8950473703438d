"""Does the steps of an experiment, one at a time, and none of them twice."""

import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from freqgs_plugin.reports.drawing import HeldOutView, TrainedRun
from freqgs_plugin.reports.experiments.options import ExperimentError
from freqgs_plugin.reports.experiments.progress import Progress
from freqgs_plugin.reports.experiments.store import Store, key
from freqgs_plugin.reports.experiments.training import Training

_KEPT = 2
"""loaded runs that are kept in memory"""


@runtime_checkable
class LoadedRun(TrainedRun, Protocol):
    """What an experiment needs of a run (`studio.checkpoint.Run` has it)."""

    @property
    def scene_distance(self) -> float | None: ...
    def cameras(self, split: Literal["train", "test"]) -> Sequence[HeldOutView]: ...
    def levels_left_out(self) -> list[str]: ...


@dataclass(frozen=True)
class Tools:
    """What touches nerfstudio."""

    train: Callable[[Training, str, Callable[[int], object]], Path]
    """trains under the name of the key from nothing, whatever is left of an earlier try; calls back with each step;
    returns config.yml"""
    load: Callable[[Path], Any]
    """config.yml -> a `LoadedRun`"""
    defaults: Callable[[str], Mapping[str, str]]
    """method -> fields of its model's config, as `repr` shows them"""


class Missing(Exception):
    """A step is not finished, and may not be done now."""


@dataclass
class Lab:
    """Steps are cached in `store` by their settings; trained runs are steps, too."""

    store: Store
    tools: Tools
    progress: Progress
    log: Path
    """what nerfstudio says"""
    only_finished: bool = False
    """raise `Missing` instead of doing a step"""
    used: dict[str, dict[str, Any]] = field(default_factory=dict)
    """file -> record of every step that was asked for"""
    _loaded: "OrderedDict[str, Any]" = field(default_factory=OrderedDict)

    def step(self, name: str, trainings: Sequence[Training], more: Mapping[str, Any], do: Callable[[], Any]) -> Any:
        """The result of `do`, which depends on these trainings and on the settings in `more`; JSON values.

        Raises:
            Missing: it would have to be done.
        """
        settings = {**more, "trainings": [self._settings(training) for training in trainings]}
        return self._done(name, settings, do)["result"]

    def config_path(self, training: Training) -> Path:
        """config.yml of the finished run; it is trained where it is not there."""
        settings = self._settings(training)
        of = key(settings)
        record = self.store.read("train", settings)
        if record is not None and Path(record["result"]["config"]).is_file():
            self.used[str(self.store.path("train", settings))] = record
            return Path(record["result"]["config"])
        self.store.path("train", settings).unlink(missing_ok=True)

        def train() -> dict[str, str]:
            title = f"{training.scene.name}: training {training.method}, {_changes(training)}"
            with self.progress.task(title, training.steps) as on_step:
                path = self.tools.train(training, of, on_step)
            # whole, as in config.yml itself: nerfstudio finds no checkpoint in a folder that was moved
            return {"config": str(path.resolve())}

        return Path(self._done("train", settings, train)["result"]["config"])

    def run(self, training: Training) -> Any:
        """The trained run, loaded."""
        of = key(self._settings(training))
        if of not in self._loaded:
            path = self.config_path(training)
            while len(self._loaded) >= _KEPT:
                self._loaded.popitem(last=False)
            with self.progress.task(f"{training.scene.name}: loading {training.method}", None), self._into_log():
                self._loaded[of] = self.load(training, path)
        self._loaded.move_to_end(of)
        return self._loaded[of]

    def load(self, training: Training, config: Path) -> Any:
        """The trained run of that config.yml, loaded anew.

        Raises:
            ExperimentError: its checkpoint is damaged, or gone.
        """
        try:
            return self.tools.load(config)
        except (ValueError, OSError) as error:
            step = self.store.path("train", self._settings(training))
            raise ExperimentError(
                f"{config.parent} cannot be loaded ({error}) Remove {step}, and it is trained again."
            ) from error

    def _done(self, name: str, settings: dict[str, Any], do: Callable[[], Any]) -> dict[str, Any]:
        record = self.store.read(name, settings)
        if record is None:
            if self.only_finished:
                raise Missing(name)
            start = time.perf_counter()
            with self._into_log():
                result = do()
            record = self.store.write(name, settings, result, time.perf_counter() - start)
        self.used[str(self.store.path(name, settings))] = record
        return record

    def _settings(self, training: Training) -> dict[str, Any]:
        with self._into_log():
            return training.settings(self.tools.defaults(training.method))

    @contextmanager
    def _into_log(self) -> Iterator[None]:
        """nerfstudio's remarks on what it does belong there, and not between the bars."""
        with self.log.open("a", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
            yield


def _changes(training: Training) -> str:
    named = [f"{name} {value}" for name, value in training.options.items()]
    return ", ".join([*(named if len(named) < 5 else named[:1]), f"seed {training.seed}"])
