"""What a compressed model may weigh, or lose."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from clsplat.errors import ConfigError, quoted

UNITS = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
EXPECTED = "expected a size such as 5MB, or a loss such as -0.1dB"


@dataclass(frozen=True)
class Point:
    """A file that was written and measured."""

    file: str  # in the folder of the search
    keep: float  # share of the Gaussians
    degree: int  # of the harmonics
    quality: str
    gaussians: int
    bytes: int
    psnr: float  # dB, of the file as it is read back
    ssim: float


@dataclass(frozen=True)
class Target:
    """A size, or a PSNR that is not to be missed."""

    text: str
    most: int | None = None  # bytes
    change: float | None = None  # dB, of the PSNR of the model

    @classmethod
    def of(cls, text: str) -> "Target":
        """Read '5MB' (1 MB = 10^6 bytes; MiB = 2^20) or '-0.1dB'.  Raises ConfigError."""
        found = re.fullmatch(r"\s*([+-]?\d+(?:\.\d*)?|[+-]?\.\d+)\s*([a-z]+)\s*", text, re.IGNORECASE | re.ASCII)
        unit = found[2].lower() if found else ""
        if found is None or unit not in (*UNITS, "db"):
            raise ConfigError(f"--target {quoted(text)}: {EXPECTED}")
        value = float(found[1])
        if not math.isfinite(value * UNITS.get(unit, 1)):
            raise ConfigError(f"--target {quoted(text)}: {EXPECTED}")
        if unit == "db":
            if value > 0:
                raise ConfigError(f"--target {quoted(text)}: a gain; {EXPECTED}")
            return cls(text.strip(), change=value)
        if value * UNITS[unit] < 1:
            raise ConfigError(f"--target {quoted(text)}: {EXPECTED}")
        return cls(text.strip(), most=int(value * UNITS[unit]))

    def is_met(self, point: Point, psnr: float) -> bool:
        """Return whether a file meets the target; psnr: of the model that it was made from, dB."""
        if self.most is not None:
            return point.bytes <= self.most
        return point.psnr >= psnr + (self.change or 0)

    def best(self, points: Sequence[Point], psnr: float) -> Point | None:
        """Return the best file for a size, or the smallest for a PSNR; None where none meets the target."""
        met = [point for point in points if self.is_met(point, psnr)]
        if self.most is not None:
            return max(met, key=lambda point: (point.psnr, -point.bytes), default=None)
        return min(met, key=lambda point: (point.bytes, -point.psnr), default=None)

    def nearest(self, points: Sequence[Point]) -> Point:
        """Return the file that misses the target least."""
        smallest, best = min(points, key=lambda point: point.bytes), max(points, key=lambda point: point.psnr)
        return best if self.most is None else smallest

    @property
    def remedy(self) -> str:
        """What to do where no file meets it."""
        if self.most is not None:
            return "give a larger size, or a smaller share of the Gaussians with --keep"
        return "allow a larger loss, or train for longer with --steps"

    def ends(self, rung: Sequence[Point], psnr: float) -> bool:
        """Return whether files of fewer Gaussians cannot be better: all of these fit, or none is good enough."""
        met = [self.is_met(point, psnr) for point in rung]
        return all(met) if self.most is not None else not any(met)
