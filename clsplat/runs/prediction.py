"""What a pipeline took in few steps, and what that tells of more of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

TREND = 0.5  # steepest power of the number of steps that the time of one is taken to follow
EARLY, SOON = 0.25, 0.6  # shares of the training between which it is corrected, where growth ends
TWICE = 0.4, 0.8  # where growth ends later
FEW = 200  # steps, where the search for their number begins


@dataclass(frozen=True)
class Rehearsal:
    """What a pipeline took in few steps."""

    steps: int
    course: Sequence[float]  # s, a training step, in each of equal parts of the training
    during: float  # s, of edits and measurements of the training: the same in any number of steps
    after: float  # s, of what follows the training
    growth: float  # the share of the steps after which no Gaussian grew

    @property
    def known(self) -> Sequence[float]:
        """The shares of the training at which the number of steps is corrected: where growth ends, if that is soon."""
        return [max(EARLY, self.growth)] if self.growth <= SOON else TWICE

    @property
    def step(self) -> float:
        """The mean time of a step, s."""
        return fmean(self.course)

    def later(self, share: float) -> tuple[float, float]:
        """How many times as long as at a share of the training steps take after it, in the mean and at the end."""
        place = min(int(share * len(self.course)), len(self.course) - 1)
        after = self.course[place + 1 :] or self.course[-1:]
        return fmean(after) / self.course[place], self.course[-1] / self.course[place]


def predicted(rehearsals: Sequence[Rehearsal], steps: int) -> float:
    """Return the time of a number of steps, in s, from rehearsals in growing numbers of steps.

    The time of a step is a power of their number, as the last two rehearsals have it: a model that trains longer has
    more Gaussians, and smaller ones.
    """
    *_, last = rehearsals
    power = 0.0
    if len(rehearsals) > 1:
        before = rehearsals[-2]
        power = math.log(last.step / before.step) / math.log(last.steps / before.steps)
        power = min(max(power, -TREND), TREND)
    return last.during + last.after + steps * last.step * math.pow(steps / last.steps, power)


def most_steps(rehearsals: Sequence[Rehearsal], seconds: float) -> int:
    """Return the largest number of steps that are predicted to take no longer than `seconds`; 0 where none is."""
    low, high = 0, FEW
    while predicted(rehearsals, high) <= seconds:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if predicted(rehearsals, middle) <= seconds else (low, middle)
    return low
