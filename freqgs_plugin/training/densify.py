"""Densification with level tags: gsplat's strategy and operators, told which level may grow and which are pruned.

Levels are an integer tensor, not a parameter: gsplat's operators copy tensors of the strategy's state along with the
rows that they duplicate, split or remove, so the tags travel there.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import duplicate, remove
from jaxtyping import Bool, Float
from torch import Tensor

from freqgs_plugin.training.schedule import Schedule

Growth = Literal["all", "newest", "own_prefix"]
_MOST_DROPPED = 0.9
"""share of all Gaussians above which `drop_unneeded` removes none"""
_TOP = 0.9
"""quantile of opacity that stands for Gaussians that are needed"""


@dataclass
class LevelStrategy(DefaultStrategy):
    """gsplat's DefaultStrategy on our schedule, aware of levels."""

    growth: Growth = "all"
    """which Gaussians may grow: `all` from the full image's gradient, only those of the `newest` level, or each level
    from the gradient of its `own_prefix`"""
    lower_prune_opa: float = 0.005
    """prune threshold of levels under the newest; what is over `prune_opa` stays, too, if it is over half of the 0.9
    quantile of theirs: where all are faint, after a reset or at small learning rates, that says nothing about one"""
    reset_levels: Literal["all", "newest"] = "all"
    """whose opacities are reset"""
    max_gaussians: int = 0
    """refinement adds none once there are this many; 0: no bound"""

    def observe(self, state: dict[str, Any], info: dict[str, Any], weight: Tensor | None) -> None:
        """Collect one step's 2D gradients, divided by `weight` [n]."""
        grads = info["means2d"].absgrad if self.absgrad else info["means2d"].grad
        grads, radii = grads[0], info["radii"][0]
        for key in ("grad2d", "count", "radii"):
            if state[key] is None:
                state[key] = torch.zeros(len(grads), dtype=grads.dtype, device=grads.device)
        statistics = state["grad2d"], state["count"], state["radii"]
        if grads.device.type == "cpu" and grads.dtype == torch.float32:
            from freqgs_plugin.training.compiled_statistics import observe

            tensors = (grads.contiguous(), grads.new_empty(0) if weight is None else weight, radii)
            arrays = (t.numpy() for t in (*tensors, *statistics))
            observe(next(arrays), next(arrays), next(arrays), info["width"], info["height"], *arrays)
        else:
            _observe_in_torch(grads, weight, radii, info["width"], info["height"], *statistics)

    def step(
        self,
        params: Any,
        optimizers: Any,
        state: dict[str, Any],
        step: int,
        schedule: Schedule,
    ) -> dict[str, int]:
        """Refine and reset as `schedule` says. Returns counts: duplicated, split, pruned, reset."""
        done = {}
        stage = schedule.stage(step)
        if schedule.refines(step) and state["count"] is not None:
            done["duplicated"], done["split"] = self._grow(params, optimizers, state, step, stage)
            done["pruned"] = self._prune(params, optimizers, state, step, stage)
            for key in ("grad2d", "count", "radii"):
                state[key].zero_()
        if schedule.resets(step):
            done["reset"] = self._reset(params, optimizers, state, stage)
        return done

    def _grow(self, params, optimizers: Any, state: dict[str, Any], step: int, stage: int) -> tuple[int, int]:
        if self.max_gaussians and len(params["means"]) >= self.max_gaussians:
            return 0, 0
        if self.growth == "newest":
            older = state["level"] < stage
            state["grad2d"][older] = 0
            state["radii"][older] = 0
        return self._grow_gs(params, optimizers, state, step)

    @torch.no_grad()
    def _prune(self, params, optimizers: Any, state: dict[str, Any], step: int, stage: int) -> int:
        opacity = torch.sigmoid(params["opacities"].flatten())
        lower = state["level"] < stage
        prune = opacity < torch.where(lower, self._lower_threshold(opacity[lower]), self.prune_opa)
        if step > self.reset_every:
            largest = torch.exp(params["scales"]).amax(-1)
            prune |= largest > self.prune_scale3d * state["scene_scale"]
            if step < self.refine_scale2d_stop_iter:
                prune |= state["radii"] > self.prune_scale2d
        return self.remove(params, optimizers, state, prune, opacity)

    def _lower_threshold(self, opacity: Float[Tensor, " n"]) -> float:
        if self.lower_prune_opa <= self.prune_opa or not len(opacity):
            return self.lower_prune_opa
        top = opacity.kthvalue(math.ceil(_TOP * len(opacity))).values
        return min(self.lower_prune_opa, max(self.prune_opa, float(top) / 2))

    @torch.no_grad()
    def drop_unneeded(
        self,
        params: Any,
        optimizers: Any,
        state: dict[str, Any],
        weights: list[Float[Tensor, " n"]],
        least_weight: float | int,
        least_views: int,
    ) -> int:
        """Remove what training views hardly show: `weights` are each view's `rendered_weight`, in pixels.

        A Gaussian goes if its weight over all views is under `least_weight`, or if it is above level 1 and fewer than
        `least_views` views show it with half a pixel's weight: nothing then says how it looks from elsewhere.
        None go where nearly all would: then the views show no scene to judge by.
        """
        stacked = torch.stack(weights)
        drop = stacked.sum(0) < least_weight
        drop |= ((stacked > 0.5).sum(0) < min(least_views, len(weights))) & (state["level"] > 1)
        if float(drop.float().mean()) > _MOST_DROPPED:
            return 0
        return self.remove(params, optimizers, state, drop, stacked.sum(0))

    @torch.no_grad()
    def remove(
        self, params: Any, optimizers: Any, state: dict[str, Any], drop: Bool[Tensor, " n"], worth: Float[Tensor, " n"]
    ) -> int:
        """Remove the rows in `drop`, but of each level keep the one of most `worth`. Returns how many went."""
        self._keep_levels(drop, worth, state["level"])
        if bool(drop.any()):
            remove(params=params, optimizers=optimizers, state=state, mask=drop)
        return int(drop.sum())

    def _keep_levels(self, drop: Tensor, worth: Tensor, level: Tensor) -> None:
        """Take the worthiest Gaussian of each level out of `drop` where all would go: an empty level cannot grow."""
        for k in torch.unique(level).tolist():
            rows = torch.where(level == k)[0]
            if bool(drop[rows].all()):
                drop[rows[worth[rows].argmax()]] = False

    @torch.no_grad()
    def _reset(self, params, optimizers: Any, state: dict[str, Any], stage: int) -> int:
        """Clamp opacities to twice the prune threshold, and forget their optimizer's state, as `reset_opa` does."""
        rows = torch.ones_like(state["level"], dtype=torch.bool)
        if self.reset_levels == "newest":
            rows = state["level"] == stage
        limit = torch.logit(torch.tensor(self.prune_opa * 2.0)).item()
        parameter = params["opacities"]
        parameter[rows] = parameter[rows].clamp(max=limit)
        for value in optimizers["opacities"].state[parameter].values():
            if value.shape == parameter.shape:
                value[rows] = 0
        return int(rows.sum())


