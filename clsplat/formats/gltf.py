"""Read .glb and .gltf files with KHR_gaussian_splatting, and write .glb files.

    POSITION 3 · ROTATION x y z w, unit · SCALE 3, linear · OPACITY in [0, 1] · SH_DEGREE_l_COEF_m 3, in the order and
    with the signs of f_rest · COLOR_0 r g b a, linear, for viewers without the extension

Axes of glTF are x right, y up, z back.  Gaussians are converted to these axes; their node is not rotated,
because the extension does not specify whether viewers rotate SH with a node.
"""

import base64
import json
import logging
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, first_few, one_line, quote
from clsplat.core.files import is_inside
from clsplat.core.harmonics import map_colors
from clsplat.core.quaternions import rotation_matrix
from clsplat.core.reading import read_file, read_json
from clsplat.formats.packing import open_hashed
from clsplat.formats.ply import read_extras
from clsplat.formats.splats import (
    FLIP,
    MAX_DEGREE,
    MAX_FILE,
    SH_C0,
    Parameters,
    SplatFile,
    WriteOptions,
    flip_axes,
    join_parts,
    normalize_quats,
    opacities,
    opacities_to_logits,
    require_gaussians,
    require_memory,
    scales_to_logs,
)
from clsplat.formats.spz import MAX_RATIO, MIN_LIMIT, decode_spz

# The parts of glTF with Gaussians: primitives, the transforms of their nodes, and accessors.

LOG = logging.getLogger("clsplat")
EXTENSION = "KHR_gaussian_splatting"
PREFIX = f"{EXTENSION}:"
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
# extensions that are supported, or have no effect on Gaussians
SUPPORTED = re.compile(f"{EXTENSION}|KHR_mesh_quantization|KHR_(materials|texture)_.*|.*spz.*")
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
MAX_READS = 8  # largest average number of reads per byte; equal columns may share an accessor
SRGB, LINEAR = "srgb_rec709_display", "lin_rec709_display"
LEFT_UP_FRONT = (-1.0, -1.0, 1.0)  # converts between left, up, front and the axes of a PLY
MAX_NAME = 500  # characters of the longest file name, and of the longest start of a data URI
MAX_TEXT = 1 << 29  # bytes of the largest .gltf


