"""Represent triangle meshes, and write them as PLY, OBJ, or GLB; write the means of Gaussians as PLY or CSV."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, one_line
from clsplat.core.files import open_atomic
from clsplat.core.reading import read_file, read_text
from clsplat.formats.gltf import write_primitive
from clsplat.formats.packing import open_hashed, write_bytes
from clsplat.formats.ply import format_ply_header, parse_ply_header
from clsplat.formats.splats import FLIP, MAX_LOG, SH_C0, SplatFile, WriteOptions, normalize_quats, opacities

Floats = NDArray[np.float64]
TRIANGLES = 4  # mode of a primitive in glTF
UNLIT = "KHR_materials_unlit"  # the colors already contain the lighting of the photos
ROWS = 4096  # rows of text formatted at once


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; the corners of a face are counterclockwise, seen from outside."""

    vertices: Floats  # [V, 3] scene units
    faces: NDArray[np.int64]  # [F, 3]
    colors: NDArray[np.uint8]  # [V, 3] sRGB

    def normals(self) -> Floats:
        """Return the unit normals of the vertices, [V, 3]: area-weighted means of the normals of their faces."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        by_area, corners, count = np.cross(b - a, c - a), self.faces.ravel(), len(self.vertices)
        total = np.stack([np.bincount(corners, np.repeat(by_area[:, k], 3), count) for k in range(3)], axis=1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.asarray(np.divide(total, length, out=np.zeros_like(total), where=length > 0))

    def edge_counts(self) -> NDArray[np.int64]:
        """Return the number of faces at each edge, [E]: 2 inside a surface, 1 on its border, more if non-manifold."""
        edges = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return np.asarray(np.unique(edges[:, 0] * len(self.vertices) + edges[:, 1], return_counts=True)[1])

    @property
    def is_closed(self) -> bool:
        """Whether every edge has two faces."""
        return bool((self.edge_counts() == 2).all())

    def select(self, is_kept: NDArray[np.bool_]) -> "Mesh":
        """Return the mesh with only the faces for which a mask, [F], is True, and the vertices of these faces."""
        rows, faces = np.unique(self.faces[is_kept], return_inverse=True)
        return Mesh(self.vertices[rows], faces.reshape(-1, 3), self.colors[rows])


def write_ply(path: Path, mesh: Mesh, origin: Floats) -> None:
    """Write a binary PLY file, with float64 coordinates if the scene has an origin.  Raises OutputError."""
    kind, code = ("double", "<f8") if origin.any() else ("float", "<f4")
    names = [*((f"{kind} {name}", code) for name in "xyz"), *((f"float n{name}", "<f4") for name in "xyz")]
    names += [(f"uchar {name}", "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), [(name.split()[1], code) for name, code in names])
    columns = (*(mesh.vertices + origin).T, *mesh.normals().T, *mesh.colors.T)
    for name, column in zip(vertices.dtype.names or (), columns, strict=True):
        vertices[name] = column
    faces = np.empty(len(mesh.faces), TRIANGLE)
    faces["count"], faces["corners"] = 3, mesh.faces
    elements = {
        "vertex": (len(vertices), [name for name, _ in names]),
        "face": (len(faces), ["list uchar int vertex_indices"]),
    }
    with open_atomic(path) as file:
        file.write(format_ply_header(["clsplat"], **elements) + vertices.tobytes() + faces.tobytes())


def write_obj(path: Path, mesh: Mesh, origin: Floats) -> None:
    """Write an OBJ file with vertex colors.  Raises OutputError."""
    vertices = np.concatenate([mesh.vertices + origin, mesh.colors / 255], axis=1)
    corners, number = np.repeat(mesh.faces + 1, 2, axis=1), "%.6f" if origin.any() else "%.9g"
    with open_hashed(path) as file:
        for row, table in (
            (f"v {number} {number} {number} %.4g %.4g %.4g\n", vertices),
            ("vn %.4g %.4g %.4g\n", mesh.normals()),
            ("f %d//%d %d//%d %d//%d\n", corners),
        ):
            for start in range(0, len(table), ROWS):
                block = table[start : start + ROWS]
                file.write((row * len(block) % tuple(block.ravel().tolist())).encode())


def write_glb(path: Path, mesh: Mesh, origin: Floats) -> None:
    """Write a GLB file: y is up, vertex colors have 16 bits, and the origin is the translation of the mesh's node.

    Raises OutputError.
    """
    color = mesh.colors / 255
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)  # sRGB, IEC 61966-2-1
    attributes = {
        "POSITION": (mesh.vertices * FLIP).astype("<f4"),
        "NORMAL": (mesh.normals() * FLIP).astype("<f4"),
        "COLOR_0": np.rint(65535 * np.column_stack([linear, np.ones(len(linear))])).astype("<u2"),
    }
    material = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True}
    tree = {"materials": [{**material, "extensions": {UNLIT: {}}}], "extensionsUsed": [UNLIT]}
    primitive, translation = {"mode": TRIANGLES, "material": 0}, origin.tolist() if origin.any() else None
    write_primitive(path, attributes, primitive, tree, translation, mesh.faces.astype("<u4"))


WRITERS: dict[str, Callable[[Path, Mesh, Floats], None]] = {".ply": write_ply, ".obj": write_obj, ".glb": write_glb}

# Meshes for collisions.

TRIANGLE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
FACES = re.compile(rb"\nelement face (\d+)\r?\nproperty list uchar u?int vertex_ind(?:ex|ices)\r?\nend_header")


def read_collider(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """Return the vertices, [V, 3] world coordinates, and the triangles, [F, 3], of a PLY or OBJ file.

    Raises ConfigError, DataError.
    """
    read = {".ply": _read_ply, ".obj": _read_obj}.get(path.suffix.lower())
    if read is None:
        raise ConfigError(f"--collider {path}: expected a .ply or .obj mesh, such as one of `clsplat mesh --collision`")
    try:
        vertices, faces = read(path)
    except (ValueError, IndexError) as error:
        raise DataError(f"{path}: {one_line(error)}; export the mesh again, as triangles") from error
    if not len(faces) or not np.isfinite(vertices).all() or not 0 <= faces.min() <= faces.max() < len(vertices):
        raise DataError(f"{path}: has no faces, or faces without vertices; export the mesh again")
    return vertices, faces


def _read_ply(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    data = read_file(path, "a mesh")
    header = parse_ply_header(path, data)
    match = FACES.search(data, 0, header.start)
    if header.format != "binary_little_endian" or match is None:
        raise ValueError("expected a binary little-endian PLY with faces as lists of vertex_indices")
    vertices = np.frombuffer(data, header.dtype, header.count, header.start)
    end = header.start + vertices.nbytes
    rows = np.frombuffer(data, TRIANGLE, int(match[1]), end)
    if (rows["count"] != 3).any():
        raise ValueError("expected only triangles")
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1), rows["corners"].astype(np.int64)


def _read_obj(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    lines = read_text(path, "a mesh").splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], np.float64).reshape(-1, 3)
    faces = [[int(corner.split("/")[0]) for corner in line.split()[1:]] for line in lines if line.startswith("f ")]
    triangles = [(face[0], *face[i : i + 2]) for face in faces for i in range(1, len(face) - 1)]
    corners = np.array(triangles, np.int64).reshape(-1, 3)
    return vertices, np.where(corners < 0, corners + len(vertices), corners - 1)


# The means of Gaussians in world coordinates, for programs that cannot show Gaussians.

COLUMNS = "x,y,z,red,green,blue,opacity,scale_x,scale_y,scale_z,rotation_w,rotation_x,rotation_y,rotation_z\n"
CSV_ROW = ",".join(["%.10g"] * 3 + ["%d"] * 3 + ["%.6g"] * 8) + "\n"


def write_points(path: Path, splats: SplatFile, options: WriteOptions) -> str:
    """Write a PLY of points with colors; return its SHA-256.  Raises OutputError."""
    positions, colors = _points(splats)
    rows = np.zeros(len(splats), [("position", "<f8", 3), ("color", "u1", 3)])
    rows["position"], rows["color"] = positions, colors
    names = ["double x", "double y", "double z", "uchar red", "uchar green", "uchar blue"]
    return write_bytes(path, format_ply_header(["clsplat"], vertex=(len(rows), names)) + rows.tobytes())


def write_csv(path: Path, splats: SplatFile, options: WriteOptions) -> str:
    """Write a table with a row per Gaussian; return its SHA-256.  Raises OutputError.

    Colors are from 0 to 255, opacities from 0 to 1, scales are standard deviations, and quaternions have unit length.
    """
    p = splats.parameters
    scales = np.exp(np.minimum(p["log_scales"], MAX_LOG))
    table = np.hstack([*_points(splats), opacities(p["logit_opacity"]), scales, normalize_quats(p["quats"])])
    with open_hashed(path) as file:
        file.write(COLUMNS.encode())
        for start in range(0, len(table), ROWS):
            block = table[start : start + ROWS]
            file.write((CSV_ROW * len(block) % tuple(block.ravel().tolist())).encode())
    return file.sha256


def _points(splats: SplatFile) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the means, [N, 3] world coordinates, and the colors without harmonics, [N, 3] sRGB."""
    p = splats.parameters
    colors = np.rint(255 * np.clip(p["sh_base"] * SH_C0 + 0.5, 0, 1)).astype(np.uint8)
    return p["means"] + np.array(splats.rendering.get("origin", [0.0, 0.0, 0.0])), colors