def add_level(params, optimizers: Any, state: dict[str, Any], level: int, opacity: float | None = None) -> int:
    """Duplicate every Gaussian that is not of `level` with that level (Section 3.2); optimizers start afresh.

    Args:
        opacity: of the duplicates; None: as their originals.

    Returns:
        how many were added.
    """
    n = len(params["means"])
    for optimizer in optimizers.values():
        optimizer.state.clear()
    duplicate(params, optimizers, state, torch.ones(n, dtype=torch.bool, device=params["means"].device))  # pyright: ignore
    state["level"][n:] = level
    if opacity is not None:
        with torch.no_grad():
            logit = torch.logit(torch.tensor(opacity)).item()
            params["opacities"][n:] = params["opacities"][n:].clamp(max=logit)
    for key in ("grad2d", "count", "radii"):
        state[key] = None
    return n


def _observe_in_torch(
    grads: Float[Tensor, "n 2"], weight: Tensor | None, radii: Tensor, width: int, height: int,
    grad2d: Float[Tensor, " n"], count: Float[Tensor, " n"], largest: Float[Tensor, " n"],
) -> None:  # fmt: skip
    """`compiled_statistics.observe` on any device."""
    seen = radii > 0
    size = grads.new_tensor([width, height])
    norm = ((grads if weight is None else grads / weight[:, None]) * size / 2.0).norm(dim=-1)
    grad2d += torch.where(seen, norm, 0.0)
    count += seen.to(norm.dtype)
    # by a tensor: CUDA multiplies by the reciprocal of a number, which puts 6 of 120 px over a threshold of 0.05
    torch.maximum(largest, torch.where(seen, radii.to(norm.dtype) / size.max(), 0.0), out=largest)
