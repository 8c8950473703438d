"""Notices losses and gradients that are not finite, skips such steps, and names their cause."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor


class NonFiniteError(RuntimeError):
    """Training produced values that are not finite, too many steps in a row."""


@dataclass
class FiniteGuard:
    """Counts steps with a non-finite loss or gradient.

    A step is skipped by dropping all its gradients. The first such step is described in `first`; after `patience` in a
    row, `check` raises.
    """

    patience: int = 10
    """consecutive bad steps before training stops"""
    first: str = ""
    """what was wrong at the first bad step; empty where there was none"""
    first_step: int | None = None
    """the first bad step; None where there was none"""
    skipped: int = 0
    """bad steps so far, those before a run was continued included"""
    complete: bool = True
    """off: the run was continued from a checkpoint that does not say what happened before"""
    _in_a_row: int = field(default=0, repr=False)
    _bad_losses: list[str] = field(default_factory=list, repr=False)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"skipped": self.skipped, "first": self.first, "first_step": self.first_step, "complete": self.complete}

    def load_state(self, state: Mapping[str, Any] | None) -> None:
        """Go on from a checkpoint's `state`; None: it was written before checkpoints kept it."""
        state = {"complete": False} if state is None else state
        self.skipped, self.first = int(state.get("skipped", 0)), str(state.get("first", ""))
        self.first_step, self.complete = state.get("first_step"), bool(state["complete"])

    def note_losses(self, losses: Mapping[str, Tensor]) -> None:
        """Remember which parts of this step's loss are not finite."""
        self._bad_losses = [name for name, value in losses.items() if not math.isfinite(float(value.detach()))]

    def check(self, params: Mapping[str, Tensor], level: Tensor, step: int) -> bool:
        """Whether this step's gradients are finite; where they are not, they are dropped.

        Raises:
            NonFiniteError: the step is the `patience`-th bad one in a row; says what was first wrong, where and when.
        """
        # a sum is finite only if all terms are (or it overflows, which is just as bad): one pass, no mask
        bad = [n for n, p in params.items() if p.grad is not None and not math.isfinite(float(p.grad.sum()))]
        if not bad and not self._bad_losses:
            self._in_a_row = 0
            return True
        self.skipped += 1
        self._in_a_row += 1
        if not self.first:
            self.first, self.first_step = _describe(params, bad, self._bad_losses, level, step), step
        for parameter in params.values():
            parameter.grad = None
        if self._in_a_row >= self.patience:
            raise NonFiniteError(
                f"{self._in_a_row} steps in a row were not finite (now step {step}). First seen: {self.first}. "
                "Lower the learning rates, check the scene's points and images, or start from an earlier checkpoint."
            )
        return False


def _describe(params: Mapping[str, Tensor], bad: list[str], bad_losses: list[str], level: Tensor, step: int) -> str:
    parts = []
    if bad_losses:
        parts.append(f"loss {', '.join(bad_losses)}")
    for name in bad:
        grad = params[name].grad
        assert grad is not None
        rows = ~torch.isfinite(grad).flatten(1).all(-1)
        if len(rows) == len(level):
            found, counts = torch.unique(level[rows], return_counts=True)
            where = ", ".join(f"{int(c)} of level {int(k)}" for k, c in zip(found, counts, strict=True))
            parts.append(f"gradient of '{name}' at {int(rows.sum())} of {len(rows)} Gaussians ({where or 'overflow'})")
        else:
            parts.append(f"gradient of '{name}'")
    return f"step {step}: not finite: {'; '.join(parts)}"
