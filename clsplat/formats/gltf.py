"""The parts of glTF that hold Gaussians: primitives, where their node stands, and accessors."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, quoted

LOG = logging.getLogger("clsplat")
EXTENSION = "KHR_gaussian_splatting"
PREFIX = f"{EXTENSION}:"
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
SHARED = 8  # times that a byte is read, on average: equal columns may be one accessor
FLIP = np.diag([1.0, -1, -1, 1])  # between the axes of glTF and those of a PLY


class NoIndex(ValueError):
    """A value is no index, size or offset; the message tells it in words."""


class Gltf:
    """A file's primitives of Gaussians, all in the same place.

    Raises DataError where there are none, or more than one place; for a tree that is damaged the errors of Python,
    which `fault` tells in words.
    """

    def __init__(self, path: Path, tree: dict[str, Any], binary: bytes) -> None:
        self.path, self.tree, self.binary = path, tree, binary
        self.left = SHARED * len(binary)  # bytes that may still be read
        self.primitives: list[dict[str, Any]] = []
        self.placement: NDArray[np.float64] | None = None  # [4, 4] in the axes of a PLY
        placements = []
        for mesh, matrix in self._meshes():
            for primitive in tree["meshes"][mesh]["primitives"]:
                extension = primitive.get("extensions", {}).get(EXTENSION)
                if extension is not None:
                    self._check(extension)
                    self.primitives.append(primitive)
                    placements.append(matrix)
        if not self.primitives:
            raise DataError(
                f"{path}: holds no Gaussians ({EXTENSION}); expected a primitive that has some: export it again"
            )
        if any(not np.allclose(one, placements[0]) for one in placements):
            raise DataError(f"{path}: its Gaussians stand in several places; export them apart, then merge them")
        if not np.allclose(placements[0], np.eye(4)):
            self.placement = FLIP @ placements[0] @ FLIP

    def accessor(self, number: Any, width: int) -> NDArray[np.float32]:
        """Return the rows of an accessor, [count, width]; normalised whole numbers as those in [-1, 1]."""
        one = self.tree["accessors"][_index(number)]
        kind, count, start = COMPONENTS[one["componentType"]], _index(one["count"]), _index(one.get("byteOffset", 0))
        view = self.tree["bufferViews"][_index(one["bufferView"])]
        buffer = self.tree["buffers"][_index(view["buffer"])]
        if WIDTHS.get(one["type"]) != width or "sparse" in one or view["buffer"] or "uri" in buffer:
            raise DataError(
                f"{self.path}: accessor {number} is a {quoted(one['type'])}, or lies elsewhere; expected {width} "
                "numbers a row in the file itself: export it again"
            )
        size = width * np.dtype(kind).itemsize
        stride = _index(view.get("byteStride", size))
        length, offset = _index(view["byteLength"]), _index(view.get("byteOffset", 0))
        if stride < size:
            raise DataError(
                f"{self.path}: the rows of accessor {number} are {stride} bytes apart; expected {size} at least: "
                "export it again"
            )
        held = min(_index(buffer["byteLength"]), len(self.binary))
        if offset + length > held or start + stride * max(count - 1, 0) + size * min(count, 1) > length:
            raise DataError(
                f"{self.path}: accessor {number} has {count} rows, more than its view of {length} bytes from {offset} "
                f"on holds, or than the file, whose buffer has {held} bytes; copy or export it again"
            )
        start += offset
        self.left -= count * size
        if self.left < 0:
            raise DataError(f"{self.path}: its accessors share their numbers too often; export it again")
        rows = np.ndarray((count, width), kind, self.binary, start, (stride, np.dtype(kind).itemsize))
        if not one.get("normalized") or kind == "<f4":
            return rows.astype(np.float32)
        return np.maximum(rows / np.float32(np.iinfo(kind).max), -1).astype(np.float32)

    def _check(self, extension: dict[str, Any]) -> None:
        kernel, space = extension.get("kernel", "ellipse"), extension.get("colorSpace", "srgb_rec709_display")
        if kernel != "ellipse":
            raise DataError(f"{self.path}: its kernel is {quoted(kernel)}; expected 'ellipse': export it again")
        if space != "srgb_rec709_display":
            LOG.warning("%s: its colours are %s; they are taken as they are", self.path, quoted(space))

    def _meshes(self) -> list[tuple[int, NDArray[np.float64]]]:
        """The meshes of the scene, each with the matrix of its node."""
        nodes = self.tree["nodes"]
        found: list[tuple[int, NDArray[np.float64]]] = []
        seen: set[int] = set()
        waiting = [(_index(root), np.eye(4)) for root in self._roots()]
        while waiting:
            number, above = waiting.pop()
            if number in seen:
                raise DataError(f"{self.path}: its nodes are no tree, node {number} occurs twice; export it again")
            seen.add(number)
            matrix = above @ self._matrix(number)
            if not np.isfinite(matrix).all():
                raise DataError(
                    f"{self.path}: node {number} has no finite place; expected finite numbers: export it again"
                )
            if "mesh" in nodes[number]:
                found.append((_index(nodes[number]["mesh"]), matrix))
            waiting += [(_index(child), matrix) for child in nodes[number].get("children", [])]
        return found

    def _matrix(self, number: int) -> NDArray[np.float64]:
        """Where a node stands in the one above, [4, 4].  Raises DataError for a quaternion without a direction."""
        node = self.tree["nodes"][number]
        if "matrix" in node:
            return np.array(node["matrix"], np.float64).reshape(4, 4).T
        quaternion = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)
        length = np.linalg.norm(quaternion)
        if not 0 < length < np.inf:
            raise DataError(
                f"{self.path}: the rotation of node {number} is a quaternion of length {length:g}; expected 1: export "
                "it again"
            )
        x, y, z, w = quaternion / length
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] *= np.array(node.get("scale", [1, 1, 1]), np.float64)
        matrix[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64)
        return matrix

    def _roots(self) -> list[int]:
        """The nodes of the scene; without one, those that are nobody's child."""
        if "scenes" in self.tree and (roots := self.tree["scenes"][_index(self.tree.get("scene", 0))]["nodes"]):
            return list(roots)
        nodes = self.tree["nodes"]
        return sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})


def fault(error: Exception) -> str:
    """Return in words what an error of Python says about a tree."""
    if isinstance(error, NoIndex):
        return str(error)
    if isinstance(error, json.JSONDecodeError):
        return f"line {error.lineno}, column {error.colno}: {error.msg}"
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.start} is no UTF-8"
    if isinstance(error, RecursionError):
        return "nested too deeply"
    if isinstance(error, KeyError):
        return f"{quoted(error.args[0])} is missing or unknown"
    if isinstance(error, IndexError):
        return "an index is beyond the end of its list"
    return "a value is of another kind, size or shape than in glTF 2.0"


def _index(value: Any) -> int:
    """A whole number from 0 on.  Raises NoIndex."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 40:
        raise NoIndex(f"{quoted(value)} where a whole number from 0 on is expected")
    return value