class Gltf:
    """The Gaussian primitives of a file.

    Raises DataError if there are none, and built-in errors such as KeyError if the tree is damaged.
    """

    def __init__(self, path: Path, tree: dict[str, Any], binary: bytes | None) -> None:
        self.path, self.tree, self.binary = path, tree, binary
        self.bytes_left = self.spz_bytes = 0  # bytes that may still be read, and bytes of unpacked SPZ data
        self.files: dict[str | None, bytes] = {}  # the content of buffers, by their URIs
        self.notes: set[str] = set()  # remarks about the file, for the user
        self.is_mip = False
        if unknown := [name for name in tree.get("extensionsRequired", []) if not SUPPORTED.fullmatch(name)]:
            names = first_few(list(map(quote, unknown)))
            raise DataError(f"{path}: requires {names}, which clsplat does not support; export it again without them")
        pairs = [(part, matrix) for mesh, matrix in self._meshes() for part in tree["meshes"][mesh]["primitives"]]
        self.primitives = [pair for pair in pairs if _has_gaussians(_extensions(pair[0]))]
        if not self.primitives:
            raise DataError(f"{path}: has no Gaussians ({EXTENSION}); export it again with that extension")

    def parts(self) -> Iterator[tuple[Parameters, NDArray[np.float64]]]:
        """Yield the Gaussians of each primitive in the axes of a PLY, and its matrix in the axes of glTF."""
        for primitive, matrix in self.primitives:
            yield flip_axes(self._read_primitive(primitive)), matrix

    def _read_primitive(self, primitive: dict[str, Any]) -> Parameters:
        """Return the Gaussians of one primitive, in the axes of glTF."""
        extensions = _extensions(primitive)
        extension, attributes = extensions.get(EXTENSION, {}), primitive["attributes"]
        kernel, space = extension.get("kernel", "ellipse"), extension.get("colorSpace", SRGB)
        if kernel != "ellipse":
            raise DataError(f"{self.path}: its kernel is {quote(kernel)}; expected 'ellipse'; export it again")
        if (view := _spz_view(extensions)) is not None:
            part = self._read_spz(view, attributes)
        elif compressions := [name for name in extension.get("extensions", {}) if "compression" in name]:
            raise DataError(f"{self.path}: is compressed with {quote(compressions[0])}; export it without compression")
        else:
            part = self._read_attributes(attributes)
        if space == LINEAR:
            self.notes.add("its colors are linear: they are converted to sRGB, which is exact only for SH degree 0")
            bands = np.concatenate([part["sh_base"], part["sh_rest"]], axis=1)
            bands = map_colors(bands.reshape(len(bands), -1, 3), _to_srgb).reshape(bands.shape).astype(np.float32)
            part |= {"sh_base": bands[:, :3], "sh_rest": bands[:, 3:]}
        elif space != SRGB:
            self.notes.add(f"its colors are {quote(space)}; they are used unchanged")
        return part

    def _read_spz(self, view: Any, attributes: dict[str, Any]) -> Parameters:
        """Return the Gaussians of an SPZ file in a buffer view, in the axes of glTF.

        The data should use the axes x left, y up, z front, but some programs keep the axes of SPZ.  The axes that fit
        the declared bounds best are assumed.
        """
        data, start, length, _ = self._buffer_view(view)
        splats, _ = decode_spz(self.path, data[start : start + length])
        self.is_mip |= splats.mode == "mip"
        self.spz_bytes += sum(table.nbytes for table in splats.parameters.values())
        if self.spz_bytes > 4 * max(MAX_RATIO * sum(map(len, self.files.values())), MIN_LIMIT):  # limit of one SPZ file
            raise DataError(
                f"{self.path}: its SPZ data decompresses to {self.spz_bytes} bytes, which is too many; export it again"
            )
        part, axes = splats.parameters, [LEFT_UP_FRONT, FLIP]
        position = self.tree["accessors"][_index(attributes["POSITION"])] if "POSITION" in attributes else {}
        if len(splats) and {"min", "max"} <= position.keys():
            bounds = [part["means"].min(axis=0), part["means"].max(axis=0)]
            target = np.array([position["min"], position["max"]], np.float64)
            axes.sort(key=lambda signs: float(np.abs(np.sort(bounds * np.array(signs), axis=0) - target).sum()))
        return flip_axes(part, axes[0])

    def _read_attributes(self, attributes: dict[str, Any]) -> Parameters:
        """Return the Gaussians stored in the attributes of a primitive, in the axes of glTF."""

        def table(name: str, width: int) -> NDArray[np.float32]:
            if name not in attributes:
                raise DataError(f"{self.path}: its Gaussians have no attribute {name}; export the file again")
            return self.accessor(attributes[name], width)

        degree = max((d for d in range(MAX_DEGREE + 1) if f"{PREFIX}SH_DEGREE_{d}_COEF_0" in attributes), default=0)
        bands = [table(name, 3) for name in _sh_names(degree)]
        means = table("POSITION", 3)
        parameters = {
            "means": means,
            "quats": np.roll(table(f"{PREFIX}ROTATION", 4), 1, axis=1),
            "log_scales": scales_to_logs(table(f"{PREFIX}SCALE", 3), self.notes),
            "logit_opacity": opacities_to_logits(table(f"{PREFIX}OPACITY", 1), self.notes),
            "sh_base": bands[0],
            "sh_rest": np.concatenate(bands[1:], axis=1) if degree else np.zeros((len(means), 0), np.float32),
        }
        if len(set(map(len, parameters.values()))) > 1:
            raise DataError(f"{self.path}: the attributes of its Gaussians have different counts; export it again")
        return parameters

    def accessor(self, index: Any, width: int) -> NDArray[np.float32]:
        """Return the rows of an accessor, [count, width].  Normalized integers are scaled to [-1, 1]."""
        row = self.tree["accessors"][_index(index)]
        dtype, count, start = COMPONENTS[row["componentType"]], _index(row["count"]), _index(row.get("byteOffset", 0))
        if WIDTHS.get(row["type"]) != width or "sparse" in row or "bufferView" not in row:
            raise DataError(
                f"{self.path}: accessor {index} has type {quote(row['type'])}, is sparse, or has no data; "
                f"expected {width} numbers per element in a buffer; export it again without compression"
            )
        size = width * np.dtype(dtype).itemsize
        data, offset, length, stride = self._buffer_view(row["bufferView"], size)
        if stride < size:
            raise DataError(
                f"{self.path}: the elements of accessor {index} are {stride} bytes apart; expected at least {size}; "
                "export it again"
            )
        if start + stride * max(count - 1, 0) + size * min(count, 1) > length:
            raise DataError(
                f"{self.path}: accessor {index} has {count} elements, more than fit into its buffer view of {length} "
                "bytes; copy or export it again"
            )
        self.bytes_left -= count * size
        if self.bytes_left < 0:
            raise DataError(f"{self.path}: its accessors share too much data; export it again")
        require_memory(self.path, count, 0)
        rows = np.ndarray((count, width), dtype, data, start + offset, (stride, np.dtype(dtype).itemsize))
        if not row.get("normalized") or dtype == "<f4":
            return rows.astype(np.float32)
        return np.maximum(rows / np.float32(np.iinfo(dtype).max), -1).astype(np.float32)

    def _buffer_view(self, index: Any, stride: int = 0) -> tuple[bytes, int, int, int]:
        """Return the buffer of a view, and the view's offset, length, and stride (by default `stride`), in bytes."""
        view = self.tree["bufferViews"][_index(index)]
        if compressions := [name for name in view.get("extensions", {}) if "compression" in name]:
            raise DataError(f"{self.path}: is compressed with {quote(compressions[0])}; export it without compression")
        buffer = self.tree["buffers"][_index(view["buffer"])]
        data = self._content(buffer.get("uri"), view["buffer"])
        length, offset = _index(view["byteLength"]), _index(view.get("byteOffset", 0))
        size = min(_index(buffer["byteLength"]), len(data))
        if offset + length > size:
            raise DataError(
                f"{self.path}: view {index} has {length} bytes at {offset}, more than its buffer of {size} bytes; "
                "copy or export it again"
            )
        return data, offset, length, _index(view.get("byteStride", stride))

    def _content(self, uri: Any, index: int) -> bytes:
        """Return the bytes of a buffer, from the GLB itself, a data URI, or a file in the same folder."""
        if uri in self.files and (uri or not index):
            return self.files[uri]
        data = None
        if isinstance(uri, str) and re.match("https?://", uri):
            raise DataError(
                f"{self.path}: buffer {index} is at {quote(uri)}, and clsplat does not read from the web; download it "
                "into the folder of the file, and change its uri to the file name"
            )
        if uri is None:
            data = None if index else self.binary
        elif uri.startswith("data:"):
            data = base64.b64decode(uri.partition(",")[2]) if ";base64," in uri[:MAX_NAME] else None
        elif len(uri) < MAX_NAME and is_inside(name := unquote(uri)):
            data = read_file(self.path.parent / name, f"a buffer of {self.path.name}", limit=MAX_FILE)
        if data is None:
            raise DataError(
                f"{self.path}: buffer {index} is {quote(uri)}; expected data in the file, or a file in its folder; "
                "export it again"
            )
        self.files[uri] = data
        self.bytes_left += MAX_READS * len(data)
        return data

    def _meshes(self) -> list[tuple[int, NDArray[np.float64]]]:
        """Return the index of each mesh in the scene and the world matrix, [4, 4], of its node."""
        nodes = self.tree["nodes"]
        meshes: list[tuple[int, NDArray[np.float64]]] = []
        visited_nodes: set[int] = set()
        pending = [(_index(root), np.eye(4)) for root in self._roots()]
        while pending:
            index, parent_matrix = pending.pop()
            if index in visited_nodes:
                raise DataError(f"{self.path}: its nodes are not a tree: node {index} occurs twice; export it again")
            visited_nodes.add(index)
            matrix = parent_matrix @ self._matrix(index)
            if not np.isfinite(matrix).all():
                raise DataError(f"{self.path}: node {index} has no finite transform; export it again")
            if "mesh" in nodes[index]:
                meshes.append((_index(nodes[index]["mesh"]), matrix))
            pending += [(_index(child), matrix) for child in nodes[index].get("children", [])]
        return meshes

    def _matrix(self, index: int) -> NDArray[np.float64]:
        """Return the transform of a node, [4, 4].  Raises DataError for a zero or non-finite quaternion."""
        node = self.tree["nodes"][index]
        if "matrix" in node:
            return np.array(node["matrix"], np.float64).reshape(4, 4).T
        quaternion = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)
        length = np.linalg.norm(quaternion)
        if not 0 < length < np.inf:
            raise DataError(
                f"{self.path}: the rotation of node {index} is a quaternion of length {length:g}; expected 1; export "
                "it again"
            )
        x, y, z, w = quaternion / length
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_matrix(w, x, y, z)
        matrix[:3, :3] *= np.array(node.get("scale", [1, 1, 1]), np.float64)
        matrix[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64)
        return matrix

    def _roots(self) -> list[int]:
        """Return the root nodes of the scene; without a scene, the nodes without a parent."""
        if "scenes" in self.tree and (roots := self.tree["scenes"][_index(self.tree.get("scene", 0))]["nodes"]):
            return list(roots)
        nodes = self.tree["nodes"]
        return sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})


