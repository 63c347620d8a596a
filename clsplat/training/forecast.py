"""What reports of a training say about its course: PSNR over several views, and the time that is left."""

from collections import deque
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

VIEWS = 5  # reports whose PSNR is averaged: each is of one view, and views differ by many dB
LATEST = 3  # reports whose step time is averaged
TREND = 4  # reports that tell how fast the number of Gaussians grows
WIDE = 2.0  # of the number of Gaussians, largest by smallest: from there on the times tell what a Gaussian costs
USUAL = 0.6  # of the mean time by Gaussian is what one more costs, where they do not tell: the rest is per step


class Forecast:
    """The course of one training.  Rules that grow the model act until the step `growth_end`."""

    def __init__(self, growth_end: int) -> None:
        self.growth_end = growth_end
        self._psnr: deque[float] = deque(maxlen=VIEWS)  # dB
        self._reports: list[tuple[int, int, float]] = []  # step, Gaussians, s a step

    def add(self, step: int, psnr: float, gaussians: int, seconds: float) -> None:
        """Take a report; seconds: the mean time of a step since the last one."""
        self._psnr.append(psnr)
        self._reports.append((step, gaussians, seconds))

    @property
    def psnr(self) -> float:
        """dB, the mean over the views of the last reports."""
        return fmean(self._psnr)

    @property
    def growth_unknown(self) -> bool:
        """Whether rules will grow the model, and no report has shown yet how fast: the time left is the least."""
        step, count, _ = self._reports[-1]
        return step < self.growth_end and count <= self._reports[0][1]

    def seconds_left(self, last_step: int) -> float:
        """Return the time until a step, s.

        The time of a step is taken as linear in the number of Gaussians, and that number as growing on as it did in the
        last reports until the rules end.
        """
        steps, counts, seconds = (np.array(column, np.float64) for column in zip(*self._reports, strict=True))
        now, left = float(seconds[-LATEST:].mean()), last_step - steps[-1]
        growing = min(max(0.0, self.growth_end - steps[-1]), left)
        if growing == 0 or len(steps) < 2:
            return now * float(left)
        growth = (counts[-1] - counts[-TREND:][0]) / (steps[-1] - steps[-TREND:][0])
        later = now + max(0.0, self._cost(counts, seconds) * growth * growing)
        return float(growing * (now + later) / 2 + (left - growing) * later)

    @staticmethod
    def _cost(counts: NDArray[np.float64], seconds: NDArray[np.float64]) -> float:
        """The time that a Gaussian adds to a step, s: no less than none, no more than its share of the whole."""
        most = float(seconds[-LATEST:].mean() / max(1.0, counts[-LATEST:].mean()))
        if counts.max() < WIDE * counts.min():
            return USUAL * most
        spread = counts - counts.mean()
        return min(max(float(spread @ seconds / (spread @ spread)), 0.0), most)
