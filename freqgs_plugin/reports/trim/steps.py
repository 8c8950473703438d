"""The steps of `freqgs trim`: each leaves something out, is measured, and is undone where it costs too much."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from freqgs_plugin.apps.harmonic_fit import HarmonicFits, fit_harmonics
from freqgs_plugin.apps.trimming import (
    Draft,
    decay_never_cuts,
    faintest,
    highest,
    most,
    never_drawn,
    without_decay,
    without_empty_levels,
)
from freqgs_plugin.reports.timing import Timing, interleaved
from freqgs_plugin.reports.trim.judge import Judge, Quality, attenuation_at, loss

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
    """Takes a run's scene through all steps."""

    def __init__(self, run: Any, max_loss: float, size: Callable[[Draft], int], say: Callable[[str], object]):
        self._run, self._allowed, self._size, self._say = run, max_loss, size, say
        self._judge = Judge(run)
        self._all, self._few = self._judge.views("train"), self._judge.views("train", _QUICK)
        self._held_out = self._judge.views("test")
        self.steps: list[Step] = []

    @torch.no_grad()
    def trim(self, old_size: int) -> list[Step]:
        """All steps; the first is the scene as it was."""
        draft = Draft.of(self._run.gaussians)
        self._say("the scene as it is")
        self._whole = self._judge.quality(draft.gaussians, "train", self._all)
        self._quick = self._judge.quality(draft.gaussians, "train", self._few)
        held_out = self._test(draft)
        self.steps = [Step("as trained", "", draft, self._whole, held_out, old_size)]
        text = "state of the optimizers, statistics of densification; level tags take a byte, and what is the same for "
        self._add("optimizer state", text + "all Gaussians is stored once", draft)
        self._remove_never_drawn()
        self._say("how much each training view shows of each Gaussian")
        weights = self._judge.weights(self._draft.gaussians)
        kept = self._remove_hardly_drawn(weights)
        self._cut_harmonics([weight[kept] for weight in weights])
        self._drop_idle_decay()
        self._drop_empty_levels()
        return self._timed()

    # -- what steps have in common --------------------------------------------------------------------------------

    @property
    def _draft(self) -> Draft:
        return self.steps[-1].draft

    def _test(self, draft: Draft) -> Quality | None:
        return self._judge.quality(draft.gaussians, "test", self._held_out) if self._held_out else None

    def _fits(self, draft: Draft, allowed: float) -> bool:
        quality = self._judge.quality(draft.gaussians, "train", self._few)
        return max(loss(self._quick, quality)[0], self._unseen_loss(draft, self._few, self._quick)) <= allowed

    def _whole_loss(self, draft: Draft) -> tuple[float, Quality]:
        quality = self._judge.quality(draft.gaussians, "train", self._all)
        return max(loss(self._whole, quality)[0], self._unseen_loss(draft, self._all, self._whole)), quality

    def _unseen_loss(self, draft: Draft, views: list[int], before: Quality) -> float:
        """Of a draft that was fitted to views, on views that its fit did not look at."""
        if not draft.unseen:
            return -math.inf
        sums: dict[str, float] = {}
        for parity, gaussians in enumerate(draft.unseen):
            part = [number for number in views if self._all.index(number) % 2 == parity]
            quality = self._judge.quality(gaussians, "train", part) if part else {}
            for name, value in quality.items():
                sums[name] = sums.get(name, 0.0) + value * len(part) / len(views)
        return loss(before, sums)[0]

    def _search(self, name: str, find: Callable[[float], Draft | None]) -> Draft | None:
        """What `find` makes of the loss allowed so far; of less, where all training views show that it costs more."""
        allowed = SHARES[name] * self._allowed
        for _ in range(_RETRIES):
            self._say(f"{name}: as much as costs {allowed:.3g} dB")
            draft = find(allowed)
            if draft is None or self._whole_loss(draft)[0] <= SHARES[name] * self._allowed:
                return draft
            allowed /= 2
        return None

    def _add(self, name: str, done: str, draft: Draft | None, more: str = "") -> None:
        """Note a step; `draft` None: it does nothing."""
        if draft is None:
            last = self.steps[-1]
            self.steps.append(replace(last, name=name, done=done, more=more))
            return
        train = self._whole_loss(draft)[1]
        self.steps.append(Step(name, done, draft, train, self._test(draft), self._size(draft), more))

    def _would(self, what: str, draft: Draft) -> str:
        """What going further would buy."""
        saved = self._size(self._draft) - self._size(draft)
        return f"{what} would save {saved / 1e6:.2f} MB, and cost {self._whole_loss(draft)[0]:.2f} dB"

    # -- the steps ------------------------------------------------------------------------------------------------

    def _remove_never_drawn(self) -> None:
        draft, name = self._draft, "never drawn"
        dead = never_drawn(draft.gaussians)
        count = int(dead.sum())
        if not count or count == len(draft):
            self._add(name, "no Gaussian is too faint to be drawn, or not finite", None)
            return
        found = draft.keep(~dead)
        if self._whole_loss(found)[0] > 0.02 * self._allowed + 1e-6:
            self._add(name, "nothing", None, self._would(f"removing {count:,} Gaussians that seem to be dead", found))
            return
        self._add(name, f"{count:,} Gaussians of opacity under 1/255, with a dead decay, or not finite", found)

    def _remove_hardly_drawn(self, weights: list[Tensor]) -> Tensor:
        """Remove Gaussians by the most that any training view shows of them; returns which rows are kept."""
        draft, name = self._draft, "hardly drawn"
        score = torch.stack(weights).amax(0).float()
        level = draft.gaussians.level

        def without(count: int) -> Draft:
            return draft.keep(~faintest(score, level, count))

        counts = [0]

        def find(allowed: float) -> Draft | None:
            counts.append(most(len(draft) - 1, lambda count: self._fits(without(count), allowed)))
            return without(counts[-1]) if counts[-1] else None

        found = self._search(name, find)
        if found is None:
            tenth = without(max(len(draft) // 10, 1))
            self._add(name, "every Gaussian is needed", None, self._would("the faintest tenth", tenth))
            return torch.ones(len(draft), dtype=torch.bool, device=score.device)
        drop = faintest(score, level, counts[-1])
        threshold = float(score[drop].max()) if bool(drop.any()) else 0.0
        self._add(name, f"{int(drop.sum()):,} Gaussians that make up under {threshold:.3g} px of every view", found)
        again = min(2 * counts[-1], len(draft) - 1)
        self.steps[-1] = replace(self.steps[-1], more=self._would("as many again", without(again)))
        return ~drop

    def _cut_harmonics(self, weights: list[Tensor]) -> None:
        base = self._draft
        degree = round((base.gaussians.features_rest.shape[1] + 1) ** 0.5) - 1
        if not degree:
            self._add("harmonics of all", "colours do not depend on the direction already", None)
            return
        cameras = [self._run.view("train", i).camera for i in self._all]
        fits = fit_harmonics(base.gaussians, cameras, weights)
        # what a fit is worth where it has not looked: to each half of the views, fitted by the other half alone
        halves = [self._all[1::2], self._all[::2]] if len(self._all) > 1 else [self._all] * 2
        others = [fit_harmonics(base.gaussians, [cameras[i] for i in h], [weights[i] for i in h]) for h in halves]
        cap = torch.full((len(base),), degree, device=base.rows.device)

        def cut(degrees: Tensor) -> Draft:
            degrees = torch.minimum(degrees, cap)
            crossed = tuple(other.apply(base.gaussians, degrees) for other in others)
            return replace(base, gaussians=fits.apply(base.gaussians, degrees), unseen=crossed)

        cap = self._cut_all(cap, degree, cut)
        cap = self._cut_levels(cap, base, cut)
        self._cut_each(cap, fits, cut)

    def _cut_all(self, cap: Tensor, degree: int, cut: Callable[[Tensor], Draft]) -> Tensor:
        name = "harmonics of all"
        chosen = [degree]

        def find(allowed: float) -> Draft | None:
            for d in range(degree):
                draft = cut(torch.full_like(cap, d))
                if self._fits(draft, allowed):
                    chosen.append(d)
                    return draft
            return None

        found = self._search(name, find)
        if found is None:
            more = self._would(f"degree {degree - 1} for all", cut(torch.full_like(cap, degree - 1)))
            self._add(name, f"the scene needs degree {degree}", None, more)
            return cap
        self._add(name, f"the scene needs degree {chosen[-1]} of {degree}", found)
        if chosen[-1]:
            lower = cut(torch.full_like(cap, chosen[-1] - 1))
            self.steps[-1] = replace(self.steps[-1], more=self._would(f"degree {chosen[-1] - 1} for all", lower))
        return torch.full_like(cap, chosen[-1])

    def _cut_levels(self, cap: Tensor, base: Draft, cut: Callable[[Tensor], Draft]) -> Tensor:
        name, level = "harmonics by level", base.gaussians.level
        present = torch.unique(level).tolist()
        if len(present) < 2 or not int(cap.max()):
            return cap
        tried = [cap]

        def find(allowed: float) -> Draft | None:
            degrees = cap.clone()
            for k in present:
                for d in range(int(cap.max())):
                    lower = torch.where(level == k, d, degrees)
                    if self._fits(cut(lower), allowed):
                        degrees = lower
                        break
            tried.append(degrees)
            return None if torch.equal(degrees, cap) else cut(degrees)

        found = self._search(name, find)
        degrees = cap if found is None else tried[-1]
        told = ", ".join(f"level {k}: {int(degrees[level == k].max())}" for k in present)
        self._add(name, f"degrees by level: {told}", found)
        return degrees

    def _cut_each(self, cap: Tensor, fits: HarmonicFits, cut: Callable[[Tensor], Draft]) -> None:
        name = "harmonics by Gaussian"
        if not int(cap.max()):
            return
        prices = [0.0]

        def at(price: float) -> Tensor:
            return torch.minimum(fits.degrees_at(price), cap)

        def find(allowed: float) -> Draft | None:
            price = highest(*fits.prices(), lambda price: self._fits(cut(at(price)), allowed))
            prices.append(price or 0.0)
            return None if price is None else cut(at(price))

        found = self._search(name, find)
        degrees = cap if found is None else at(prices[-1])
        counts = torch.bincount(degrees, minlength=int(cap.max()) + 1).tolist()
        told = ", ".join(f"{count:,} of degree {d}" for d, count in enumerate(counts))
        self._add(name, told, found)
        more = self._would("degree 0 for all", cut(torch.zeros_like(cap)))
        self.steps[-1] = replace(self.steps[-1], more=more)

    def _drop_idle_decay(self) -> None:
        draft, name = self._draft, "decay"
        if draft.gaussians.decay is None:
            return
        scale = self._judge.scales[-1]
        endless = replace(draft.gaussians, decay=torch.full_like(draft.gaussians.opacities, 1e4))
        cut = torch.zeros_like(draft.rows, dtype=torch.bool)
        for number in self._all:
            camera = self._run.view("train", number).camera
            attenuation: Any = attenuation_at(self._run, draft.gaussians, scale)
            margins = (attenuation.margin(g, camera) for g in (draft.gaussians, endless))
            cut |= ~decay_never_cuts(*margins)
        count = int(cut.sum())
        found = without_decay(draft)
        if count or self._whole_loss(found)[0] > self._allowed:
            done = f"kept: up to s_v = {scale:g} it decides over {count:,} of {len(draft):,} Gaussians"
            self._add(name, done, None)
            return
        self._add(name, f"up to s_v = {scale:g} it never cuts: opacities do not decay any more", found)

    def _drop_empty_levels(self) -> None:
        levels = without_empty_levels(self._draft.gaussians.level)[1]
        had = self._run.num_levels
        if had == 1:
            return
        if len(levels) == had:
            self._add("empty levels", "no level is empty", None)
            return
        gone = ", ".join(str(k) for k in range(1, had + 1) if k not in levels)
        self._add("empty levels", f"level {gone} of {had} holds nothing; the others are renumbered", self._draft)

    def _timed(self) -> list[Step]:
        self._say("times")
        camera = self._run.view("train", 0).camera
        names = {step.name: step.draft.gaussians for step in self.steps}
        timings = interleaved(
            {name: lambda g=gaussians: self._judge.picture(g, camera) for name, gaussians in names.items()}, 9
        )
        return [replace(step, render=timings[step.name]) for step in self.steps]
