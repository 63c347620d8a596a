"""The demo scene: a still life that an analytic ray caster photographs, so that every camera is known exactly.

    primary ray -> closest shape -> paint x (key light x shadow + sky x openness) -> mean of the pixel's samples

Arrays hold planes: points and directions are [3, R] (or [3, 1], which broadcasts), one column per ray.  The world is
z up, the table top is z = 0, lengths are scene units.  Colours are linear light until `photograph` stores them.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from clsplat.errors import DataError, OutputError
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Paint = Callable[[Array], Array]  # points in the shape's own axes [3, R] -> albedo [3, R]

SCENE_VERSION = 1  # raise it when the pictures change, so that an older folder is not taken for a current one
SCENE_RADIUS = 1.25
TARGET = np.array([0.0, 0.0, 0.08])
CAMERA_DISTANCE = 3.75
CAMERA_ANGLE_X = 0.69  # field of view that just holds the table, radians
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
GRID = 4  # a pixel is the mean of GRID x GRID rays
BLOCK = 65536  # rays at a time, measured: fewer pay for calls, more for memory
SKIN = 1e-6  # secondary rays start this far above the surface
PRIMES = (0x8DA6B343, 0xD8163841, 0xCB1AB31F)  # spatial hash
POINT_COUNT = 8000
POINT_NOISE = 0.002 * SCENE_RADIUS


# ---- vectors


def dot(a: Array, b: Array) -> Array:
    """Sum of products over the first axis, [R]."""
    total: Array = a[0] * b[0]
    for i in range(1, len(a)):
        total = total + a[i] * b[i]
    return total


def rotate(matrix: Array, v: Array) -> Array:
    """Apply a [3, 3] matrix to columns [3, R]; no BLAS, whose rounding may depend on its threads."""
    return np.asarray(matrix[:, :1] * v[0] + matrix[:, 1:2] * v[1] + matrix[:, 2:] * v[2])


def unit(v: Array) -> Array:
    """Scale columns to length 1."""
    return np.asarray(v / np.sqrt(dot(v, v)))


def align(axis: Array, x: float, y: float, z: Array | float) -> Array:
    """Turn (x, y, z) so that z lies along the unit columns `axis` (Duff et al. 2017)."""
    sign = np.copysign(1.0, axis[2])
    a = -1 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    right = np.array([1 + sign * axis[0] * axis[0] * a, sign * b, -sign * axis[0]])
    up = np.array([b, sign + axis[1] * axis[1] * a, -axis[1]])
    return np.asarray(x * right + y * up + z * axis)


def disc(count: int) -> Array:
    """Points spread evenly over the unit disc (Vogel's spiral), [2, count]."""
    radius, angle = np.sqrt((np.arange(count) + 0.5) / count), np.arange(count) * GOLDEN_ANGLE
    return np.array([radius * np.cos(angle), radius * np.sin(angle)])


def spiral(count: int, low: float, high: float, phase: float = 0.0) -> Array:
    """Unit vectors spread evenly between two elevations (degrees) on a Fibonacci spiral, [count, 3]."""
    bottom, top = np.sin(np.radians((low, high)))
    z = bottom + (top - bottom) * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * GOLDEN_ANGLE + phase
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


# ---- shapes: each is convex, so a ray is inside it between one `enter` and one `leave` distance


def round_interval(origins: Array, directions: Array, radius: float) -> tuple[Array, Array]:
    """Where rays are within `radius` of the origin: a ball (3 axes) or an endless cylinder (2).  Miss: enter = inf."""
    a, b = np.maximum(dot(directions, directions), 1e-12), dot(origins, directions)
    square = b * b - a * (dot(origins, origins) - radius * radius)
    root = np.sqrt(np.maximum(square, 0))
    return np.where(square > 0, (-b - root) / a, np.inf), (root - b) / a


def slab_interval(origins: Array, directions: Array, half: float) -> tuple[Array, Array]:
    """Where rays have one coordinate within `half` of 0."""
    inverse = 1 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    middle, reach = -origins * inverse, half * np.abs(inverse)
    return middle - reach, middle + reach


def common(*intervals: tuple[Array, Array]) -> tuple[Array, Array]:
    """Intersect intervals."""
    enters, leaves = zip(*intervals, strict=True)
    return np.maximum.reduce(enters), np.minimum.reduce(leaves)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A painted convex body with its own axes: turned by `tilt` about x, then by `yaw` about z (degrees)."""

    centre: Vector
    paint: Paint
    yaw: float = 0.0
    tilt: float = 0.0

    @property
    def reach(self) -> float:
        """Radius of the bounding ball."""
        raise NotImplementedError

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Where rays, given in the shape's own axes, are inside."""
        raise NotImplementedError

    def local_normal(self, points: Array) -> Array:
        """Outward normals of surface points, both in the shape's own axes."""
        raise NotImplementedError

    @cached_property
    def axes(self) -> Array:
        """World to own axes, [3, 3]."""
        (cy, sy), (ct, st) = ((np.cos(a), np.sin(a)) for a in np.radians((self.yaw, self.tilt)))
        yaw, tilt = np.array([[cy, sy, 0], [-sy, cy, 0], [0, 0, 1]]), np.array([[1, 0, 0], [0, ct, st], [0, -st, ct]])
        return np.asarray(tilt @ yaw)

    def local(self, points: Array) -> Array:
        """Bring world points into the shape's own axes."""
        return rotate(self.axes, points - np.array(self.centre)[:, None])

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Distance along each ray to the surface ahead, [R]; inf = miss."""
        offset = origins - np.array(self.centre)[:, None]
        along, square = dot(offset, directions), dot(offset, offset) - self.reach**2
        near = np.flatnonzero((square < along * along) & ((along < 0) | (square < 0)))  # the few rays that can hit
        distance = np.full(along.shape, np.inf)
        offset, directions = (np.broadcast_to(v, (3, len(along)))[:, near] for v in (offset, directions))
        enter, leave = self.interval(rotate(self.axes, offset), rotate(self.axes, directions))
        ahead = np.where(enter > 0, enter, leave)
        distance[near] = np.where((enter <= leave) & (ahead > 0), ahead, np.inf)
        return distance

    def normal(self, points: Array) -> Array:
        """Outward unit normals of surface points, [3, R]."""
        return rotate(self.axes.T, self.local_normal(self.local(points)))

    def texture(self, points: Array) -> Array:
        """Albedo of surface points, [3, R]."""
        return self.paint(self.local(points))


@dataclass(frozen=True, kw_only=True)
class Sphere(Shape):
    """A ball."""

    radius: float

    @property
    def reach(self) -> float:
        return self.radius

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        return round_interval(origins, directions, self.radius)

    def local_normal(self, points: Array) -> Array:
        return points / self.radius


@dataclass(frozen=True, kw_only=True)
class Box(Shape):
    """A block of half sides `half`."""

    half: Vector

    @property
    def reach(self) -> float:
        return float(np.linalg.norm(self.half))

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        return common(*(slab_interval(origins[i], directions[i], self.half[i]) for i in range(3)))

    def local_normal(self, points: Array) -> Array:
        depth = np.abs(points) - np.array(self.half)[:, None]
        return np.asarray(np.sign(points) * (depth == depth.max(axis=0)))


@dataclass(frozen=True, kw_only=True)
class Cylinder(Shape):
    """A closed cylinder along its own z."""

    radius: float
    half: float

    @property
    def reach(self) -> float:
        return float(np.hypot(self.radius, self.half))

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        side = round_interval(origins[:2], directions[:2], self.radius)
        return common(side, slab_interval(origins[2], directions[2], self.half))

    def local_normal(self, points: Array) -> Array:
        x, y, z = points
        cap = np.abs(z) - self.half > np.hypot(x, y) - self.radius
        return np.where(cap, [0 * x, 0 * x, np.sign(z)], [x / self.radius, y / self.radius, 0 * z])


# ---- paints: procedural albedo in a shape's own axes


def noise(points: Array, octaves: int = 1) -> Array:
    """Smooth value noise of unit cells in [0, 1], each octave half the size and weight of the one before, [R]."""
    total = np.zeros(points.shape[1])
    for octave in range(octaves):
        scaled = points * 2.0**octave + 17.3 * octave
        cell = np.floor(scaled)
        fraction = scaled - cell
        weight = fraction * fraction * (3 - 2 * fraction)
        corner = cell.astype(np.int64).astype(np.uint32)
        x, y, z = (np.stack((c, c + 1)) * np.uint32(prime) for c, prime in zip(corner, PRIMES, strict=True))
        value = scramble(x[:, None, None] ^ y[:, None] ^ z)  # at the 8 corners, [2, 2, 2, R]
        for axis in range(3):
            value = value[0] + (value[1] - value[0]) * weight[axis]
        total += value * 0.5**octave
    return total / (2 - 2.0 ** (1 - octaves))


def scramble(key: NDArray[np.uint32]) -> Array:
    """Hash integers to [0, 1)."""
    for shift, factor in (13, 0x5BD1E995), (15, 0x2C1B3C6D):
        key = np.asarray((key ^ (key >> shift)) * np.uint32(factor), np.uint32)
    return np.asarray((key ^ (key >> 16)) * 2.0**-32)


def mix(a: Vector | Array, b: Vector | Array, t: Array | NDArray[np.bool_]) -> Array:
    """Blend colours [3] or [3, R]: `a` where t is 0, `b` where it is 1."""
    a, b = (np.reshape(c, (3, -1)) for c in (a, b))
    return np.asarray(a + (b - a) * t)


def grain(p: Array) -> Array:
    """Wood along x: wavy rings and fine fibres, in [0, 1]."""
    x, y, z = p
    bend = noise(np.array([1.1 * x, 3 * y, 3 * z]), 2)
    fibre = noise(np.array([7 * x, 80 * y, 80 * z]), 2)
    ring = 0.5 + 0.5 * np.sin(95 * (y + z) + 26 * bend)
    return np.asarray(0.45 * ring + 0.55 * fibre)


def planks(p: Array) -> Array:
    """Boards of 0.25, each with its own tone, and dark joints."""
    across = p[1] / 0.25 + 0.5
    row = np.floor(across)
    tone = scramble(row.astype(np.int64).astype(np.uint32) * np.uint32(PRIMES[0]))
    wood = mix((0.66, 0.40, 0.19), (0.26, 0.12, 0.045), grain(p + 3.7 * row)) * (0.75 + 0.5 * tone)
    return mix(wood, (0.05, 0.025, 0.012), np.abs(across - np.round(across)) < 0.025)


def chessboard(p: Array) -> Array:
    """8 x 8 squares of veined stone, 0.115 each, in a walnut frame."""
    odd = (np.floor(p[0] / 0.115) + np.floor(p[1] / 0.115)) % 2 > 0
    vein = np.abs(noise(9 * p, 3) - 0.5) * 2
    light, dark = (0.84, 0.79, 0.66), (0.015, 0.10, 0.075)
    stone = mix(mix((0.30, 0.34, 0.30), dark, vein**0.4), mix((0.42, 0.33, 0.2), light, vein**0.3), odd)
    edge = np.maximum(np.abs(p[0]), np.abs(p[1]))
    frame = mix((0.16, 0.07, 0.03), (0.06, 0.025, 0.012), grain(p))
    return mix(mix(stone, (0.65, 0.42, 0.1), edge > 0.46), frame, edge > 0.47)


def globe(p: Array) -> Array:
    """Sea, land, ice and a grid of 15 degrees; radius 0.33."""
    x, y, z = p / 0.33
    height = noise(p * 6 + 5.2, 5)
    sea = mix((0.01, 0.06, 0.22), (0.05, 0.33, 0.5), np.clip(height * 2.6 - 0.4, 0, 1))
    land = mix((0.09, 0.26, 0.05), (0.62, 0.45, 0.2), np.clip(noise(p * 14, 4) * 3 - 1, 0, 1))
    ice = mix((0.5, 0.62, 0.7), (0.8, 0.82, 0.84), noise(p * 20, 3))
    world = mix(mix(sea, land, height > 0.51), ice, np.abs(z) + 0.5 * (height - 0.5) > 0.9)
    east, north = np.arctan2(y, x) * 12 / np.pi, np.arcsin(np.clip(z, -1, 1)) * 12 / np.pi
    meridian = np.abs(east - np.round(east)) * np.sqrt(1 - np.minimum(z * z, 1)) < 0.035
    line = meridian | (np.abs(north - np.round(north)) < 0.035)
    return mix(world, (0.8, 0.8, 0.75), 0.35 * line)


def beach_ball(p: Array) -> Array:
    """Six gores around z and a white cap."""
    white = (0.8, 0.77, 0.7)
    colours = np.array([(0.75, 0.04, 0.04), white, (0.02, 0.2, 0.6), (0.8, 0.52, 0.02), white, (0.02, 0.4, 0.15)])
    gore = np.floor(np.arctan2(p[1], p[0]) * 3 / np.pi).astype(int) % 6
    return mix(colours.T[:, gore], white, np.hypot(p[0], p[1]) < 0.045)


def dotted(p: Array) -> Array:
    """White dots on red, spread evenly over the ball."""
    way = unit(p)
    nearest = np.maximum.reduce([dot(d, way) for d in spiral(36, -90, 90)])
    return mix((0.62, 0.02, 0.03), (0.82, 0.79, 0.74), nearest > np.cos(0.19))


def marble(p: Array) -> Array:
    """White stone with dark veins."""
    vein = np.abs(np.sin(14 * (p[0] + p[2]) + 9 * noise(p * 7, 4)))
    return mix((0.05, 0.06, 0.09), (0.83, 0.82, 0.8), np.clip(vein * 2.2, 0, 1) ** 0.6)


def orange(p: Array) -> Array:
    """Dimpled peel with a green calyx."""
    peel = mix((0.55, 0.17, 0.005), (0.9, 0.36, 0.02), np.clip(noise(p * 60, 2) * 1.8 - 0.4, 0, 1))
    return mix(peel, (0.1, 0.2, 0.03), (np.hypot(p[0], p[1]) < 0.02) & (p[2] > 0))


def candy(p: Array) -> Array:
    """Red and green stripes winding around z, rings on the ends; half height 0.26."""
    turn = (np.arctan2(p[1], p[0]) / (2 * np.pi) + p[2] / 0.16) % 1
    side = mix(mix((0.82, 0.79, 0.74), (0.65, 0.02, 0.03), turn < 0.45), (0.02, 0.3, 0.12), np.abs(turn - 0.72) < 0.05)
    ring = np.hypot(p[0], p[1]) / 0.03 % 1 < 0.5
    return mix(side, mix((0.82, 0.79, 0.74), (0.65, 0.02, 0.03), ring), np.abs(p[2]) > 0.2599)


def tin(p: Array) -> Array:
    """A can with a label: bands, diamonds and bare ribbed metal at both ends; radius 0.17, half height 0.22."""
    x, y, z = p
    turn = np.arctan2(y, x) * 8 / np.pi
    diamond = np.abs(turn - np.round(turn)) * 0.067 + np.abs(z) * 0.5 < 0.03
    label = mix((0.02, 0.16, 0.3), (0.85, 0.8, 0.66), np.abs(z) < 0.085)
    label = mix(mix(label, (0.75, 0.12, 0.03), diamond), (0.8, 0.55, 0.1), np.abs(np.abs(z) - 0.115) < 0.012)
    rib = 0.5 + 0.5 * np.sin(np.where(np.abs(z) > 0.2199, np.hypot(x, y) * 170, z * 300))
    return mix(label, mix((0.28, 0.29, 0.31), (0.62, 0.63, 0.65), rib), np.abs(z) > 0.18)


def bound(cover: Vector, half: Vector, p: Array) -> Array:
    """A book: cloth covers with a gilt frame and title, pages on three sides, the spine at -x."""
    x, y, z = p / np.reshape(half, (3, 1))
    cloth = mix(cover, (0.02, 0.02, 0.02), 0.55 * noise(p * 90, 2))
    margin = np.minimum(half[0] - np.abs(p[0]), half[1] - np.abs(p[1]))
    frame = np.abs(margin - 0.035) < 0.007
    title = (np.abs(y) < 0.5) & (np.abs(np.abs(x - 0.2) - 0.12) < 0.045) & (noise(p * 45) > 0.35)
    band = (x < -0.999) & (np.abs(np.abs(y) - 0.7) < 0.05)
    cloth = mix(cloth, (0.75, 0.52, 0.14), ((np.abs(z) > 0.999) & (frame | title)) | band)
    pages = mix((0.8, 0.74, 0.6), (0.5, 0.43, 0.32), noise(np.array([4 * p[0], 4 * p[1], 130 * p[2]])))
    return mix(cloth, pages, (np.abs(z) < 0.78) & ((x > 0.999) | (np.abs(y) > 0.999)))


PIPS = [[(0, 0)], [(-1, -1), (1, 1)], [(-1, -1), (0, 0), (1, 1)]]
PIPS += [[(-1, -1), (-1, 1), (1, -1), (1, 1)], [(-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0)]]
PIPS += [[(-1, -1), (-1, 0), (-1, 1), (1, -1), (1, 0), (1, 1)]]


def die(p: Array) -> Array:
    """Ivory with pips, opposite faces adding up to seven; half side 0.085."""
    p = p / 0.085
    axis = np.abs(p).argmax(axis=0)
    pip = np.zeros(p.shape[1], bool)
    for face, (side, sign) in enumerate([(0, 1), (1, 1), (2, 1), (2, -1), (1, -1), (0, -1)]):
        here = (axis == side) & (p[side] * sign > 0)
        u, v = p[(side + 1) % 3], p[(side + 2) % 3]
        for a, b in PIPS[face]:
            pip |= here & (np.hypot(u - 0.52 * a, v - 0.52 * b) < 0.19)
    return mix((0.86, 0.8, 0.66), (0.03, 0.03, 0.05), pip)


def pencil(p: Array) -> Array:
    """Yellow paint, a metal ferrule, a pink eraser and a black end; half length 0.34."""
    facet = np.floor(np.arctan2(p[1], p[0]) * 3 / np.pi) % 2 > 0
    body = mix((0.85, 0.5, 0.02), (0.7, 0.36, 0.01), facet)
    body = mix(body, (0.03, 0.03, 0.03), np.abs(p[2] + 0.29) < 0.02)
    metal = mix((0.3, 0.3, 0.3), (0.7, 0.68, 0.6), 0.5 + 0.5 * np.sin(p[2] * 420))
    return mix(mix(body, metal, p[2] > 0.22), (0.8, 0.28, 0.27), p[2] > 0.285)


def book(centre: Vector, half: Vector, yaw: float, cover: Vector) -> Box:
    """A bound box: its paint needs its size."""
    return Box(centre=centre, half=half, yaw=yaw, paint=partial(bound, cover, half))


SCENE: tuple[Shape, ...] = (
    Cylinder(centre=(0, 0, -0.05), radius=SCENE_RADIUS, half=0.05, paint=planks, yaw=25),
    Box(centre=(0.02, 0.0, 0.03), half=(0.52, 0.52, 0.03), paint=chessboard, yaw=-22),
    Sphere(centre=(-0.12, 0.14, 0.39), radius=0.33, paint=globe, tilt=23, yaw=40),
    Cylinder(centre=(0.40, 0.20, 0.28), radius=0.17, half=0.22, paint=tin, yaw=10),
    Sphere(centre=(0.22, -0.22, 0.21), radius=0.15, paint=dotted, yaw=30, tilt=20),
    Box(centre=(-0.20, -0.30, 0.145), half=(0.085, 0.085, 0.085), paint=die, yaw=33),
    book((-0.78, -0.12, 0.06), (0.22, 0.30, 0.06), 8, (0.05, 0.13, 0.33)),
    book((-0.77, -0.13, 0.165), (0.19, 0.26, 0.045), 31, (0.42, 0.03, 0.04)),
    Sphere(centre=(-0.78, -0.1, 0.34), radius=0.13, paint=orange, tilt=-15),
    Sphere(centre=(0.80, -0.25, 0.24), radius=0.24, paint=beach_ball, tilt=50, yaw=30),
    Sphere(centre=(-0.42, 0.85, 0.16), radius=0.16, paint=marble),
    Cylinder(centre=(0.42, 0.86, 0.26), radius=0.075, half=0.26, paint=candy),
    Cylinder(centre=(0.10, -0.86, 0.032), radius=0.032, half=0.34, paint=pencil, tilt=90, yaw=62),
    Box(centre=(0.50, -0.75, 0.085), half=(0.085, 0.085, 0.085), paint=die, yaw=-15, tilt=90),
)


# ---- light: one jittered shadow ray and one sky ray per sample; a pixel's GRID x GRID samples share the work

KEY_DIRECTION = unit(np.array([[0.45], [-0.62], [0.95]]))
KEY_LIGHT = np.array([[1.0], [0.95], [0.86]])
KEY_WIDTH = 0.11  # radius of the light over its distance
SKY_LIGHT = np.array([[0.36], [0.41], [0.50]])
BOUNCE = 0.45  # light on a shape that blocks the sky, over the skylight it blocks


def trace(origins: Array, directions: Array) -> tuple[Array, NDArray[np.intp]]:
    """Distance to the closest shape (inf = miss) and its index in SCENE, both [R]."""
    distance = np.full(np.broadcast_shapes(origins.shape, directions.shape)[1], np.inf)
    index = np.zeros(distance.shape, np.intp)
    for i, shape in enumerate(SCENE):
        here = shape.intersect(origins, directions)
        index[here < distance] = i
        distance = np.minimum(distance, here)
    return distance, index


def by_shape(of: Callable[[Shape, Array], Array], index: NDArray[np.intp], points: Array) -> Array:
    """Evaluate `Shape.normal` or `Shape.texture` at points, each on the shape that it lies on, [3, R]."""
    out = np.zeros(points.shape)
    for i in np.unique(index):
        here = np.flatnonzero(index == i)
        out[:, here] = of(SCENE[i], points[:, here])
    return out


def shade(points: Array, index: NDArray[np.intp], sample: int) -> Array:
    """Light that surface points send out, seen by the `sample`-th shadow ray and sky ray of GRID x GRID, [3, R]."""
    count = GRID * GRID
    lamp, sky = disc(count)[:, [sample * 7 % count, sample * 5 % count]].T  # far apart in neighbouring samples
    normal = by_shape(Shape.normal, index, points)
    start = points + SKIN * normal
    to_key = unit(align(KEY_DIRECTION, KEY_WIDTH * lamp[0], KEY_WIDTH * lamp[1], 1.0))
    lit = np.isinf(trace(start, to_key)[0]) * np.maximum(dot(KEY_DIRECTION, normal), 0)
    to_sky = align(normal, sky[0], sky[1], np.sqrt(1 - dot(sky, sky)))
    distance, blocker = trace(start, to_sky)
    light = SKY_LIGHT * (0.75 + 0.25 * normal[2])
    near = np.flatnonzero(np.isfinite(distance))
    there = start[:, near] + distance[near] * to_sky[:, near]
    light[:, near] *= BOUNCE * by_shape(Shape.texture, blocker[near], there)
    return np.asarray(by_shape(Shape.texture, index, points) * (KEY_LIGHT * lit + light))


# ---- cameras


def look_at_target(direction: Array) -> Array:
    """Camera-to-world [4, 4] in OpenGL axes of the camera that sees TARGET from `direction` [3]."""
    right = unit(np.cross([0.0, 0.0, 1.0], direction))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(direction, right), direction, TARGET + CAMERA_DISTANCE * direction], axis=1)
    return pose


def camera_rays(pose: Array, size: int, x: Array, y: Array) -> tuple[Array, Array]:
    """Origin [3, 1] and unit directions [3, R] of the rays through image positions x, y (pixels)."""
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    through = np.array([(x - 0.5 * size) / focal, (0.5 * size - y) / focal, np.full(x.shape, -1.0)])
    return pose[:3, 3:], unit(rotate(pose[:3, :3], through))


def photograph(pose: Array, size: int) -> NDArray[np.uint8]:
    """Render one view, [size, size, 4] RGBA: colours with gamma 2 (close to sRGB), alpha = covered share."""
    rows = max(1, BLOCK // size)
    return np.concatenate([expose(pose, size, range(r, min(r + rows, size))) for r in range(0, size, rows)])


def expose(pose: Array, size: int, rows: range) -> NDArray[np.uint8]:
    """Render some rows of a view, [rows, size, 4] RGBA."""
    y, x = (v.ravel() for v in np.meshgrid(np.array(rows, float), np.arange(float(size)), indexing="ij"))
    colour, cover = np.zeros((3, len(x))), np.zeros(len(x))
    for sample in range(GRID * GRID):
        down, right = divmod(sample, GRID)
        origin, directions = camera_rays(pose, size, x + (right + 0.5) / GRID, y + (down + 0.5) / GRID)
        distance, index = trace(origin, directions)
        hit = np.flatnonzero(np.isfinite(distance))
        light = shade(origin + distance[hit] * directions[:, hit], index[hit], sample)
        colour[:, hit] += np.sqrt(np.minimum(light, 1))  # encode first: a reader's resizing averages stored values too
        cover[hit] += 1
    rgba = np.vstack([colour / np.maximum(cover, 1), cover / GRID**2])
    return np.rint(255 * rgba).astype(np.uint8).T.reshape(len(rows), size, 4)


# ---- the folder


@dataclass(frozen=True)
class Options:
    """What the data set depends on: image size in pixels, numbers of views, seed of the surface points."""

    size: int = 256
    train: int = 60
    test: int = 12
    seed: int = 0

    def poses(self) -> dict[str, list[Array]]:
        """Camera-to-world matrices of each split; the test cameras stand between the training ones."""
        train, test = spiral(self.train, 10, 70), spiral(self.test, 14, 66, phase=3.0)
        return {"train": [look_at_target(d) for d in train], "test": [look_at_target(d) for d in test]}

    def manifest(self) -> str:
        """The text of OUT/synthetic.json, by which a finished data set is known again."""
        return json.dumps({"scene": SCENE_VERSION, **asdict(self)}) + "\n"


def write_dataset(out: Path, options: Options, workers: int | None = None) -> str:
    """Make folder `out`, all of it or nothing, and return a line that says what was done.

    `workers` processes share the views (default: one per core; 1 = this process).  Raises DataError when `out` is
    something else already, OutputError when it cannot be written.
    """
    if is_complete(out, options):
        return f"{out} is complete already: nothing to do"
    if out.exists() or out.is_symlink():
        raise DataError(f"{out} exists and is not this data set; remove it or choose another folder")
    partial_out = out.parent / f".{out.name}.{os.getpid()}.partial"
    try:
        partial_out.mkdir(parents=True)
        count = fill(partial_out, options, workers or os.cpu_count() or 1)
        partial_out.rename(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot write the data set: {error}") from error
    finally:
        shutil.rmtree(partial_out, ignore_errors=True)
    return f"wrote {out}: {options.train} training and {options.test} test views, {options.size} px, {count} points"


def is_complete(out: Path, options: Options) -> bool:
    """Tell whether `out` holds every file of the data set with these options."""
    manifest = out / "synthetic.json"
    if not manifest.is_file() or manifest.read_text(errors="replace") != options.manifest():
        return False
    files = [f"{split}/r_{i:03}.png" for split, poses in options.poses().items() for i in range(len(poses))]
    files += ["transforms_train.json", "transforms_test.json", "points3d.ply"]
    return all((out / name).is_file() for name in files)


def fill(out: Path, options: Options, workers: int) -> int:
    """Write images, cameras and points into `out`; return the number of points."""
    splits = options.poses()
    jobs = [(split, i, pose) for split, poses in splits.items() for i, pose in enumerate(poses)]
    images = photographs([pose for _, _, pose in jobs], options.size, min(workers, len(jobs)))
    rng = np.random.default_rng(options.seed)
    points = []
    for split in splits:
        (out / split).mkdir()
    for (split, i, pose), image in zip(jobs, track(images, "rendering", total=len(jobs)), strict=True):
        png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA))[1]
        (out / split / f"r_{i:03}.png").write_bytes(png.tobytes())
        if split == "train":
            points.append(surface_points(pose, image, -(-POINT_COUNT // options.train), rng))
    for split, poses in splits.items():
        (out / f"transforms_{split}.json").write_text(json.dumps(transforms(split, poses), indent=1) + "\n")
    positions, colours = (np.concatenate(parts).astype(np.float32) for parts in zip(*points, strict=True))
    write_points_ply(out / "points3d.ply", PointCloud(positions, colours))
    (out / "synthetic.json").write_text(options.manifest())
    return len(positions)


def photographs(poses: list[Array], size: int, workers: int) -> Iterator[NDArray[np.uint8]]:
    """Render views in order; in processes, as NumPy calls this short leave threads waiting for the interpreter."""
    if workers == 1:
        yield from (photograph(pose, size) for pose in poses)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(partial(photograph, size=size), poses)


def surface_points(pose: Array, image: NDArray[np.uint8], count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw noisy surface points that a view sees, as structure from motion would: positions and colours, [M, 3]."""
    rows, columns = np.nonzero(image[..., 3] == 255)
    chosen = rng.integers(len(rows), size=count) if len(rows) else np.zeros(0, int)
    x, y = np.stack([columns[chosen], rows[chosen]]) + rng.random((2, len(chosen)))
    origin, directions = camera_rays(pose, len(image), x, y)
    distance, _ = trace(origin, directions)
    hit = np.isfinite(distance)
    positions = (origin + distance[hit] * directions[:, hit]).T
    colours = image[rows[chosen], columns[chosen], :3][hit] / 255
    return positions + POINT_NOISE * rng.standard_normal(positions.shape), colours


def transforms(split: str, poses: list[Array]) -> dict[str, object]:
    """Cameras of a split as the Blender data sets store them: camera-to-world, OpenGL axes."""
    frames = [{"file_path": f"./{split}/r_{i:03}", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    return {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
