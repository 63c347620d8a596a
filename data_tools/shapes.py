"""Intersect rays with spheres, boxes, and cylinders, in closed form.

Points and directions are arrays [3, R], one column per ray, or [3, 1], which broadcasts.  Lengths are in scene units.
Each shape is convex, so a ray is inside it between one `enter` and one `leave` distance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Paint = Callable[[Array], Array]  # points in the shape's axes [3, R] -> albedo [3, R]
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def dot(a: Array, b: Array) -> Array:
    """Return the dot products of columns, [R]."""
    total: Array = a[0] * b[0]
    for i in range(1, len(a)):
        total = total + a[i] * b[i]
    return total


def rotate(matrix: Array, v: Array) -> Array:
    """Multiply columns [3, R] by a [3, 3] matrix, without BLAS, whose rounding may depend on the number of threads."""
    return np.asarray(matrix[:, :1] * v[0] + matrix[:, 1:2] * v[1] + matrix[:, 2:] * v[2])


def normalize(v: Array) -> Array:
    """Scale the columns of an array [3, R] to unit length."""
    return np.asarray(v / np.sqrt(dot(v, v)))


def align(axis: Array, x: float, y: float, z: Array | float) -> Array:
    """Rotate vectors (x, y, z) by a rotation that maps the z axis to the unit columns `axis` (Duff et al. 2017)."""
    sign = np.copysign(1.0, axis[2])
    a = -1 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    right = np.array([1 + sign * axis[0] * axis[0] * a, sign * b, -sign * axis[0]])
    up = np.array([b, sign + axis[1] * axis[1] * a, -axis[1]])
    return np.asarray(x * right + y * up + z * axis)


def disc(count: int) -> Array:
    """Return points that are evenly distributed over the unit disc (Vogel's spiral), [2, count]."""
    radius, angle = np.sqrt((np.arange(count) + 0.5) / count), np.arange(count) * GOLDEN_ANGLE
    return np.array([radius * np.cos(angle), radius * np.sin(angle)])


def spiral(count: int, low: float, high: float, phase: float = 0.0) -> Array:
    """Return unit vectors that are evenly distributed between two elevations, on a Fibonacci spiral, [count, 3].

    low, high: elevations in degrees
    phase: rotation of the spiral about z, in radians
    """
    bottom, top = np.sin(np.radians((low, high)))
    z = bottom + (top - bottom) * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * GOLDEN_ANGLE + phase
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def sphere_interval(origins: Array, directions: Array, radius: float) -> tuple[Array, Array]:
    """Return the distances at which rays enter and leave a sphere or infinite cylinder at the origin; inf for a miss.

    origins, directions: [3, R] for a sphere, [2, R] for a cylinder
    """
    a, b = np.maximum(dot(directions, directions), 1e-12), dot(origins, directions)
    discriminant = b * b - a * (dot(origins, origins) - radius * radius)
    root = np.sqrt(np.maximum(discriminant, 0))
    return np.where(discriminant > 0, (-b - root) / a, np.inf), (root - b) / a


def slab_interval(origins: Array, directions: Array, half: float) -> tuple[Array, Array]:
    """Return the distances (enter, leave) between which one coordinate of rays is within `half` of 0."""
    inverse = 1 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    center, half_span = -origins * inverse, half * np.abs(inverse)
    return center - half_span, center + half_span


def intersect_intervals(*intervals: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the intersection of (enter, leave) intervals; it is empty if enter > leave."""
    enters, leaves = zip(*intervals, strict=True)
    return np.maximum.reduce(enters), np.minimum.reduce(leaves)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A painted convex shape, rotated by `tilt` about x and then by `yaw` about z, both in degrees."""

    center: Vector
    paint: Paint
    yaw: float = 0.0
    tilt: float = 0.0

    @property
    def bounding_radius(self) -> float:
        """Radius of the bounding sphere."""
        raise NotImplementedError

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Return the distances (enter, leave) at which rays, in local coordinates, enter and leave the shape."""
        raise NotImplementedError

    def local_normal(self, points: Array) -> Array:
        """Return the outward normals of surface points, both in local coordinates."""
        raise NotImplementedError

    @cached_property
    def axes(self) -> Array:
        """The rotation from world to local coordinates, [3, 3]."""
        (cy, sy), (ct, st) = ((np.cos(a), np.sin(a)) for a in np.radians((self.yaw, self.tilt)))
        yaw, tilt = np.array([[cy, sy, 0], [-sy, cy, 0], [0, 0, 1]]), np.array([[1, 0, 0], [0, ct, st], [0, -st, ct]])
        return np.asarray(tilt @ yaw)

    def local(self, points: Array) -> Array:
        """Transform world points to local coordinates."""
        return rotate(self.axes, points - np.array(self.center)[:, None])

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return the distance along each ray to the surface of the shape, [R], or inf for a miss."""
        offset = origins - np.array(self.center)[:, None]
        along, square = dot(offset, directions), dot(offset, offset) - self.bounding_radius**2
        # rays that hit the bounding sphere
        near = np.flatnonzero((square < along * along) & ((along < 0) | (square < 0)))
        distance = np.full(along.shape, np.inf)
        offset, directions = (np.broadcast_to(v, (3, len(along)))[:, near] for v in (offset, directions))
        enter, leave = self.interval(rotate(self.axes, offset), rotate(self.axes, directions))
        ahead = np.where(enter > 0, enter, leave)
        distance[near] = np.where((enter <= leave) & (ahead > 0), ahead, np.inf)
        return distance

    def normal(self, points: Array) -> Array:
        """Return the outward unit normals of surface points, [3, R]."""
        return rotate(self.axes.T, self.local_normal(self.local(points)))

    def texture(self, points: Array) -> Array:
        """Return the albedo of surface points, [3, R]."""
        return self.paint(self.local(points))


@dataclass(frozen=True, kw_only=True)
class Sphere(Shape):
    """A sphere with the given radius, in scene units."""

    radius: float

    @property
    def bounding_radius(self) -> float:
        return self.radius

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        return sphere_interval(origins, directions, self.radius)

    def local_normal(self, points: Array) -> Array:
        return points / self.radius


@dataclass(frozen=True, kw_only=True)
class Cuboid(Shape):
    """A box with half side lengths `half`."""

    half: Vector

    @property
    def bounding_radius(self) -> float:
        return float(np.linalg.norm(self.half))

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        return intersect_intervals(*(slab_interval(origins[i], directions[i], self.half[i]) for i in range(3)))

    def local_normal(self, points: Array) -> Array:
        depth = np.abs(points) - np.array(self.half)[:, None]
        return np.asarray(np.sign(points) * (depth == depth.max(axis=0)))


@dataclass(frozen=True, kw_only=True)
class Cylinder(Shape):
    """A closed cylinder along the local z axis with half height `half`."""

    radius: float
    half: float

    @property
    def bounding_radius(self) -> float:
        return float(np.hypot(self.radius, self.half))

    def interval(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        side = sphere_interval(origins[:2], directions[:2], self.radius)
        return intersect_intervals(side, slab_interval(origins[2], directions[2], self.half))

    def local_normal(self, points: Array) -> Array:
        x, y, z = points
        is_cap = np.abs(z) - self.half > np.hypot(x, y) - self.radius
        return np.where(is_cap, [0 * x, 0 * x, np.sign(z)], [x / self.radius, y / self.radius, 0 * z])
