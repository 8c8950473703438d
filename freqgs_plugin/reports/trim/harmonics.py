"""How much of its harmonics a scene needs: as a whole, by level, and for each Gaussian."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from freqgs_plugin.apps.harmonic_fit import HarmonicFits, fit_harmonics
from freqgs_plugin.apps.trimming import Draft, highest
from freqgs_plugin.reports.trim.trimmer import Trimmer


def cut_harmonics(t: Trimmer, weights: list[Tensor]) -> None:
    """Lower the degree of all, of each level, of each Gaussian; `weights` are each training view's, pixels."""
    base = t.draft
    degree = round((base.gaussians.features_rest.shape[1] + 1) ** 0.5) - 1
    if not degree:
        t.add("harmonics of all", "colours do not depend on the direction already", None)
        return
    cameras = [t.run.view("train", i).camera for i in t.all]
    fits = fit_harmonics(base.gaussians, cameras, weights)
    # what a fit is worth where it has not looked: to each half of the views, fitted by the other half alone
    halves = [t.all[1::2], t.all[::2]] if len(t.all) > 1 else [t.all] * 2
    others = [fit_harmonics(base.gaussians, [cameras[i] for i in h], [weights[i] for i in h]) for h in halves]
    cap = torch.full((len(base),), degree, device=base.rows.device)

    def cut(degrees: Tensor) -> Draft:
        degrees = torch.minimum(degrees, cap)
        crossed = tuple(other.apply(base.gaussians, degrees) for other in others)
        return replace(base, gaussians=fits.apply(base.gaussians, degrees), unseen=crossed)

    cap = _cut_all(t, cap, degree, cut)
    cap = _cut_levels(t, cap, base, cut)
    _cut_each(t, cap, fits, cut)


def _cut_all(t: Trimmer, cap: Tensor, degree: int, cut: Callable[[Tensor], Draft]) -> Tensor:
    name = "harmonics of all"
    chosen = [degree]

    def find(allowed: float) -> Draft | None:
        for d in range(degree):
            draft = cut(torch.full_like(cap, d))
            if t.fits(draft, allowed):
                chosen.append(d)
                return draft
        return None

    found = t.search(name, find)
    if found is None:
        more = t.would(f"degree {degree - 1} for all", cut(torch.full_like(cap, degree - 1)))
        t.add(name, f"the scene needs degree {degree}", None, more)
        return cap
    t.add(name, f"the scene needs degree {chosen[-1]} of {degree}", found)
    if chosen[-1]:
        lower = cut(torch.full_like(cap, chosen[-1] - 1))
        t.remark(t.would(f"degree {chosen[-1] - 1} for all", lower))
    return torch.full_like(cap, chosen[-1])


def _cut_levels(t: Trimmer, cap: Tensor, base: Draft, cut: Callable[[Tensor], Draft]) -> Tensor:
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
                if t.fits(cut(lower), allowed):
                    degrees = lower
                    break
        tried.append(degrees)
        return None if torch.equal(degrees, cap) else cut(degrees)

    found = t.search(name, find)
    degrees = cap if found is None else tried[-1]
    told = ", ".join(f"level {k}: {int(degrees[level == k].max())}" for k in present)
    t.add(name, f"degrees by level: {told}", found)
    return degrees


def _cut_each(t: Trimmer, cap: Tensor, fits: HarmonicFits, cut: Callable[[Tensor], Draft]) -> None:
    name = "harmonics by Gaussian"
    if not int(cap.max()):
        return
    prices = [0.0]

    def at(price: float) -> Tensor:
        return torch.minimum(fits.degrees_at(price), cap)

    def find(allowed: float) -> Draft | None:
        price = highest(*fits.prices(), lambda price: t.fits(cut(at(price)), allowed))
        prices.append(price or 0.0)
        return None if price is None else cut(at(price))

    found = t.search(name, find)
    degrees = cap if found is None else at(prices[-1])
    counts = torch.bincount(degrees, minlength=int(cap.max()) + 1).tolist()
    told = ", ".join(f"{count:,} of degree {d}" for d, count in enumerate(counts))
    t.add(name, told, found)
    more = t.would("degree 0 for all", cut(torch.zeros_like(cap)))
    t.remark(more)
