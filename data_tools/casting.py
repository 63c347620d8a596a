"""Render painted convex shapes with exact cameras, by ray casting.

    primary ray -> closest shape -> paint x (key light x shadow + sky x visible sky) -> mean over the pixel's samples

The z axis points up.  Colors are linear until `photograph` encodes them.  Points and directions are [3, R], as in
shapes.py.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .shapes import Array, Shape, align, disc, dot, normalize, rotate

BLOCK = 65536  # rays per block: smaller blocks need more calls, larger blocks more memory
SURFACE_OFFSET = 1e-6  # scene units: secondary rays start this far above the surface

# Light: each sample casts one jittered shadow ray and one sky ray; the mean of a pixel's samples reduces the noise.
KEY_DIRECTION = normalize(np.array([[0.45], [-0.62], [0.95]]))
KEY_LIGHT = np.array([[1.0], [0.95], [0.86]])
KEY_WIDTH = 0.11  # radius of the key light, as a fraction of its distance
SKY_LIGHT = np.array([[0.36], [0.41], [0.50]])
BOUNCE = 0.45  # light on a shape that blocks the sky, as a fraction of the blocked skylight


@dataclass(frozen=True)
class World:
    """A scene of shapes under a fixed light, and the settings of its square photos."""

    shapes: tuple[Shape, ...]
    camera_angle_x: float  # field of view, radians
    grid: int  # a pixel is the mean of grid x grid rays
    occluders: tuple[Shape, ...] | None = None  # shapes that block skylight; None: all shapes

    def trace(self, origins: Array, directions: Array) -> tuple[Array, NDArray[np.intp]]:
        """Return the distance to the closest shape (inf for a miss) and its index in `shapes`, both [R]."""
        distance = np.full(np.broadcast_shapes(origins.shape, directions.shape)[1], np.inf)
        index = np.zeros(distance.shape, np.intp)
        for i, shape in enumerate(self.shapes):
            hits = shape.intersect(origins, directions)
            index[hits < distance] = i
            distance = np.minimum(distance, hits)
        return distance, index

    def by_shape(self, method: Callable[[Shape, Array], Array], index: NDArray[np.intp], points: Array) -> Array:
        """Evaluate `Shape.normal` or `Shape.texture` at surface points, [3, R].

        index: the index in `shapes` of each point's shape, [R]
        """
        out = np.zeros(points.shape)
        for i in np.unique(index):
            columns = np.flatnonzero(index == i)
            out[:, columns] = method(self.shapes[i], points[:, columns])
        return out

    def shade(self, points: Array, index: NDArray[np.intp], sample: int) -> Array:
        """Return the light that leaves surface points, [3, R], computed with one shadow ray and one sky ray per point.

        index: the index in `shapes` of each point's shape, [R]
        sample: the index of the sample in its pixel, which selects the directions of these rays
        """
        count = self.grid * self.grid
        # so that the directions of neighboring samples are far apart
        key_sample, sky_sample = disc(count)[:, [sample * 7 % count, sample * 5 % count]].T
        normal = self.by_shape(Shape.normal, index, points)
        start = points + SURFACE_OFFSET * normal
        to_key = normalize(align(KEY_DIRECTION, KEY_WIDTH * key_sample[0], KEY_WIDTH * key_sample[1], 1.0))
        key_light = np.isinf(self.trace(start, to_key)[0]) * np.maximum(dot(KEY_DIRECTION, normal), 0)
        to_sky = align(normal, sky_sample[0], sky_sample[1], np.sqrt(1 - dot(sky_sample, sky_sample)))
        occluder_world = self if self.occluders is None else replace(self, shapes=self.occluders)
        distance, blocker = occluder_world.trace(start, to_sky)
        light = SKY_LIGHT * (0.75 + 0.25 * normal[2])
        occluded = np.flatnonzero(np.isfinite(distance))
        blocking_points = start[:, occluded] + distance[occluded] * to_sky[:, occluded]
        light[:, occluded] *= BOUNCE * occluder_world.by_shape(Shape.texture, blocker[occluded], blocking_points)
        return np.asarray(self.by_shape(Shape.texture, index, points) * (KEY_LIGHT * key_light + light))

    def camera_rays(self, pose: Array, size: int, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the origin [3, 1] and unit directions [3, R] of the rays through the image positions (x, y) in pixels.

        pose: the camera-to-world matrix [4, 4] in OpenGL axes
        """
        focal = 0.5 * size / np.tan(0.5 * self.camera_angle_x)
        directions = np.array([(x - 0.5 * size) / focal, (0.5 * size - y) / focal, np.full(x.shape, -1.0)])
        return pose[:3, 3:], normalize(rotate(pose[:3, :3], directions))

    def photograph(self, pose: Array, size: int) -> NDArray[np.uint8]:
        """Render one view, [size, size, 4] RGBA: colors with gamma 2 (close to sRGB); alpha is the covered fraction."""
        rows = max(1, BLOCK // size)
        parts = [self.render_rows(pose, size, range(r, min(r + rows, size))) for r in range(0, size, rows)]
        return np.concatenate(parts)

    def render_rows(self, pose: Array, size: int, rows: range) -> NDArray[np.uint8]:
        """Render a range of rows of a view, [rows, size, 4] RGBA."""
        y, x = (v.ravel() for v in np.meshgrid(np.array(rows, float), np.arange(float(size)), indexing="ij"))
        color, coverage = np.zeros((3, len(x))), np.zeros(len(x))
        for sample in range(self.grid * self.grid):
            down, right = divmod(sample, self.grid)
            origin, directions = self.camera_rays(
                pose, size, x + (right + 0.5) / self.grid, y + (down + 0.5) / self.grid
            )
            distance, index = self.trace(origin, directions)
            hit = np.flatnonzero(np.isfinite(distance))
            light = self.shade(origin + distance[hit] * directions[:, hit], index[hit], sample)
            color[:, hit] += np.sqrt(np.minimum(light, 1))  # encode before averaging: readers average encoded values
            coverage[hit] += 1
        rgba = np.vstack([color / np.maximum(coverage, 1), coverage / self.grid**2])
        return np.rint(255 * rgba).astype(np.uint8).T.reshape(len(rows), size, 4)


def camera_pose(position: Array, backward: Array) -> Array:
    """Return the camera-to-world matrix [4, 4], in OpenGL axes, of a camera that looks along `-backward`.

    position: in scene units, [3]
    backward: a unit vector, [3]
    """
    right = normalize(np.cross([0.0, 0.0, 1.0], backward))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
    return pose
