"""Define the still life: shapes on a table, and the procedural paints of their surfaces.

A paint receives points in the local axes of its shape, [3, R] in scene units, and returns their albedo, [3, R].
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from .shapes import Array, Cuboid, Cylinder, Shape, Sphere, Vector, dot, normalize, spiral

SCENE_RADIUS = 1.25  # radius of the table, scene units
SCENE_VERSION = 1  # increase it when the images change, so that existing folders count as incomplete
PRIMES = (0x8DA6B343, 0xD8163841, 0xCB1AB31F)  # spatial hash


def noise(points: Array, octaves: int = 1) -> Array:
    """Return smooth value noise with unit cells, [R] in [0, 1].

    Each octave has half the cell size and half the weight of the previous one.
    """
    total = np.zeros(points.shape[1])
    for octave in range(octaves):
        scaled_points = points * 2.0**octave + 17.3 * octave
        cell = np.floor(scaled_points)
        fraction = scaled_points - cell
        weight = fraction * fraction * (3 - 2 * fraction)
        corner = cell.astype(np.int64).astype(np.uint32)
        x, y, z = (np.stack((c, c + 1)) * np.uint32(prime) for c, prime in zip(corner, PRIMES, strict=True))
        value = scramble(x[:, None, None] ^ y[:, None] ^ z)  # at the 8 corners, [2, 2, 2, R]
        for axis in range(3):
            value = value[0] + (value[1] - value[0]) * weight[axis]
        total += value * 0.5**octave
    return total / (2 - 2.0 ** (1 - octaves))


def scramble(key: NDArray[np.uint32]) -> Array:
    """Hash integers to numbers in [0, 1)."""
    for shift, factor in (13, 0x5BD1E995), (15, 0x2C1B3C6D):
        key = np.asarray((key ^ (key >> shift)) * np.uint32(factor), np.uint32)
    return np.asarray((key ^ (key >> 16)) * 2.0**-32)


def mix(a: Vector | Array, b: Vector | Array, t: Array | NDArray[np.bool_]) -> Array:
    """Blend colors, [3] or [3, R], from `a` where t is 0 to `b` where t is 1."""
    a, b = (np.reshape(c, (3, -1)) for c in (a, b))
    return np.asarray(a + (b - a) * t)


def grain(p: Array) -> Array:
    """Return the brightness of wood with its grain along x, wavy rings, and fine fibers, [R] in [0, 1]."""
    x, y, z = p
    bend = noise(np.array([1.1 * x, 3 * y, 3 * z]), 2)
    fiber = noise(np.array([7 * x, 80 * y, 80 * z]), 2)
    ring = 0.5 + 0.5 * np.sin(95 * (y + z) + 26 * bend)
    return np.asarray(0.45 * ring + 0.55 * fiber)


def planks(p: Array) -> Array:
    """Paint boards of different tones, each 0.25 wide, with dark joints."""
    board_position = p[1] / 0.25 + 0.5
    row = np.floor(board_position)
    tone = scramble(row.astype(np.int64).astype(np.uint32) * np.uint32(PRIMES[0]))
    wood = mix((0.66, 0.40, 0.19), (0.26, 0.12, 0.045), grain(p + 3.7 * row)) * (0.75 + 0.5 * tone)
    return mix(wood, (0.05, 0.025, 0.012), np.abs(board_position - np.round(board_position)) < 0.025)


def chessboard(p: Array) -> Array:
    """Paint 8 x 8 squares of veined stone, each 0.115 wide, in a walnut frame."""
    is_odd = (np.floor(p[0] / 0.115) + np.floor(p[1] / 0.115)) % 2 > 0
    vein = np.abs(noise(9 * p, 3) - 0.5) * 2
    light, dark = (0.84, 0.79, 0.66), (0.015, 0.10, 0.075)
    stone = mix(mix((0.30, 0.34, 0.30), dark, vein**0.4), mix((0.42, 0.33, 0.2), light, vein**0.3), is_odd)
    edge = np.maximum(np.abs(p[0]), np.abs(p[1]))
    frame = mix((0.16, 0.07, 0.03), (0.06, 0.025, 0.012), grain(p))
    return mix(mix(stone, (0.65, 0.42, 0.1), edge > 0.46), frame, edge > 0.47)


def globe(p: Array) -> Array:
    """Paint sea, land, ice, and a 15-degree grid on a sphere of radius 0.33."""
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
    """Paint six gores around z, and a white cap."""
    white = (0.8, 0.77, 0.7)
    colors = np.array([(0.75, 0.04, 0.04), white, (0.02, 0.2, 0.6), (0.8, 0.52, 0.02), white, (0.02, 0.4, 0.15)])
    gore = np.floor(np.arctan2(p[1], p[0]) * 3 / np.pi).astype(int) % 6
    return mix(colors.T[:, gore], white, np.hypot(p[0], p[1]) < 0.045)


def dotted(p: Array) -> Array:
    """Paint evenly distributed white dots on a red ball."""
    direction = normalize(p)
    nearest = np.maximum.reduce([dot(d, direction) for d in spiral(36, -90, 90)])
    return mix((0.62, 0.02, 0.03), (0.82, 0.79, 0.74), nearest > np.cos(0.19))


def marble(p: Array) -> Array:
    """Paint white stone with dark veins."""
    vein = np.abs(np.sin(14 * (p[0] + p[2]) + 9 * noise(p * 7, 4)))
    return mix((0.05, 0.06, 0.09), (0.83, 0.82, 0.8), np.clip(vein * 2.2, 0, 1) ** 0.6)


def orange(p: Array) -> Array:
    """Paint a dimpled orange peel with a green calyx."""
    peel = mix((0.55, 0.17, 0.005), (0.9, 0.36, 0.02), np.clip(noise(p * 60, 2) * 1.8 - 0.4, 0, 1))
    return mix(peel, (0.1, 0.2, 0.03), (np.hypot(p[0], p[1]) < 0.02) & (p[2] > 0))


def candy(p: Array) -> Array:
    """Paint red and green stripes that wind around z, and rings on the ends.  The half height is 0.26."""
    turn = (np.arctan2(p[1], p[0]) / (2 * np.pi) + p[2] / 0.16) % 1
    side = mix(mix((0.82, 0.79, 0.74), (0.65, 0.02, 0.03), turn < 0.45), (0.02, 0.3, 0.12), np.abs(turn - 0.72) < 0.05)
    ring = np.hypot(p[0], p[1]) / 0.03 % 1 < 0.5
    return mix(side, mix((0.82, 0.79, 0.74), (0.65, 0.02, 0.03), ring), np.abs(p[2]) > 0.2599)


def tin(p: Array) -> Array:
    """Paint a can of radius 0.17 and half height 0.22: a label with bands and diamonds, and ribbed metal ends."""
    x, y, z = p
    turn = np.arctan2(y, x) * 8 / np.pi
    diamond = np.abs(turn - np.round(turn)) * 0.067 + np.abs(z) * 0.5 < 0.03
    label = mix((0.02, 0.16, 0.3), (0.85, 0.8, 0.66), np.abs(z) < 0.085)
    label = mix(mix(label, (0.75, 0.12, 0.03), diamond), (0.8, 0.55, 0.1), np.abs(np.abs(z) - 0.115) < 0.012)
    rib = 0.5 + 0.5 * np.sin(np.where(np.abs(z) > 0.2199, np.hypot(x, y) * 170, z * 300))
    return mix(label, mix((0.28, 0.29, 0.31), (0.62, 0.63, 0.65), rib), np.abs(z) > 0.18)


def book_cover(cover: Vector, half: Vector, p: Array) -> Array:
    """Paint a book: cloth covers with a gilt frame and title, pages on three sides, and the spine at -x."""
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
    """Paint an ivory die of half side 0.085, whose opposite faces add up to seven."""
    p = p / 0.085
    axis = np.abs(p).argmax(axis=0)
    pip = np.zeros(p.shape[1], bool)
    for face, (side, sign) in enumerate([(0, 1), (1, 1), (2, 1), (2, -1), (1, -1), (0, -1)]):
        on_face = (axis == side) & (p[side] * sign > 0)
        u, v = p[(side + 1) % 3], p[(side + 2) % 3]
        for a, b in PIPS[face]:
            pip |= on_face & (np.hypot(u - 0.52 * a, v - 0.52 * b) < 0.19)
    return mix((0.86, 0.8, 0.66), (0.03, 0.03, 0.05), pip)


def pencil(p: Array) -> Array:
    """Paint a yellow pencil of half length 0.34 with a metal ferrule, a pink eraser, and a black end."""
    facet = np.floor(np.arctan2(p[1], p[0]) * 3 / np.pi) % 2 > 0
    body = mix((0.85, 0.5, 0.02), (0.7, 0.36, 0.01), facet)
    body = mix(body, (0.03, 0.03, 0.03), np.abs(p[2] + 0.29) < 0.02)
    metal = mix((0.3, 0.3, 0.3), (0.7, 0.68, 0.6), 0.5 + 0.5 * np.sin(p[2] * 420))
    return mix(mix(body, metal, p[2] > 0.22), (0.8, 0.28, 0.27), p[2] > 0.285)


def book(center: Vector, half: Vector, yaw: float, cover: Vector) -> Cuboid:
    """Return a box painted as a book."""
    return Cuboid(center=center, half=half, yaw=yaw, paint=partial(book_cover, cover, half))


SCENE: tuple[Shape, ...] = (
    Cylinder(center=(0, 0, -0.05), radius=SCENE_RADIUS, half=0.05, paint=planks, yaw=25),
    Cuboid(center=(0.02, 0.0, 0.03), half=(0.52, 0.52, 0.03), paint=chessboard, yaw=-22),
    Sphere(center=(-0.12, 0.14, 0.39), radius=0.33, paint=globe, tilt=23, yaw=40),
    Cylinder(center=(0.40, 0.20, 0.28), radius=0.17, half=0.22, paint=tin, yaw=10),
    Sphere(center=(0.22, -0.22, 0.21), radius=0.15, paint=dotted, yaw=30, tilt=20),
    Cuboid(center=(-0.20, -0.30, 0.145), half=(0.085, 0.085, 0.085), paint=die, yaw=33),
    book((-0.78, -0.12, 0.06), (0.22, 0.30, 0.06), 8, (0.05, 0.13, 0.33)),
    book((-0.77, -0.13, 0.165), (0.19, 0.26, 0.045), 31, (0.42, 0.03, 0.04)),
    Sphere(center=(-0.78, -0.1, 0.34), radius=0.13, paint=orange, tilt=-15),
    Sphere(center=(0.80, -0.25, 0.24), radius=0.24, paint=beach_ball, tilt=50, yaw=30),
    Sphere(center=(-0.42, 0.85, 0.16), radius=0.16, paint=marble),
    Cylinder(center=(0.42, 0.86, 0.26), radius=0.075, half=0.26, paint=candy),
    Cylinder(center=(0.10, -0.86, 0.032), radius=0.032, half=0.34, paint=pencil, tilt=90, yaw=62),
    Cuboid(center=(0.50, -0.75, 0.085), half=(0.085, 0.085, 0.085), paint=die, yaw=-15, tilt=90),
)
