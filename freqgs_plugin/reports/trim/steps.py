"""The steps of `freqgs trim`: each leaves something out, is measured, and is undone where it costs too much."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from freqgs_plugin.apps.trimming import (
    Draft,
    decay_never_cuts,
    faintest,
    most,
    never_drawn,
    without_decay,
    without_empty_levels,
)
from freqgs_plugin.reports.trim.harmonics import cut_harmonics
from freqgs_plugin.reports.trim.judge import attenuation_at
from freqgs_plugin.reports.trim.trimmer import Step, Trimmer


@torch.no_grad()
def trim(t: Trimmer, old_size: int) -> list[Step]:
    """All steps; the first is the scene as it was, in a checkpoint of `old_size` bytes."""
    t.begin(old_size)
    text = "state of the optimizers, statistics of densification; level tags take a byte, and what is the same for all "
    t.add("optimizer state", text + "Gaussians is stored once", t.draft)
    remove_never_drawn(t)
    t.say("how much each training view shows of each Gaussian")
    weights = t.judge.weights(t.draft.gaussians)
    kept = remove_hardly_drawn(t, weights)
    cut_harmonics(t, [weight[kept] for weight in weights])
    drop_idle_decay(t)
    drop_empty_levels(t)
    return t.timed()


def remove_never_drawn(t: Trimmer) -> None:
    """Remove what no view from anywhere shows."""
    draft, name = t.draft, "never drawn"
    dead = never_drawn(draft.gaussians)
    count, gone = int(dead.sum()), f"{t.not_finite:,} Gaussians that are not finite" if t.not_finite else ""
    if not count or count == len(draft):
        t.add(name, gone or "no Gaussian is too faint to be drawn, or not finite", None)
        return
    found = draft.keep(~dead)
    if t.whole_loss(found)[0] > 0.02 * t.allowed + 1e-6:
        t.add(name, gone, None, t.would(f"removing {count:,} Gaussians that seem to be dead", found))
        return
    faint = f"{count:,} Gaussians of opacity under 1/255, or with a dead decay"
    t.add(name, f"{gone}; {faint}" if gone else faint, found)


def remove_hardly_drawn(t: Trimmer, weights: list[Tensor]) -> Tensor:
    """Remove Gaussians by the most that any training view shows of them; returns which rows are kept."""
    draft, name = t.draft, "hardly drawn"
    score = torch.stack(weights).amax(0).float()
    level = draft.gaussians.level

    def without(count: int) -> Draft:
        return draft.keep(~faintest(score, level, count))

    counts = [0]

    def find(allowed: float) -> Draft | None:
        counts.append(most(len(draft) - 1, lambda count: t.fits(without(count), allowed)))
        return without(counts[-1]) if counts[-1] else None

    found = t.search(name, find)
    if found is None:
        tenth = without(max(len(draft) // 10, 1))
        t.add(name, "every Gaussian is needed", None, t.would("the faintest tenth", tenth))
        return torch.ones(len(draft), dtype=torch.bool, device=score.device)
    drop = faintest(score, level, counts[-1])
    threshold = float(score[drop].max()) if bool(drop.any()) else 0.0
    t.add(name, f"{int(drop.sum()):,} Gaussians that make up under {threshold:.3g} px of every view", found)
    again = min(2 * counts[-1], len(draft) - 1)
    t.remark(t.would("as many again", without(again)))
    return ~drop


def drop_idle_decay(t: Trimmer) -> None:
    """Let opacities not decay where that decides about no Gaussian."""
    draft, name = t.draft, "decay"
    if draft.gaussians.decay is None:
        return
    scale = t.judge.scales[-1]
    endless = replace(draft.gaussians, decay=torch.full_like(draft.gaussians.opacities, 1e4))
    cut = torch.zeros_like(draft.rows, dtype=torch.bool)
    for number in t.all:
        camera = t.run.view("train", number).camera
        attenuation: Any = attenuation_at(t.run, draft.gaussians, scale)
        margins = (attenuation.margin(g, camera) for g in (draft.gaussians, endless))
        cut |= ~decay_never_cuts(*margins)
    count = int(cut.sum())
    found = without_decay(draft)
    if count or t.whole_loss(found)[0] > t.allowed:
        done = f"kept: up to s_v = {scale:g} it decides over {count:,} of {len(draft):,} Gaussians"
        t.add(name, done, None)
        return
    t.add(name, f"up to s_v = {scale:g} it never cuts: opacities do not decay any more", found)


def drop_empty_levels(t: Trimmer) -> None:
    """Note which levels hold nothing: writing the run renumbers the others."""
    levels = without_empty_levels(t.draft.gaussians.level)[1]
    had = t.run.num_levels
    if had == 1:
        return
    if len(levels) == had:
        t.add("empty levels", "no level is empty", None)
        return
    gone = ", ".join(str(k) for k in range(1, had + 1) if k not in levels)
    t.add("empty levels", f"level {gone} of {had} holds nothing; the others are renumbered", t.draft)
