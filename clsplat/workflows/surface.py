"""Extract, clean, smooth, and reduce triangle meshes.

Vertices of neighboring blocks are merged if they are on the same edge of the grid, which an integer key identifies.
Their coordinates are not compared, because they may differ by rounding.
"""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from clsplat.core.progress import counted
from clsplat.formats.mesh import Floats, Mesh
from clsplat.render.fusion import SIDE, DistanceField

LOG = logging.getLogger("clsplat")
MIN_VALUE = 2e-3  # smallest absolute distance, so that no vertex is at a grid point, where its edge would be unknown
MIN_FRACTION = 1e-4  # of an edge: a vertex closer to an end is at that end, except for rounding
MIN_PART = 0.01  # of the faces of the largest part; smaller parts are removed
TAUBIN, ROUNDS = (0.5, -0.53), 20  # Taubin 1995: factors of two steps that together do not shrink; number of rounds
MORE_FACES = 1.5  # factor on the number of faces to keep, each time a reduction opens a closed surface


def _pad_blocks(values: NDArray[Any], neighbors: NDArray[np.intp], fill: float) -> NDArray[Any]:
    """Return a block extended by the first layer of the next block along each axis, [SIDE + 1, SIDE + 1, SIDE + 1, …].

    neighbors: [2, 2, 2] indices of the block itself and of the next blocks in `values`; -1: missing.
    """
    block = np.full((SIDE + 1,) * 3 + values.shape[4:], fill, values.dtype)
    parts = slice(0, SIDE), slice(SIDE, SIDE + 1)
    for x, y, z in np.ndindex(2, 2, 2):
        if (row := neighbors[x, y, z]) >= 0:
            first = tuple(slice(0, 1 if side else SIDE) for side in (x, y, z))
            block[parts[x], parts[y], parts[z]] = values[row][first]
    return block


def _next_blocks(blocks: NDArray[np.int32]) -> NDArray[np.intp]:
    """Return the index of each block and of the next blocks along the axes, [B, 2, 2, 2]; -1: missing."""
    rows = {block: row for row, block in enumerate(map(tuple, blocks.tolist()))}
    offsets = list(np.ndindex(2, 2, 2))
    table = [[rows.get((x + i, y + j, z + k), -1) for i, j, k in offsets] for x, y, z in blocks.tolist()]
    return np.array(table, np.intp).reshape(-1, 2, 2, 2)


def extract(field: DistanceField) -> Mesh:
    """Return the surface of a distance field in the cubes whose eight corners are all known (Lorensen & Cline 1987)."""
    vertices, keys, faces, colors, count = [], [], [], [], 0
    low = field.blocks.min(axis=0).astype(np.int64) * SIDE if len(field.blocks) else np.zeros(3, np.int64)
    for block, row in zip(
        counted(field.blocks.astype(np.int64), "blocks extracted", len(field.blocks)),
        _next_blocks(field.blocks),
        strict=True,
    ):
        surface = _march(_pad_blocks(field.values, row, np.nan))
        if surface is None:
            continue
        corners, triangles = surface
        cells, axis = _edges(corners)
        vertices.append(corners + block * SIDE)
        keys.append(np.column_stack([cells + block * SIDE - low, axis]))
        faces.append(triangles + count)
        colors.append(_interpolate(_pad_blocks(field.colors, row, 0), corners))
        count += len(corners)
    if not vertices:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))
    mesh = Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors))
    return weld(replace(mesh, vertices=mesh.vertices * field.voxel), np.concatenate(keys))


def _march(values: NDArray[np.float32]) -> tuple[Floats, NDArray[np.int64]] | None:
    """Return the vertices, in grid steps, and triangles of a block, or None if it has no surface."""
    is_known = np.isfinite(values)
    is_cube = np.ones((SIDE,) * 3, bool)
    for x, y, z in np.ndindex(2, 2, 2):
        is_cube &= is_known[x : SIDE + x, y : SIDE + y, z : SIDE + z]
    distances = np.where(np.abs(values) < MIN_VALUE, np.copysign(np.float32(MIN_VALUE), values), values)
    distances = np.where(is_known, distances, np.float32(1))
    mask = np.zeros(values.shape, bool)
    mask[1:, 1:, 1:] = is_cube  # marching_cubes reads it at the upper corner of each cube
    if not is_cube.any() or not distances.min() < 0 < distances.max():
        return None
    try:
        vertices, faces, _, _ = marching_cubes(distances, 0.0, mask=mask)
    except RuntimeError:  # no surface in the masked cubes
        return None
    return vertices.astype(np.float64), faces.astype(np.int64)


