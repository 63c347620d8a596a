"""A city of boxes from the air: streets, pavements, houses with windows and roofs, and parks."""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from clsplat.data_tools.casting import World, camera_pose
from clsplat.data_tools.shapes import GOLDEN_ANGLE, Array, Cuboid, Shape, Vector, normalize
from clsplat.data_tools.still_life import PRIMES, mix, noise, scramble
from clsplat.data_tools.synthetic import SyntheticOptions

PITCH, LOT = 1.0, 0.72  # scene units: from one street to the next, and the side of what is between two
HEIGHTS = (0.18, 1.1)  # of houses
PARKS = 0.12  # share of the lots
FLIGHT = 2.5  # height of the cameras
TILTS = (10.0, 35.0)  # of the cameras from straight down, degrees
CITY_VERSION = 1  # increase it when the images change
PLASTIC = 1.32471795724474602596  # its powers spread points evenly over a square (Roberts 2018)
WALLS: tuple[Vector, ...] = ((0.62, 0.30, 0.20), (0.70, 0.62, 0.48), (0.42, 0.46, 0.52), (0.55, 0.20, 0.16))
ROOFS: tuple[Vector, ...] = ((0.34, 0.10, 0.06), (0.20, 0.21, 0.24), (0.46, 0.42, 0.36), (0.12, 0.24, 0.26))


def ground(half: float, p: Array) -> Array:
    """Streets between the lots of a city that reaches to `half`, meadows around it; the top is z = 0."""
    x, y = (axis / PITCH for axis in p[:2])
    across = [np.abs(axis - np.round(axis - 0.5) - 0.5) for axis in (x, y)]  # from the middle of the next street
    street, along = np.minimum(*across), np.where(across[0] < across[1], y, x)
    asphalt = mix((0.10, 0.10, 0.11), (0.17, 0.17, 0.18), noise(9 * p, 3))
    line = (street < 0.008) & (along * 8 % 1 < 0.55) & (np.maximum(*across) > 0.15)
    paved = mix((0.42, 0.40, 0.37), (0.30, 0.29, 0.28), (p[0] * 24 % 1 < 0.12) | (p[1] * 24 % 1 < 0.12))
    city = mix(mix(asphalt, (0.75, 0.72, 0.6), line), paved, street > 0.10)
    meadow = mix((0.10, 0.22, 0.05), (0.34, 0.36, 0.12), noise(1.5 * p, 4))
    return mix(city, meadow, np.maximum(np.abs(p[0]), np.abs(p[1])) > half)


def park(p: Array) -> Array:
    """Grass, with round flower beds and a path."""
    grass = mix((0.06, 0.20, 0.03), (0.22, 0.40, 0.08), noise(11 * p, 3))
    bed = np.hypot(p[0] * 6 % 1 - 0.5, p[1] * 6 % 1 - 0.5) < 0.18
    flowers = mix((0.65, 0.10, 0.20), (0.80, 0.65, 0.10), noise(20 * p) > 0.5)
    return mix(mix(grass, flowers, bed), (0.50, 0.44, 0.33), np.abs(p[0] - p[1]) < 0.035)


def house(half: Vector, wall: Vector, roof: Vector, p: Array) -> Array:
    """Walls with rows of windows, a roof with a rim, plates and a few ducts."""
    top = p[2] > half[2] - 1e-6
    side = np.where(np.abs(p[0]) > half[0] - 1e-6, p[1], p[0])
    u, v = side / 0.085 % 1, (p[2] + half[2]) / 0.11 % 1
    window = (np.abs(u - 0.5) < 0.28) & (np.abs(v - 0.55) < 0.27)
    glass = mix((0.03, 0.05, 0.08), (0.30, 0.36, 0.42), noise(7 * p))
    front = mix(mix(wall, (0.1, 0.08, 0.07), 0.4 * noise(40 * p, 2)), glass, window)
    margin = np.minimum(half[0] - np.abs(p[0]), half[1] - np.abs(p[1]))
    plates = mix(
        roof, (0.05, 0.05, 0.05), 0.6 * ((p[0] * 14 % 1 < 0.1) | (p[1] * 9 % 1 < 0.1)) + 0.3 * noise(30 * p, 2)
    )
    duct = (np.abs(p[0] * 4 % 1 - 0.5) < 0.14) & (np.abs(p[1] * 4 % 1 - 0.5) < 0.14) & (noise(3 * p) > 0.5)
    above = mix(mix(plates, (0.7, 0.7, 0.68), duct), (0.55, 0.53, 0.5), margin < 0.02)
    return mix(front, above, top)


