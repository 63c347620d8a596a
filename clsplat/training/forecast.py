"""What reports of a training say about its course: PSNR over several views, and the time that is left."""

from collections.abc import Callable, Sequence
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

VIEWS = 5  # reports whose PSNR is averaged
LATEST = 3  # reports whose step time is averaged
TREND = 4  # reports that tell how fast the number of Gaussians grows
WIDE = 2.0  # of the number of Gaussians, largest by smallest: from there on the times tell what a Gaussian costs
USUAL = 0.6  # of the mean time by Gaussian is what one more costs, where they do not tell: the rest is per step
LEAST = 0.4  # of it, whatever they tell: on a busy machine they tell little


def over_views(psnrs: Sequence[float]) -> list[float]:
    """Return the mean of each PSNR and those of the reports before it: one is of one view, and views differ by many dB.

    Terminal, live page and reports show it.
    """
    return [fmean(psnrs[max(0, end - VIEWS) : end]) for end in range(1, len(psnrs) + 1)]


class Forecast:
    """The course of one training, up to `last_step`.  Rules that grow the model act until the step `growth_end`."""

    def __init__(self, last_step: int, growth_end: int) -> None:
        self.last_step, self.growth_end = last_step, growth_end
        self._psnrs: list[float] = []  # dB
        self._reports: list[tuple[int, int, float]] = []  # step, Gaussians, s a step

    @classmethod
    def of(cls, step: int, last_step: int, due: Sequence[Callable[[int], bool]]) -> "Forecast":
        """Return the forecast of a training after `step`; due: whether a rule acts at a step, for each of its rules."""
        later = range(last_step - 1, step, -1)  # none follows the last step
        return cls(last_step, next((one for one in later if any(rule(one) for rule in due)), step))

    def add(self, step: int, psnr: float, gaussians: int, seconds: float) -> None:
        """Take a report; seconds: the mean time of a step since the last one."""
        self._psnrs.append(psnr)
        self._reports.append((step, gaussians, seconds))

    @property
    def psnr(self) -> float:
        """dB, the mean over the views of the last reports."""
        return over_views(self._psnrs[-VIEWS:])[-1]

    @property
    def growth_known(self) -> bool:
        """Whether reports have shown how fast rules grow the model, or none will; else the time left is the least."""
        step, count, _ = self._reports[-1]
        return step >= self.growth_end or count > self._reports[0][1]

    @property
    def seconds_left(self) -> float:
        """The time until the last step, s.

        The time of a step is taken as linear in the number of Gaussians, and that number as growing on as it did in the
        last reports until the rules end.
        """
        steps, counts, seconds = (np.array(column, np.float64) for column in zip(*self._reports, strict=True))
        cost, left = self._cost(counts, seconds), self.last_step - steps[-1]
        now = float(seconds[-LATEST:].mean() + cost * (counts[-1] - counts[-LATEST:].mean()))
        growing = min(max(0.0, self.growth_end - steps[-1]), left)
        if growing == 0 or len(steps) < 2:
            return now * float(left)
        growth = (counts[-1] - counts[-TREND:][0]) / (steps[-1] - steps[-TREND:][0])
        later = now + max(0.0, cost * growth * growing)
        return float(growing * (now + later) / 2 + (left - growing) * later)

    @staticmethod
    def _cost(counts: NDArray[np.float64], seconds: NDArray[np.float64]) -> float:
        """The time that a Gaussian adds to a step, s: its share of the whole, or less."""
        most = float(seconds[-LATEST:].mean() / max(1.0, counts[-LATEST:].mean()))
        if counts.max() < WIDE * counts.min():
            return USUAL * most
        spread = counts - counts.mean()
        return min(max(float(spread @ seconds / (spread @ spread)), LEAST * most), most)