def _edges(vertices: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lower grid point, [V, 3], and the axis, [V], of each vertex's grid edge.  Axis 3: inside a cube."""
    nearest = np.rint(vertices)
    is_between = np.abs(vertices - nearest) > MIN_FRACTION
    cells = np.where(is_between, np.floor(vertices), nearest).astype(np.int64)
    return cells, np.where(is_between.sum(axis=1) == 1, is_between.argmax(axis=1), 3)


def _interpolate(colors: NDArray[np.uint8], vertices: Floats) -> NDArray[np.uint8]:
    """Interpolate the colors of vertices, [V, 3], between the grid points whose colors are known.

    colors: [n, n, n, 4] red, green, blue, and 1 where they are known.
    """
    low, high = np.floor(vertices + MIN_FRACTION).astype(int), np.ceil(vertices - MIN_FRACTION).astype(int)
    fraction = np.clip(vertices - low, 0, 1).max(axis=1, keepdims=True)
    ends = [colors[tuple(corner.T)].astype(np.float64) for corner in (low, high)]
    weights = (1 - fraction) * ends[0][:, 3:], fraction * ends[1][:, 3:]
    total = np.maximum(weights[0] + weights[1], 1e-12)
    average = np.rint((weights[0] * ends[0][:, :3] + weights[1] * ends[1][:, :3]) / total)
    return np.asarray(average, np.uint8)


def weld(mesh: Mesh, keys: NDArray[np.int64]) -> Mesh:
    """Merge vertices that have equal keys, and remove the faces that become degenerate.  keys: [V, 4]."""
    size = keys.max(axis=0) + 1
    flat = ((keys[:, 0] * size[1] + keys[:, 1]) * size[2] + keys[:, 2]) * 4 + keys[:, 3]
    _, first, index = np.unique(flat, return_index=True, return_inverse=True)
    faces = index[mesh.faces]
    joined = Mesh(mesh.vertices[first], faces, mesh.colors[first])
    return joined.select((faces != np.roll(faces, 1, axis=1)).all(axis=1))


def remove_small_parts(mesh: Mesh) -> Mesh:
    """Remove connected parts that have fewer faces than MIN_PART times those of the largest part."""
    if not len(mesh.faces):
        return mesh
    part = connected_components(_adjacency(mesh), directed=False)[1][mesh.faces[:, 0]]
    faces = np.bincount(part)
    return mesh.select(faces[part] >= MIN_PART * faces.max())


def _adjacency(mesh: Mesh) -> Any:
    """Return the sparse adjacency matrix of the vertices, [V, V]: 1 for two vertices that share an edge."""
    first, second = mesh.faces[:, [0, 1, 2]].ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    ends = np.concatenate([first, second]), np.concatenate([second, first])
    matrix = sparse.csr_matrix((np.ones(len(ends[0])), ends), shape=(len(mesh.vertices),) * 2)
    matrix.data[:] = 1  # csr_matrix adds the values of edges that occur twice
    return matrix


def smooth(mesh: Mesh) -> Mesh:
    """Smooth a mesh without shrinking it (Taubin 1995)."""
    if not len(mesh.faces):
        return mesh
    adjacency, vertices = _adjacency(mesh), mesh.vertices
    degree = np.asarray(adjacency.sum(axis=1))
    for factor in TAUBIN * ROUNDS:
        vertices = vertices + factor * (adjacency @ vertices / degree - vertices)
    return replace(mesh, vertices=np.asarray(vertices))


def reduce(mesh: Mesh, keep: float) -> Mesh:
    """Reduce a mesh to a fraction of its faces with quadric error metrics (Garland & Heckbert 1997).

    A closed surface stays closed, even if more faces must be kept.  Requires the package fast-simplification.
    """
    keep = max(keep, 4 / len(mesh.faces))  # a tetrahedron is the smallest closed surface
    if keep >= 1:
        return mesh
    import fast_simplification  # optional

    points, faces = fast_simplification.simplify(mesh.vertices, mesh.faces, 1 - keep)
    points = np.asarray(points, np.float64)
    colors = mesh.colors[cKDTree(mesh.vertices).query(points)[1]]
    reduced = split_edges(Mesh(points, np.asarray(faces, np.int64), colors))
    if mesh.is_closed and not (reduced.is_closed and len(reduced.faces) >= 4):
        LOG.warning("with %.3g of its faces, the surface would not stay closed; more faces are kept", keep)
        return reduce(mesh, keep * MORE_FACES)
    return reduced


def split_edges(mesh: Mesh) -> Mesh:
    """Duplicate vertices so that faces are connected only across edges that belong to exactly two faces."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    corner, next_corner = np.arange(len(start)), np.roll(np.arange(len(start)).reshape(-1, 3), -1, axis=1).ravel()
    is_up = start < end
    low, high = np.where(is_up, corner, next_corner), np.where(is_up, next_corner, corner)
    _, edge, count = np.unique(start[low] * len(mesh.vertices) + start[high], return_inverse=True, return_counts=True)
    order = np.argsort(edge, kind="stable")
    pairs = order[count[edge[order]] == 2].reshape(-1, 2)
    links = np.concatenate([low[pairs], high[pairs]]).T
    graph = sparse.coo_matrix((np.ones(links.shape[1], bool), links), shape=(len(start),) * 2)
    label = connected_components(graph, directed=False)[1]
    vertex = start[np.unique(label, return_index=True)[1]]
    return Mesh(mesh.vertices[vertex], label.reshape(-1, 3).astype(np.int64), mesh.colors[vertex])


def hull(is_free: NDArray[np.bool_], corner: NDArray[np.int64], cell: float) -> Mesh:
    """Return the closed surface of the cells that are not free, dilated by one cell.  Space outside the grid is free.

    is_free: [X, Y, Z]; corner: [3] index of the first grid point of `is_free`; cell: side of a cell, scene units.
    """
    solid = np.pad(ndimage.binary_dilation(~is_free), 2).astype(np.float32)
    level = ndimage.gaussian_filter(solid, 0.7, truncate=1.5)  # equal values at the corners of a cube are ambiguous
    vertices, faces, _, _ = marching_cubes(level, 0.5, gradient_direction="ascent")
    vertices = (vertices.astype(np.float64) + corner - 2) * cell
    return Mesh(vertices, faces.astype(np.int64), np.full((len(vertices), 3), 200, np.uint8))