def _extensions(primitive: dict[str, Any]) -> dict[str, Any]:
    """Return the extensions of a primitive, including those nested in KHR_gaussian_splatting."""
    extensions: dict[str, Any] = primitive.get("extensions", {})
    return {**extensions, **extensions.get(EXTENSION, {}).get("extensions", {})}


def _has_gaussians(extensions: dict[str, Any]) -> bool:
    return EXTENSION in extensions or _spz_view(extensions) is not None


def _spz_view(extensions: dict[str, Any]) -> Any:
    """Return the buffer view that contains an SPZ file, under any draft name of the extension; None without one."""
    return next((extension["bufferView"] for name, extension in extensions.items() if "spz" in name), None)


def _sh_names(degree: int) -> list[str]:
    """Return the attribute names of the SH coefficients up to a degree, in order."""
    return [f"{PREFIX}SH_DEGREE_{d}_COEF_{m}" for d in range(degree + 1) for m in range(2 * d + 1)]


def _to_srgb(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert linear colors to sRGB (IEC 61966-2-1); negative values become 0."""
    color = np.maximum(linear, 0)
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)


def _index(value: Any) -> int:
    """Return an index, size, or offset unchanged.  Raises ValueError unless it is an integer of at least 0."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 40:
        raise ValueError(f"expected a whole number of at least 0, got {quote(value)}")
    return value


MAGIC = b"glTF"
JSON, BINARY = 0x4E4F534A, 0x004E4942  # types of chunks
POINTS = 0  # mode of a primitive
FLOAT, BYTE, SHORT = 5126, 5121, 5123  # component types
KINDS = {np.dtype(c): kind for c, kind in (("<f4", FLOAT), ("u1", BYTE), ("<u2", SHORT), ("<u4", 5125))}
INDICES = "indices"  # key of a primitive
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
MAX_JSON = 1 << 26  # bytes of the largest JSON chunk of a .glb


def looks_like_gltf(data: bytes) -> bool:
    """Return whether the first bytes are those of a .glb, or of a .gltf with Gaussians."""
    return data.startswith(MAGIC) or (data.lstrip()[:1] == b"{" and EXTENSION.encode() in data)


def gltf_files(path: Path) -> list[Path]:
    """Return the paths of a .gltf file and of its buffers; only the .gltf file if it is damaged."""
    try:
        uris = [unquote(buffer["uri"]) for buffer in read_json(path)["buffers"]]
        return [path, *(path.parent / uri for uri in uris if is_inside(uri) and not uri.startswith("data:"))]
    except (DataError, KeyError, TypeError, AttributeError):
        return [path]


def read_gltf(path: Path) -> SplatFile:
    """Read the Gaussians of a .glb or .gltf file.  Raises DataError if it is missing, damaged, or without Gaussians."""
    data = read_file(path, "a .glb or .gltf file", limit=MAX_FILE)
    is_text = not data.startswith(MAGIC) and (path.suffix.lower() == ".gltf" or data.lstrip()[:1] == b"{")
    text, binary = (data, None) if is_text else _read_chunks(path, data)
    if len(text) > (limit := MAX_TEXT if is_text else MAX_JSON):
        raise DataError(f"{path}: its JSON has {len(text)} bytes; expected at most {limit}; export fewer primitives")
    try:
        tree = json.loads(text)
        gltf = Gltf(path, tree, binary)
        parameters, placement = join_parts(path, gltf.parts())
        rendering = read_extras(path, tree.get("asset", {}))
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise DataError(
            f"{path}: its JSON is damaged ({type(error).__name__}: {one_line(error)}); copy or export the file again"
        ) from error
    for note in sorted(gltf.notes):
        LOG.warning("%s: %s", path, note)
    if rendering.pop("origin", None) and placement is not None:  # the node's translation is the current origin
        rendering["origin"] = placement[:3, 3].tolist()
        placement[:3, 3] = 0
    return SplatFile(
        parameters, rendering, "mip" if rendering.get("compensate") or gltf.is_mip else "default", placement
    )


def write_glb(path: Path, splats: SplatFile, options: WriteOptions) -> str:
    """Write Gaussians as one primitive; return the SHA-256 of the file.  Raises OutputError."""
    require_gaussians(path, splats)
    primitive = {"mode": POINTS, "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": SRGB}}}
    tree: dict[str, Any] = {"extensionsUsed": [EXTENSION]}
    if splats.rendering:
        tree["asset"] = {"extras": {"clsplat": splats.rendering}}
    attributes = _make_attributes(flip_axes(splats.parameters))
    return write_primitive(path, attributes, primitive, tree, splats.rendering.get("origin"))


