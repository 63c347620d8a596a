"""Fuse depth images of views on a device, in blocks of grid points (cl_kernels/fusion.cl)."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Array, Device, constants
from clsplat.render.camera import upload_camera
from clsplat.scene.view import View

Floats = NDArray[np.float32]
Blocks = NDArray[np.int32]  # [B, 3], indices of blocks
CONSTANTS = constants("fusion.cl")
SIDE, FIELDS = int(CONSTANTS["BLOCK_SIDE"]), int(CONSTANTS["POINT_FIELDS"])
CHUNK = 1024  # blocks per buffer, about 100 MB
MAX_PIXEL = 4.0  # size of a pixel at the farthest surface, in voxels
MIN_VIEWS = 2  # views that must see a surface in a block, or a grid point
POINT_BYTES = 4 * FIELDS + 4 + 4 + 16  # memory per grid point: on the device; value, color, and mesh on the host


@dataclass(frozen=True)
class DepthImage:
    """The depths and colors of a view."""

    view: View
    depth: Floats  # [height, width] scene units; 0: unknown
    color: Floats  # [height, width, 3] in [0, 1]


def find_blocks(images: Iterable[DepthImage], voxel: float, truncation: float) -> Blocks:
    """Return the blocks within `truncation` of a surface in at least MIN_VIEWS views, in ascending order.

    Surfaces so far away that a pixel covers more than MAX_PIXEL voxels are left out.  voxel, truncation: scene units.
    """
    keys = [np.zeros(0, np.int64)]
    for image in images:
        points = _unproject(image, truncation, MAX_PIXEL * voxel)
        cells = np.floor(points / (voxel * SIDE)).astype(np.int64) + (1 << 20)
        cells = cells[((cells >= 0) & (cells < 1 << 21)).all(axis=1)]
        keys.append(np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]))
    unique_keys, views = np.unique(np.concatenate(keys), return_counts=True)
    keys_seen = unique_keys[views >= MIN_VIEWS]
    return np.stack([(keys_seen >> shift & (1 << 21) - 1) - (1 << 20) for shift in (42, 21, 0)], axis=1).astype(
        np.int32
    )


def _unproject(image: DepthImage, truncation: float, reach: float) -> NDArray[np.float64]:
    """Return points on, in front of, and behind the surface, [M, 3], for every second pixel in each direction.

    reach: largest size of a pixel on the surface, in scene units; surfaces with larger pixels are left out.
    """
    camera, pose = image.view.camera, image.view.world_to_camera.astype(np.float64)
    pixels = image.depth[::2, ::2]
    row, column = (2 * index for index in np.nonzero((pixels > 0) & (pixels < reach * camera.fx)))
    z = image.depth[row, column].astype(np.float64)
    z = np.concatenate([np.maximum(z - truncation, 0.01 * z), z, z + truncation])
    x = np.tile((column + 0.5 - camera.cx) / camera.fx, 3) * z - pose[0, 3]
    y = np.tile((row + 0.5 - camera.cy) / camera.fy, 3) * z - pose[1, 3]
    z = z - pose[2, 3]
    # no matrix product: BLAS sums in an order that depends on the number of threads
    return np.stack([pose[0, k] * x + pose[1, k] * y + pose[2, k] * z for k in range(3)], axis=1)


@dataclass(frozen=True)
class DistanceField:
    """The distance to the surface and the color at each grid point of blocks."""

    blocks: Blocks
    voxel: float  # scene units
    values: Floats  # [B, SIDE, SIDE, SIDE] distance / truncation, positive in front; NaN if too few views see a point
    colors: NDArray[np.uint8]  # [B, SIDE, SIDE, SIDE, 4] red, green, blue, and 1 where they are known


def fuse(
    device: Device, images: Iterable[DepthImage], blocks: Blocks, voxel: float, truncation: float
) -> DistanceField:
    """Average the distances and colors of all images at the grid points of blocks.  voxel, truncation: scene units."""
    sums = integrate(device, images, blocks, voxel, truncation)
    shape = len(blocks), SIDE, SIDE, SIDE
    values, colors = np.empty(shape, np.float32), np.empty((*shape, 4), np.uint8)
    for start, points in zip(range(0, len(blocks), CHUNK), sums, strict=True):
        table = points.get().reshape(FIELDS, -1, SIDE, SIDE, SIDE)
        target = slice(start, start + CHUNK)
        values[target] = np.where(table[1] >= MIN_VIEWS, table[0] / np.maximum(table[1], 1), np.nan)
        average = np.clip(table[2:5] / np.maximum(table[5], 1), 0, 1)
        colors[target, ..., :3] = np.moveaxis(np.rint(255 * average), 0, -1)
        colors[target, ..., 3] = table[5] > 0
    return DistanceField(blocks, voxel, values, colors)


def integrate(
    device: Device, images: Iterable[DepthImage], blocks: Blocks, voxel: float, truncation: float
) -> list[Array]:
    """Return sums over all images at the grid points, as an array [FIELDS, points] for each chunk of CHUNK blocks."""
    kernels, parts = device.program("fusion.cl"), list(_chunks(device, blocks))
    sums = [device.zeros((FIELDS, count)) for _, count in parts]
    for image in images:
        pixels = device.upload(np.concatenate([image.color, image.depth[:, :, None]], axis=2, dtype=np.float32))
        camera = upload_camera(device, image.view).array
        for (part, count), points in zip(parts, sums, strict=True):
            kernels.integrate_view(
                items=count,
                blocks=part,
                pixels=pixels,
                camera=camera,
                points=points,
                voxel=voxel,
                truncation=truncation,
                count=count,
            )
    return sums


def count_free(device: Device, images: Iterable[DepthImage], blocks: Blocks, voxel: float) -> NDArray[np.uint32]:
    """Return the number of views in which each grid point is in front of the surface, [B, SIDE, SIDE, SIDE]."""
    kernels, parts = device.program("fusion.cl"), list(_chunks(device, blocks))
    counts = [device.upload(np.zeros(count, np.uint32)) for _, count in parts]
    for image in images:
        depths, camera = device.upload(image.depth), upload_camera(device, image.view).array
        for (part, count), views in zip(parts, counts, strict=True):
            kernels.count_free(
                items=count, blocks=part, depths=depths, camera=camera, views=views, voxel=voxel, count=count
            )
    return np.concatenate([views.get() for views in counts]).reshape(-1, SIDE, SIDE, SIDE)


def _chunks(device: Device, blocks: Blocks) -> Iterator[tuple[Array, int]]:
    """Upload the blocks in chunks; yield each with its number of grid points."""
    for start in range(0, len(blocks), CHUNK):
        part = blocks[start : start + CHUNK]
        yield device.upload(part), len(part) * SIDE**3
