"""Choose the resolution of photographs in each step from their frequency content (DashGaussian, Chen et al. 2025)."""

from collections.abc import Iterable, Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.schedule import EverySteps, Points, count_fired, fire_step
from clsplat.core.settings import Settings

Floats = NDArray[np.float64]
LEVELS = 2048  # number of frequency bounds from 0 to the highest frequency in each direction
KNOTS = 32  # number of knots of the schedule; as published
NO_DETAIL = 1e-3  # fraction of the amplitudes that is due to rounding in an image of a single color
MIN_FRACTION = 0.25  # fraction of the amplitudes that each photograph keeps at the smallest size; as published


class Spectrum:
    """The cumulative amplitudes of an image, summed over its channels and all frequencies up to a bound."""

    def __init__(self, cumulative: Floats) -> None:
        """cumulative: sums up to equally spaced bounds from 0 to 1 times the highest frequency, [LEVELS + 1]."""
        self.cumulative = cumulative

    @classmethod
    def from_image(cls, image: NDArray[np.uint8]) -> "Spectrum":
        """Compute the spectrum of an image, [height, width, 3]."""
        height, width = image.shape[:2]
        amplitudes = np.abs(scipy.fft.rfft2(image.astype(np.float32), axes=(1, 0))).sum(axis=2, dtype=np.float64)
        vertical, horizontal = (np.abs(scipy.fft.fftfreq(size)) * 2 for size in (height, width))
        vertical = vertical[: height // 2 + 1]
        multiplicity = np.where((vertical == 0) | (vertical == 1), 1, 2)  # rfft returns only one of each conjugate pair
        bound = np.maximum(vertical[:, None], horizontal[None, :])
        level = np.ceil(bound * LEVELS).astype(np.int64)
        sums = np.bincount(level.ravel(), (amplitudes * multiplicity[:, None]).ravel(), LEVELS + 1)
        return cls(np.cumsum(sums))

    @property
    def total(self) -> float:
        """The sum of the amplitudes of all frequencies."""
        return float(self.cumulative[-1])

    def divisor(self, amplitude: float) -> float:
        """Return the downscale factor that keeps frequencies with this sum of amplitudes; infinity for a sum of 0."""
        bounds = np.linspace(0, 1, LEVELS + 1)
        bound = float(np.interp(amplitude, self.cumulative, bounds))
        return 1 / bound if bound else np.inf

    def amplitude(self, divisor: float) -> float:
        """Return the sum of amplitudes that an image downscaled by `divisor` keeps."""
        return float(np.interp(1 / divisor, np.linspace(0, 1, LEVELS + 1), self.cumulative))


def compute_knots(spectra: Sequence[Spectrum], until: float, max_divisor: float) -> tuple[Floats, Floats]:
    """Return the steps and the downscale factors of a schedule, which fall from at most `max_divisor` to 1 at `until`.

    Equal increments of the summed spectral amplitudes take fewer and fewer steps.  If there is no detail to gain, the
    factor is always 1.
    """
    first_divisor = min(max_divisor, *(spectrum.divisor(MIN_FRACTION * spectrum.total) for spectrum in spectra))
    mean = Spectrum(np.mean([spectrum.cumulative for spectrum in spectra], axis=0))
    lowest = mean.amplitude(first_divisor) if first_divisor > 1 else mean.total
    if not 0 < lowest < (1 - NO_DETAIL) * mean.total:
        return np.zeros(1), np.ones(1)
    amplitudes = np.linspace(lowest, mean.total, KNOTS)
    divisors = np.array([first_divisor, *(mean.divisor(amplitude) for amplitude in amplitudes[1:-1]), 1.0])
    return until * np.log(amplitudes / lowest) / np.log(mean.total / lowest), divisors


class DetailDivisor(Settings):
    """Increase the resolution with the frequency content of the photographs (DashGaussian, Chen et al. 2025).

    Training starts at a size that keeps a quarter of the amplitudes of the spectrum.  Each increment of the
    amplitudes then takes fewer steps than the previous one.  The downscale factor is an integer that changes at edits.
    """

    step_keys: ClassVar[frozenset[str]] = frozenset({"until", "every", "start"})

    follows: Literal["detail"]
    """`detail`: the mean spectrum of the training photos."""
    until: Annotated[int, Field(gt=0, le=10**6)]
    """Global step from which photos are at full size; at most a million."""
    largest: Annotated[float, Field(ge=1)] = 8
    """Largest downscale factor."""
    every: EverySteps = 100
    """Steps between possible changes of the size; may be fractional."""
    start: Annotated[int, Field(ge=0)] = 500
    """Global step after which the size changes."""

    @property
    def changes(self) -> list[int]:
        """The global steps after which the size may change.  After the last of them, photographs are at full size."""
        first, last = count_fired(self.every, self.start) + 1, count_fired(self.every, self.until - 1) + 1
        return [fire_step(self.every, number) for number in range(first, last + 1)]

    def to_schedule(self, photographs: Iterable[NDArray[np.uint8]]) -> Points:
        """Compute the schedule of the downscale factor from the training photographs, each [height, width, 3]."""
        knot_steps, divisors = compute_knots(
            [Spectrum.from_image(image) for image in photographs], self.until, self.largest
        )

        def interpolate(steps: Floats) -> Floats:
            """Return the downscale factors at steps, interpolated linearly in the number of pixels."""
            pixels = np.interp(steps, knot_steps, divisors**-2.0)
            return np.where(steps < self.until, np.floor(pixels**-0.5 + 1e-9), 1.0)

        steps = np.array([1.0, *self.changes])
        factors = interpolate(steps)
        changes = np.flatnonzero(np.diff(factors)) + 1
        points = [[0.0, float(factors[0])], *([float(steps[i]) + 1, float(factors[i])] for i in changes)]
        return Points(points=points, between="steps")


def describe_sizes(sizes: Points) -> str:
    """Return a sentence about the sizes of the photographs during training.  sizes: the downscale factor by step."""
    (_, first_divisor), *changes = sizes.points
    if not changes and first_divisor == 1:
        return "training uses photos at full size, since smaller ones would lose too much detail"
    clauses = [f"{_describe_size(divisor)} from step {step:.0f}" for step, divisor in changes]
    return f"training uses photos at {', '.join([f'{_describe_size(first_divisor)} of their size', *clauses])}"


def _describe_size(divisor: float) -> str:
    """Return a downscale factor in words, such as `1/2`."""
    return "full size" if divisor == 1 else f"1/{divisor:g}"