def write_primitive(
    path: Path,
    attributes: dict[str, NDArray[Any]],
    primitive: dict[str, Any],
    tree: dict[str, Any],
    origin: Sequence[float] | None = None,
    indices: NDArray[np.uint32] | None = None,
) -> str:
    """Write a .glb file with one primitive; return its SHA-256.  Raises OutputError.

    attributes: tables [N, components] in the axes of glTF; integers are normalized.  primitive, tree: other entries of
    the primitive and of the file.  origin: world coordinates of the model's origin, [3], in the axes of a PLY.
    indices: the vertices of triangles, [triangles, 3].
    """
    tables = attributes if indices is None else {**attributes, INDICES: indices.reshape(-1, 1)}
    views: list[Any] = []
    accessors: list[Any] = []
    for name, table in tables.items():
        kind = KINDS[table.dtype]
        accessor = {"bufferView": len(views), "componentType": kind, "count": len(table), "type": TYPES[table.shape[1]]}
        if kind in (BYTE, SHORT):
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        start = sum(view["byteLength"] for view in views)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": table.nbytes})
        accessors.append(accessor)
    end = sum(view["byteLength"] for view in views)
    names = {name: i for i, name in enumerate(tables)}
    primitive = {**primitive, "attributes": {name: names[name] for name in attributes}}
    if indices is not None:
        primitive[INDICES] = names[INDICES]
    translation = {"translation": (np.array(FLIP) * origin).tolist()} if origin else {}
    tree = {
        **tree,
        "asset": {"version": "2.0", "generator": "clsplat", **tree.get("asset", {})},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **translation}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": end}],
    }
    text = json.dumps(tree, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    with open_hashed(path) as file:
        file.write(struct.pack("<4s2I", MAGIC, 2, 12 + 8 + len(text) + 8 + end))
        file.write(struct.pack("<2I", len(text), JSON) + text + struct.pack("<2I", end, BINARY))
        for table in tables.values():
            file.write(table.tobytes())
    return file.sha256


def _make_attributes(p: Parameters) -> dict[str, NDArray[Any]]:
    """Return the glTF attributes by name, [N, components] float32 or uint8."""
    alpha = opacities(p["logit_opacity"])
    color = np.clip(SH_C0 * p["sh_base"].astype(np.float64) + 0.5, 0, 1)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)  # sRGB, IEC 61966-2-1
    with np.errstate(over="ignore"):
        scale = np.minimum(np.exp(p["log_scales"].astype(np.float64)), np.finfo(np.float32).max)
    tables: dict[str, NDArray[Any]] = {
        "POSITION": p["means"],
        f"{PREFIX}ROTATION": np.roll(normalize_quats(p["quats"]), -1, axis=1),
        f"{PREFIX}SCALE": scale,
        f"{PREFIX}OPACITY": alpha,
    }
    bands = np.concatenate([p["sh_base"], p["sh_rest"]], axis=1)
    tables |= {name: bands[:, 3 * i : 3 * i + 3] for i, name in enumerate(_sh_names(MAX_DEGREE)[: bands.shape[1] // 3])}
    attributes = {name: np.ascontiguousarray(table, "<f4") for name, table in tables.items()}
    attributes["COLOR_0"] = np.rint(255 * np.concatenate([linear, alpha], axis=1)).astype(np.uint8)
    return attributes


def _read_chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """Return the JSON and the binary chunk of a .glb file.  Raises DataError."""
    chunks: dict[int, bytes] = {}
    start = 12
    if data[:4] != MAGIC or len(data) < 20 or data[4:8] != b"\2\0\0\0":
        raise DataError(f"{path}: not a .glb file of glTF 2.0; copy or export it again")
    while start + 8 <= len(data):
        length, chunk_type = struct.unpack_from("<2I", data, start)
        if length > len(data) - start - 8:
            raise DataError(f"{path}: has {len(data)} bytes, but its chunks are longer; copy or export it again")
        chunks.setdefault(chunk_type, data[start + 8 : start + 8 + length])
        start += 8 + length
    text = chunks.get(JSON, b"")
    if not text:
        raise DataError(f"{path}: has no JSON chunk; copy or export it again")
    return text, chunks.get(BINARY, b"")
