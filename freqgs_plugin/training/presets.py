"""Settings of the models that stand for something: the papers' own, and the plain model to compare with.

Each is registered as a method of its own (`method_configs`). Step constants are for runs of 30,000 steps.
"""

from collections.abc import Mapping
from typing import Any

from freqgs_plugin.training.schedule import REFERENCE_STEPS

Value = bool | int | float | str

LARGEST_SCALE = 7.0
"""s_max of clodsplat if not told otherwise: the largest of the paper's, and what measured best"""

PLAIN: Mapping[str, Any] = {
    "num_levels": 1,
    "densify_grad_thresh": 0.0008,
    "split_screen_size": 0.05,
    "dropout": 0.0,
    "opacity_penalty": 0.0,
    "size_penalty": 0.0,
    "least_weight": 0.0,
    "least_views": 0,
}
"""settings of lapsplat that make it splatfacto's algorithm: one level, no decay"""


def plain_at(halvings: int) -> Mapping[str, Any]:
    """The same, trained at `halvings` times halved size and no other: its second level never begins."""
    return {**PLAIN, "num_levels": halvings + 1, "level_interval": 100 * REFERENCE_STEPS, "coarse_growth_factor": 1.0}


LAPSPLAT_PAPER: Mapping[str, Any] = {
    "growth": "all",
    "coarse_growth_factor": 1.0,
    "lower_level_weight": 0.1,
    "stop_split_at": 30_000,
    "dft_size": "image",
    "split_screen_size": 0.05,
    "lower_cull_alpha_thresh": 0.1,
    "densify_grad_thresh": 0.0008,
    "dropout": 0.0,
    "opacity_penalty": 0.0,
    "size_penalty": 0.0,
    "least_weight": 0.0,
    "least_views": 0,
}
"""lapsplat as the paper on frequency-aware decomposition has it, where it says what it does"""

CLODSPLAT_PAPER: Mapping[str, Any] = {
    "largest_scale": 5.0,
    "full_detail_every": 0,
    "reg_gradient": "none",
    "dead_decay": "prune",
    "densify_compensate": False,
    "view_reference": "frustum_max",
    "soft_cut": False,
    "densify_grad_thresh": 0.0008,
    "split_screen_size": 0.05,
    "least_weight": 0.0,
    "least_views": 0,
}
"""clodsplat as the paper on continuous level of detail has it; its decays' learning rate does not fall, either"""

PAPER_DECAY_RATE = 1e-2
"""learning rate of the decays in that paper, from beginning to end"""
