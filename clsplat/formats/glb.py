"""glTF with KHR_gaussian_splatting, in its binary container: points with attributes, one accessor each.

    POSITION 3 · ROTATION x y z w, unit · SCALE 3, linear · OPACITY in [0, 1] · SH_DEGREE_l_COEF_m 3, in the order and
    with the signs of f_rest · COLOR_0 r g b a, linear, for viewers without the extension

Axes of glTF are x right, y up, z back: y and z of the Gaussians are turned, not the node, for the extension leaves it
to a viewer whether it turns harmonics with a node.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.formats.gltf import EXTENSION, PREFIX, Gltf, fault
from clsplat.formats.output import written
from clsplat.formats.ply import checked_numbers
from clsplat.formats.splats import (
    MAX_DEGREE,
    MAX_FILE,
    SH_C0,
    Parameters,
    SplatFile,
    Writing,
    flipped,
    logits,
    logs,
    opacities,
    require_some,
    unit,
)
from clsplat.reading import read_file

MAGIC = b"glTF"
JSON, BINARY = 0x4E4F534A, 0x004E4942  # kinds of chunks
POINTS = 0  # mode of a primitive
FLOAT, BYTE = 5126, 5121  # kinds of components
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
MAX_JSON = 1 << 26  # bytes


def read_glb(path: Path) -> SplatFile:
    """Read the Gaussians of a .glb file.  Raises DataError when it is missing, damaged or has none."""
    data = read_file(path, "a .glb file", limit=MAX_FILE)
    text, binary = _chunks(path, data)
    try:
        tree = json.loads(text)
        found = Gltf(path, tree, binary)
        parts = [_parameters(path, found, primitive) for primitive in found.primitives]
        degrees = {part["sh_rest"].shape[1] for part in parts}
        extras = tree.get("asset", {}).get("extras")
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise DataError(f"{path}: its JSON is damaged ({fault(error)}); copy or export the file again") from error
    if len(degrees) > 1:
        raise DataError(f"{path}: its parts have different SH degrees; expected one: export them apart")
    parameters = flipped({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    ours = extras.get("clsplat") if isinstance(extras, dict) else None
    rendering = checked_numbers(path, ours) if isinstance(ours, dict) else {}
    return SplatFile(parameters, rendering, "mip" if rendering.get("compensate") else "default", found.placement)


def write_glb(path: Path, splats: SplatFile, options: Writing) -> str:
    """Write Gaussians as one primitive.  Raises OutputError."""
    require_some(path, splats)
    p = flipped(splats.parameters)
    attributes = _attributes(p)
    views: list[Any] = []
    accessors: list[Any] = []
    blocks, start = [], 0
    for name, table in attributes.items():
        kind = BYTE if table.dtype == np.uint8 else FLOAT
        accessor = {"bufferView": len(views), "componentType": kind, "count": len(table), "type": TYPES[table.shape[1]]}
        if kind == BYTE:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        views.append({"buffer": 0, "byteOffset": start, "byteLength": table.nbytes})
        accessors.append(accessor)
        blocks.append(table.tobytes())
        start += table.nbytes
    primitive = {
        "mode": POINTS,
        "attributes": {name: i for i, name in enumerate(attributes)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    asset: dict[str, Any] = {"version": "2.0", "generator": "clsplat"}
    if splats.rendering:
        asset["extras"] = {"clsplat": splats.rendering}
    tree = {
        "asset": asset,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(tree, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    with written(path) as file:
        file.write(struct.pack("<4s2I", MAGIC, 2, 12 + 8 + len(text) + 8 + start))
        file.write(struct.pack("<2I", len(text), JSON) + text + struct.pack("<2I", start, BINARY))
        for block in blocks:
            file.write(block)
    return file.sha256


def _attributes(p: Parameters) -> dict[str, NDArray[Any]]:
    """What is written, by name: tables [N, c] of float32 or uint8."""
    alpha = opacities(p["logit_opacity"])
    colour = np.clip(SH_C0 * p["sh_base"].astype(np.float64) + 0.5, 0, 1)
    linear = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)  # sRGB, IEC 61966-2-1
    with np.errstate(over="ignore"):
        scale = np.minimum(np.exp(p["log_scales"].astype(np.float64)), np.finfo(np.float32).max)
    tables: dict[str, NDArray[Any]] = {
        "POSITION": p["means"],
        f"{PREFIX}ROTATION": np.roll(unit(p["quats"]), -1, axis=1),
        f"{PREFIX}SCALE": scale,
        f"{PREFIX}OPACITY": alpha,
        f"{PREFIX}SH_DEGREE_0_COEF_0": p["sh_base"],
    }
    first = 0
    for degree in range(1, MAX_DEGREE + 1):
        for order in range(2 * degree + 1):
            if first < p["sh_rest"].shape[1]:
                tables[f"{PREFIX}SH_DEGREE_{degree}_COEF_{order}"] = p["sh_rest"][:, first : first + 3]
                first += 3
    written = {name: np.ascontiguousarray(table, "<f4") for name, table in tables.items()}
    written["COLOR_0"] = np.rint(255 * np.concatenate([linear, alpha], axis=1)).astype(np.uint8)
    return written


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk."""
    found: dict[int, bytes] = {}
    start = 12
    if data[:4] != MAGIC or len(data) < 20 or data[4:8] != b"\2\0\0\0":
        raise DataError(f"{path}: not a .glb file of glTF 2.0; copy or export it again")
    while start + 8 <= len(data):
        length, kind = struct.unpack_from("<2I", data, start)
        if length > len(data) - start - 8:
            raise DataError(f"{path}: holds {len(data)} bytes; its chunks are longer: copy or export it again")
        found.setdefault(kind, data[start + 8 : start + 8 + length])
        start += 8 + length
    text = found.get(JSON, b"")
    if not text:
        raise DataError(f"{path}: has no chunk of JSON; copy or export it again")
    if len(text) > MAX_JSON:
        raise DataError(
            f"{path}: its JSON has {len(text)} bytes; expected {MAX_JSON} at most: export it with fewer primitives"
        )
    return text, found.get(BINARY, b"")


def _parameters(path: Path, found: Gltf, primitive: dict[str, Any]) -> Parameters:
    """The Gaussians of one primitive, in the axes of glTF."""
    names = primitive["attributes"]

    def table(name: str, width: int) -> NDArray[np.float32]:
        if name not in names:
            raise DataError(f"{path}: its Gaussians have no attribute {name}; export the file again")
        return found.accessor(names[name], width)

    degree = max((d for d in range(MAX_DEGREE + 1) if f"{PREFIX}SH_DEGREE_{d}_COEF_0" in names), default=0)
    orders = [(d, m) for d in range(degree + 1) for m in range(2 * d + 1)]
    bands = [table(f"{PREFIX}SH_DEGREE_{d}_COEF_{m}", 3) for d, m in orders]
    means, scale = table("POSITION", 3), table(f"{PREFIX}SCALE", 3)
    parameters = {
        "means": means,
        "quats": np.roll(table(f"{PREFIX}ROTATION", 4), 1, axis=1),
        "log_scales": logs(np.abs(scale)),
        "logit_opacity": logits(table(f"{PREFIX}OPACITY", 1)),
        "sh_base": bands[0],
        "sh_rest": np.concatenate(bands[1:], axis=1) if degree else np.zeros((len(means), 0), np.float32),
    }
    if len({len(one) for one in parameters.values()}) > 1:
        raise DataError(f"{path}: the attributes of its Gaussians have different counts; export the file again")
    return parameters
