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
MIN_FRACTION = 0.25  # of the amplitudes, kept at the smallest size of any photograph; as published


class Spectrum:
    """The amplitudes of images, summed over channels and all frequencies up to a bound."""

    def __init__(self, cumulative: Floats) -> None:
        """cumulative: sums up to equally spaced bounds from 0 to 1 times the highest frequency, [LEVELS + 1]."""
        self.cumulative = cumulative

    @classmethod
    def from_image(cls, image: NDArray[np.uint8]) -> "Spectrum":
        """Return the spectrum of an image, [height, width, 3]."""
        height, width = image.shape[:2]
        amplitudes = np.abs(scipy.fft.rfft2(image.astype(np.float32), axes=(1, 0))).sum(axis=2, dtype=np.float64)
        down, right = (np.abs(scipy.fft.fftfreq(size)) * 2 for size in (height, width))
        down = down[: height // 2 + 1]
        multiplicity = np.where((down == 0) | (down == 1), 1, 2)  # rfft returns only one of each conjugate pair
        bound = np.maximum(down[:, None], right[None, :])
        level = np.ceil(bound * LEVELS).astype(np.int64)
        sums = np.bincount(level.ravel(), (amplitudes * multiplicity[:, None]).ravel(), LEVELS + 1)
        return cls(np.cumsum(sums))

    @property
    def total(self) -> float:
        """The sum over all frequencies."""
        return float(self.cumulative[-1])

    def divisor(self, amplitude: float) -> float:
        """Return the downscale factor that keeps frequencies with this sum of amplitudes; inf for 0."""
        bounds = np.linspace(0, 1, LEVELS + 1)
        bound = float(np.interp(amplitude, self.cumulative, bounds))
        return 1 / bound if bound else np.inf

    def amplitude(self, divisor: float) -> float:
        """Return the sum of amplitudes that an image downscaled by `divisor` keeps."""
        return float(np.interp(1 / divisor, np.linspace(0, 1, LEVELS + 1), self.cumulative))


def knots(spectra: Sequence[Spectrum], until: float, largest: float) -> tuple[Floats, Floats]:
    """Return steps and downscale factors, which fall from at most `largest` to 1 at step `until`.

    Equal increments of the amplitudes take less and less time.  Without detail to gain, the factor is 1.
    """
    first = min(largest, *(spectrum.divisor(MIN_FRACTION * spectrum.total) for spectrum in spectra))
    mean = Spectrum(np.mean([spectrum.cumulative for spectrum in spectra], axis=0))
    lowest = mean.amplitude(first) if first > 1 else mean.total
    if not 0 < lowest < (1 - NO_DETAIL) * mean.total:
        return np.zeros(1), np.ones(1)
    amplitudes = np.linspace(lowest, mean.total, KNOTS)
    divisors = np.array([first, *(mean.divisor(amplitude) for amplitude in amplitudes[1:-1]), 1.0])
    return until * np.log(amplitudes / lowest) / np.log(mean.total / lowest), divisors


class DetailDivisor(Settings):
    """Increase the resolution with the frequency content of the photographs (DashGaussian, Chen et al. 2025).

    Training starts at a size that keeps a quarter of the amplitudes of the spectrum; equal increments of the amplitudes
    take less and less time.  The downscale factor is an integer that changes at edits.
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
        """The steps after which the size may change; after the last one, it is the full size."""
        first, last = count_fired(self.every, self.start) + 1, count_fired(self.every, self.until - 1) + 1
        return [fire_step(self.every, number) for number in range(first, last + 1)]

    def to_schedule(self, photographs: Iterable[NDArray[np.uint8]]) -> Points:
        """Return the downscale factor by step for training photographs, each [height, width, 3]."""
        steps, divisors = knots([Spectrum.from_image(image) for image in photographs], self.until, self.largest)

        def at(positions: Floats) -> Floats:
            """Interpolate linearly in the number of pixels."""
            pixels = np.interp(positions, steps, divisors**-2.0)
            return np.where(positions < self.until, np.floor(pixels**-0.5 + 1e-9), 1.0)

        candidates = np.array([1.0, *self.changes])
        sizes = at(candidates)
        changes = np.flatnonzero(np.diff(sizes)) + 1
        points = [[0.0, float(sizes[0])], *([float(candidates[i]) + 1, float(sizes[i])] for i in changes)]
        return Points(points=points, between="steps")


def describe_sizes(sizes: Points) -> str:
    """Describe the sizes of the photographs during training."""
    (_, first), *others = sizes.points
    if not others and first == 1:
        return "photographs are trained on at full size, since smaller ones would lose too much detail"
    later = [f"{_size_text(divisor)} from step {step:.0f}" for step, divisor in others]
    return f"photographs are trained on at {', '.join([f'{_size_text(first)} of their size', *later])}"


def _size_text(divisor: float) -> str:
    """Return the name of a size."""
    return "full size" if divisor == 1 else f"1/{divisor:g}"
