"""When things happen in a training run. Step constants are for REFERENCE_STEPS and scale with the run's length."""

from dataclasses import dataclass

REFERENCE_STEPS = 30_000
"""length of the papers' runs"""


@dataclass(frozen=True)
class Schedule:
    """Steps of one run, already scaled."""

    num_levels: int
    """levels at the end of training, L"""
    level_interval: int
    """K: steps of each stage but the last"""
    refine_every: int
    """steps between two refinements (densification and pruning)"""
    refine_start: int
    """refinement begins after this step"""
    refine_stop: int
    """refinement ends at this step"""
    refine_pause: int
    """steps without refinement after a level was added"""
    reset_every: int
    """steps between two opacity resets"""
    reset_pause: int
    """steps without refinement after an opacity reset"""
    reset_stop: int
    """no opacity reset at or after this step"""
    screen_size_stop: int
    """splitting and pruning by screen size ends at this step"""
    sh_interval: int
    """steps between two degrees of spherical harmonics"""
    multiresolution: bool = True
    """stage m trains at 1 / 2^(L - m) of full size"""

    def stage(self, step: int) -> int:
        """Levels present at `step`: 1 from the start, one more every K steps, at most L."""
        return min(1 + step // self.level_interval, self.num_levels)

    def halvings(self, stage: int) -> int:
        """How often training images are halved in `stage`."""
        return self.num_levels - stage if self.multiresolution else 0

    def sh_degree(self, step: int, maximum: int) -> int:
        """Degree of spherical harmonics in use at `step`."""
        return min(step // self.sh_interval, maximum)

    def refines(self, step: int) -> bool:
        """Whether `step` is one of refinement, the pause after a new level respected."""
        stage = self.stage(step)
        since_level = step - (stage - 1) * self.level_interval
        paused = stage > 1 and since_level < self.refine_pause
        paused |= step % self.reset_every < self.reset_pause and self.last_reset(step) > 0
        return self.refine_start < step < self.refine_stop and step % self.refine_every == 0 and not paused

    def last_reset(self, step: int) -> int:
        """The last step at or before `step` on which opacities were reset; 0: none yet."""
        last = step // self.reset_every * self.reset_every
        return last if self.resets(last) else 0

    def drops_unneeded(self, step: int) -> bool:
        """Whether Gaussians that training views hardly show are removed at `step`: before each reset, and at the end.

        Not while a new level settles.
        """
        since_level = step - (self.stage(step) - 1) * self.level_interval
        settled = self.stage(step) == 1 or since_level >= self.refine_pause
        return settled and self.looks_at_views(step)

    def looks_at_views(self, step: int) -> bool:
        """Whether all training views are looked at: on steps of opacity resets until refinement ends, and then."""
        return (0 < step < self.refine_stop and step % self.reset_every == 0) or step == self.refine_stop

    def recovers(self, step: int) -> bool:
        """Whether opacities recover from a reset: for `reset_pause` steps."""
        last = self.last_reset(step)
        return last > 0 and step - last <= self.reset_pause

    def resets(self, step: int) -> bool:
        """Whether opacities are reset at `step`."""
        return 0 < step < min(self.reset_stop, self.refine_stop) and step % self.reset_every == 0


def scaled(steps: int, scale: float, least: int = 1) -> int:
    """`steps` of a reference run in a run `scale` times as long, at least `least`."""
    return max(least, round(steps * scale))