def chance(x: int, y: int, purpose: int) -> float:
    """A number in [0, 1) that a lot has for one purpose."""
    key = np.array([(x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (purpose * PRIMES[2])], np.uint64)
    return float(scramble((key & np.uint64(0xFFFFFFFF)).astype(np.uint32))[0])


def lot(x: int, y: int, center: tuple[float, float]) -> list[Shape]:
    """What stands on a lot: a park, or a house with or without a tower."""
    if chance(x, y, 0) < PARKS:
        return [Cuboid(center=(*center, 0.01), half=(LOT / 2, LOT / 2, 0.01), paint=park)]
    height = HEIGHTS[0] + (HEIGHTS[1] - HEIGHTS[0]) * chance(x, y, 1) ** 2
    sides = [LOT / 2 * (0.72 + 0.28 * chance(x, y, purpose)) for purpose in (2, 3)]
    shapes = [(1.0, height, 4)] + ([(0.55, 0.5 * height, 6)] if chance(x, y, 8) < 0.4 else [])
    results: list[Shape] = []
    floor = 0.0
    for share, tall, purpose in shapes:
        half = (share * sides[0], share * sides[1], tall / 2)
        wall, roof = (kinds[int(4 * chance(x, y, purpose + i))] for i, kinds in enumerate((WALLS, ROOFS)))
        results.append(Cuboid(center=(*center, floor + tall / 2), half=half, paint=partial(house, half, wall, roof)))
        floor += tall
    return results


@dataclass(frozen=True)
class City(SyntheticOptions):
    """Options of a city: as for the still life, and its number of lots along each side."""

    size: int = 256
    train: int = 300
    test: int = 30
    lots: int = 12

    version = CITY_VERSION
    points = 20_000
    noise = 0.01

    @property
    def half(self) -> float:
        """Half of its side, scene units."""
        return self.lots * PITCH / 2

    @cached_property
    def world(self) -> World:
        """The ground, and what stands on the lots."""
        half, places = self.half, range(self.lots)
        reach = half + 6 * FLIGHT
        base = Cuboid(center=(0, 0, -0.1), half=(reach, reach, 0.1), paint=partial(ground, half))
        at = [(i + 0.5) * PITCH - half for i in places]
        return World((base, *(shape for x in places for y in places for shape in lot(x, y, (at[x], at[y])))), 0.9, 2)

    def poses(self) -> dict[str, list[Array]]:
        """Camera-to-world matrices: evenly spread above the city, oblique in all directions."""
        return {"train": self._flight(self.train, 0.5), "test": self._flight(self.test, 0.13)}

    def _flight(self, count: int, phase: float) -> list[Array]:
        number = np.arange(1, count + 1)
        across = np.stack([(phase + number / PLASTIC**power) % 1 for power in (1, 2)])
        heading, tilt = number * GOLDEN_ANGLE + phase, np.radians(TILTS[0] + (TILTS[1] - TILTS[0]) * (number % 3) / 2)
        backward = normalize(np.stack([np.sin(tilt) * np.cos(heading), np.sin(tilt) * np.sin(heading), np.cos(tilt)]))
        looked_at = np.stack([*((2 * across - 1) * self.half), np.zeros(count)])
        position = looked_at + backward * FLIGHT / backward[2]
        return [camera_pose(position[:, i], backward[:, i]) for i in range(count)]
