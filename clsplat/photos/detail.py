"""Choose the resolution of photographs by step, from their frequency content (DashGaussian, Chen et al. 2025)."""

from collections.abc import Iterable, Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import EverySteps, Points, count_fired, fire_step
from clsplat.core.settings import Settings

Floats = NDArray[np.float64]
LEVELS = 2048  # frequency bounds, from 0 to the highest frequency of each direction
KNOTS = 32  # as published
NO_DETAIL = 1e-3  # of the amplitudes: the rounding of an image of one color
MIN_SHARE = 0.25  # of the amplitudes, at the smallest size of any photograph; as published


class Spectrum:
    """The amplitudes of images, summed over channels and all frequencies up to a bound."""

    def __init__(self, within: Floats) -> None:
        """within: sums up to equally spaced bounds from 0 to 1 times the highest frequency, [LEVELS + 1]."""
        self.within = within

    @classmethod
    def of(cls, image: NDArray[np.uint8]) -> "Spectrum":
        """Return the spectrum of an image, [height, width, 3]."""
        height, width = image.shape[:2]
        amplitudes = np.abs(scipy.fft.rfft2(image.astype(np.float32), axes=(1, 0))).sum(axis=2, dtype=np.float64)
        down, right = (np.abs(scipy.fft.fftfreq(size)) * 2 for size in (height, width))
        down = down[: height // 2 + 1]
        twice = np.where((down == 0) | (down == 1), 1, 2)  # rfft returns only one of each conjugate pair
        bound = np.maximum(down[:, None], right[None, :])
        level = np.ceil(bound * LEVELS).astype(np.int64)
        sums = np.bincount(level.ravel(), (amplitudes * twice[:, None]).ravel(), LEVELS + 1)
        return cls(np.cumsum(sums))

    @property
    def total(self) -> float:
        """The sum over all frequencies."""
        return float(self.within[-1])

    def divisor(self, amplitude: float) -> float:
        """Return the downscale factor that keeps frequencies with this sum of amplitudes; inf for 0."""
        bounds = np.linspace(0, 1, LEVELS + 1)
        bound = float(np.interp(amplitude, self.within, bounds))
        return 1 / bound if bound else np.inf

    def at(self, divisor: float) -> float:
        """Return the sum of amplitudes that an image downscaled by `divisor` keeps."""
        return float(np.interp(1 / divisor, np.linspace(0, 1, LEVELS + 1), self.within))


def knots(spectra: Sequence[Spectrum], until: float, largest: float) -> tuple[Floats, Floats]:
    """Return steps and downscale factors, which fall from at most `largest` to 1 at step `until`.

    Each further share of the amplitudes takes less time than the one before.  Without detail to gain, the factor is 1.
    """
    first = min(largest, *(spectrum.divisor(MIN_SHARE * spectrum.total) for spectrum in spectra))
    mean = Spectrum(np.mean([spectrum.within for spectrum in spectra], axis=0))
    least = mean.at(first) if first > 1 else mean.total
    if not 0 < least < (1 - NO_DETAIL) * mean.total:
        return np.zeros(1), np.ones(1)
    amplitudes = np.linspace(least, mean.total, KNOTS)
    divisors = np.array([first, *(mean.divisor(amplitude) for amplitude in amplitudes[1:-1]), 1.0])
    return until * np.log(amplitudes / least) / np.log(mean.total / least), divisors


class DetailDivisor(Settings):
    """Increase the resolution with the frequency content of the photographs (DashGaussian, Chen et al. 2025).

    Training starts at a size that keeps a quarter of the amplitudes of the spectrum; each further share of them takes
    less time than the one before.  The downscale factor is an integer that changes at edits.
    """

    step_keys: ClassVar[frozenset[str]] = frozenset({"until", "every", "start"})

    follows: Literal["detail"]
    """`detail`: the mean spectrum of the training photographs."""
    until: Annotated[int, Field(gt=0, le=10**6)]
    """Global step at which photographs are at full size; up to a million."""
    largest: Annotated[float, Field(ge=1)] = 8
    """Largest downscale factor."""
    every: EverySteps = 100
    """Steps between changes, as between edits; may be fractional."""
    start: Annotated[int, Field(ge=0)] = 500
    """Global step after which the size changes."""

    @property
    def changes(self) -> list[int]:
        """The steps after which the size may change; after the last it is the full size."""
        first, last = count_fired(self.every, self.start) + 1, count_fired(self.every, self.until - 1) + 1
        return [fire_step(self.every, number) for number in range(first, last + 1)]

    def of(self, photographs: Iterable[NDArray[np.uint8]]) -> Points:
        """Return the downscale factor by step for training photographs, each [height, width, 3]."""
        steps, divisors = knots([Spectrum.of(image) for image in photographs], self.until, self.largest)

        def at(positions: Floats) -> Floats:
            """Interpolate linearly in the number of pixels."""
            pixels = np.interp(positions, steps, divisors**-2.0)
            return np.where(positions < self.until, np.floor(pixels**-0.5 + 1e-9), 1.0)

        tried = np.array([1.0, *self.changes])
        sizes = at(tried)
        differs = np.flatnonzero(np.diff(sizes)) + 1
        points = [[0.0, float(sizes[0])], *([float(tried[i]) + 1, float(sizes[i])] for i in differs)]
        return Points(points=points, between="steps")


def course(sizes: Points) -> str:
    """Describe at which sizes photographs are trained on."""
    (_, first), *rest = sizes.points
    if not rest and first == 1:
        return "photographs are trained on at full size, since smaller ones would lose too much detail"
    later = [f"{share(divisor)} from step {step:.0f}" for step, divisor in rest]
    return f"photographs are trained on at {', '.join([f'{share(first)} of their size', *later])}"


def share(divisor: float) -> str:
    """Name a size."""
    return "full size" if divisor == 1 else f"1/{divisor:g}"
