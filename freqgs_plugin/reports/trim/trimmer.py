"""What the steps of `freqgs trim` share: a scene that shrinks, what it may cost, and what was noted of each step."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from freqgs_plugin.apps.trimming import Draft, finite_rows
from freqgs_plugin.reports.timing import Timing, interleaved
from freqgs_plugin.reports.trim.judge import Judge, Quality, loss

SHARES = {"hardly drawn": 0.5, "harmonics of all": 0.7, "harmonics by level": 0.85, "harmonics by Gaussian": 1.0}
"""how much of the loss allowed may be gone after a step"""
_QUICK = 24
"""views that a search looks at; what it finds is checked on all training views"""
_RETRIES = 3


@dataclass(frozen=True)
class Step:
    """What a step left out, and what is left."""

    name: str
    done: str
    """a sentence"""
    draft: Draft
    train: Quality
    test: Quality | None
    """None: no view is held out"""
    size: int
    """bytes of the checkpoint"""
    more: str = ""
    """what was not left out, and what it would have bought"""
    render: Timing | None = None
    """of the first training view, the whole scene"""


class Trimmer:
    """A run's scene, from which steps leave things out."""

    def __init__(self, run: Any, max_loss: float, size: Callable[[Draft], int], say: Callable[[str], object]):
        self.run, self.allowed, self.say = run, max_loss, say
        self.judge = Judge(run)
        self.all = self.judge.views("train")
        """numbers of the training views"""
        self.steps: list[Step] = []
        self._size = size
        self._few = self.judge.views("train", _QUICK)
        self._held_out = self.judge.views("test")

    def begin(self, old_size: int) -> None:
        """Measure the scene as it is."""
        draft = Draft.of(self.run.gaussians)
        finite = finite_rows(draft.gaussians)
        self.not_finite = int((~finite).sum())
        """Gaussians that are left out before anything is measured, because they cannot be drawn"""
        if self.not_finite:
            draft = draft.keep(finite)
        if not len(draft):
            raise ValueError("no Gaussian of the run is finite. Name an earlier checkpoint's run, or train again.")
        self.say("the scene as it is")
        self._whole = self.judge.quality(draft.gaussians, "train", self.all)
        self._quick = self.judge.quality(draft.gaussians, "train", self._few)
        self.steps = [Step("as trained", "", draft, self._whole, self._test(draft), old_size)]

    @property
    def draft(self) -> Draft:
        """What is left now."""
        return self.steps[-1].draft

    def _test(self, draft: Draft) -> Quality | None:
        return self.judge.quality(draft.gaussians, "test", self._held_out) if self._held_out else None

    def fits(self, draft: Draft, allowed: float) -> bool:
        """Whether a draft loses no more than `allowed` dB, on the views that searches look at."""
        quality = self.judge.quality(draft.gaussians, "train", self._few)
        if loss(self._quick, quality)[0] > allowed:
            return False
        return self._unseen_loss(draft, self._few, self._quick) <= allowed

    def whole_loss(self, draft: Draft) -> tuple[float, Quality]:
        """The largest loss on all training views, dB, and what they show."""
        quality = self.judge.quality(draft.gaussians, "train", self.all)
        return max(loss(self._whole, quality)[0], self._unseen_loss(draft, self.all, self._whole)), quality

    def _unseen_loss(self, draft: Draft, views: list[int], before: Quality) -> float:
        """Of a draft that was fitted to views, on views that its fit did not look at."""
        if not draft.unseen:
            return -math.inf
        sums: dict[str, float] = {}
        for parity, gaussians in enumerate(draft.unseen):
            part = [number for number in views if self.all.index(number) % 2 == parity]
            quality = self.judge.quality(gaussians, "train", part) if part else {}
            for name, value in quality.items():
                sums[name] = sums.get(name, 0.0) + value * len(part) / len(views)
        return loss(before, sums)[0]

    def search(self, name: str, find: Callable[[float], Draft | None]) -> Draft | None:
        """What `find` makes of the loss allowed so far; of less, where all training views show that it costs more."""
        allowed = SHARES[name] * self.allowed
        for _ in range(_RETRIES):
            self.say(f"{name}: as much as costs {allowed:.3g} dB")
            draft = find(allowed)
            if draft is None or self.whole_loss(draft)[0] <= SHARES[name] * self.allowed:
                return draft
            allowed /= 2
        return None

    def add(self, name: str, done: str, draft: Draft | None, more: str = "") -> None:
        """Note a step; `draft` None: it does nothing."""
        if draft is None:
            last = self.steps[-1]
            self.steps.append(replace(last, name=name, done=done, more=more))
            return
        train = self.whole_loss(draft)[1]
        self.steps.append(Step(name, done, draft, train, self._test(draft), self._size(draft), more))

    def would(self, what: str, draft: Draft) -> str:
        """What going further would buy."""
        saved = self._size(self.draft) - self._size(draft)
        return f"{what} would save {saved / 1e6:.2f} MB, and cost {self.whole_loss(draft)[0]:.2f} dB"

    def remark(self, more: str) -> None:
        """What the newest step did not leave out."""
        self.steps[-1] = replace(self.steps[-1], more=more)

    def timed(self) -> list[Step]:
        """All steps, with render times taken in turns."""
        self.say("times")
        camera = self.run.view("train", 0).camera
        names = {step.name: step.draft.gaussians for step in self.steps}
        timings = interleaved(
            {name: lambda g=gaussians: self.judge.picture(g, camera) for name, gaussians in names.items()}, 9
        )
        return [replace(step, render=timings[step.name]) for step in self.steps]
