"""Read and write OpenUSD as text: `.usda` files, and `.usdz`, uncompressed ZIPs that start with a `.usda`.

A model is a prim ParticleField3DGaussianSplat (UsdVol 26.03 and later) in a stage with y up, z back, and 1 unit as 1 m.
A mesh for collisions is a guide, which is not rendered, with the schema PhysicsCollisionAPI.
"""

import io
import logging
import re
import struct
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, one_line, quote
from clsplat.core.quaternions import rotation_matrix
from clsplat.core.reading import read_file
from clsplat.formats.packing import EPOCH, HashedFile, open_hashed, write_bytes
from clsplat.formats.splats import (
    FLIP,
    MAX_DEGREE,
    MAX_FILE,
    Parameters,
    SplatFile,
    WriteOptions,
    columns_to_sh_degree,
    flip_axes,
    join_parts,
    normalize_quats,
    opacities,
    opacities_to_logits,
    require_gaussians,
    scales_to_logs,
    sh_coefficients,
    warn_dropped,
)

LOG = logging.getLogger("clsplat")

# Writing.

BLOCK = 4096  # rows formatted at once
EXTENT = 3.0  # half the side of a splat's box, in standard deviations
LAYER = "scene.usda"  # file name in a .usdz
PADDING = struct.pack("<2H20x", 0x1986, 20)  # aligns the data of LAYER to 64 bytes, as .usdz requires
MAX_LAYER = 0x7FFFFFFF  # bytes; other programs do not read a ZIP64
STAGE = """#usda 1.0
(
    defaultPrim = "Scene"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Scene"
{
"""
GAUSSIANS = """    def ParticleField3DGaussianSplat "Gaussians"
    {
        uniform token projectionModeHint = "perspective"
        uniform token sortingModeHint = "zDepth"
"""
COLLIDER = """    def Mesh "Collider" (
        prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]
    )
    {
        uniform token physics:approximation = "none"
        uniform token purpose = "guide"
        uniform token subdivisionScheme = "none"
"""


def write_usd(path: Path, splats: SplatFile, options: WriteOptions) -> str:
    """Write a `.usda` or `.usdz` file; return its SHA-256.  Raises DataError, OutputError."""
    require_gaussians(path, splats)
    if path.suffix.lower() != ".usdz":
        with open_hashed(path) as file:
            _write_stage(file, splats, options)
        return file.sha256
    layer, package = io.BytesIO(), io.BytesIO()
    _write_stage(layer, splats, options)
    if layer.tell() > MAX_LAYER:
        raise DataError(f"{path}: has {layer.tell():,} bytes of text; use --splats N, --sh-degree 0, or a .usda file")
    member = zipfile.ZipInfo(LAYER, EPOCH)
    member.create_system, member.extra = 3, PADDING
    with zipfile.ZipFile(package, "w") as archive:
        archive.writestr(member, layer.getbuffer())
    return write_bytes(path, package.getvalue())


def _write_stage(file: HashedFile | io.BytesIO, splats: SplatFile, options: WriteOptions) -> None:
    """Write a text layer."""
    p, origin = flip_axes(splats.parameters), np.array(splats.rendering.get("origin", [0.0, 0.0, 0.0]))
    scales = np.exp(np.clip(p["log_scales"].astype(np.float64), -80, 80))
    half_sides = EXTENT * scales.max(axis=1, keepdims=True)
    extent = np.stack([(p["means"] - half_sides).min(axis=0), (p["means"] + half_sides).max(axis=0)])
    tables = {
        "float3[] extent": extent,
        "point3f[] positions": p["means"],
        "quatf[] orientations": normalize_quats(p["quats"]),
        "float3[] scales": scales,
        "float[] opacities": opacities(p["logit_opacity"]),
        "float3[] radiance:sphericalHarmonicsCoefficients": np.hstack([p["sh_base"], p["sh_rest"]]).reshape(-1, 3),
    }
    file.write(STAGE.encode())
    if origin.any():
        file.write(f"    double3 xformOp:translate = {tuple((origin * FLIP).tolist())}\n".encode())
        file.write(b'    uniform token[] xformOpOrder = ["xformOp:translate"]\n\n')
    file.write(f"{GAUSSIANS}        uniform int radiance:sphericalHarmonicsDegree = {splats.sh_degree}\n".encode())
    for name, table in tables.items():
        _write_array(file, name, table.astype(np.float32))
    if options.collider:
        vertices, faces = options.collider
        points = ((vertices - origin) * FLIP).astype(np.float32)
        file.write(f"    }}\n\n{COLLIDER}".encode())
        _write_array(file, "float3[] extent", np.stack([points.min(axis=0), points.max(axis=0)]))
        _write_array(file, "int[] faceVertexCounts", np.full((len(faces), 1), 3))
        _write_array(file, "int[] faceVertexIndices", faces.reshape(-1, 1))
        _write_array(file, "point3f[] points", points)
    file.write(b"    }\n}\n")


def _write_array(file: HashedFile | io.BytesIO, name: str, table: NDArray[Any]) -> None:
    """Write one attribute with the full precision of float32."""
    width = table.shape[1]
    row = ", ".join(["%.9g"] * width) if width == 1 else f"({', '.join(['%.9g'] * width)})"
    file.write(f"        {name} = [".encode())
    for start in range(0, len(table), BLOCK):
        block = table[start : start + BLOCK]
        text = ", ".join([row] * len(block)) % tuple(block.ravel().tolist())
        file.write((", " if start else "").encode() + text.encode())
    file.write(b"]\n")


# Reading.

SPLAT = b"ParticleField3DGaussianSplat"
STRING = rb'"""(?:[^\\]|\\.)*?"""|"(?:[^"\\\n]|\\.)*"'
TOKEN = re.compile(
    rb"#[^\n]*|(?P<def>\bdef)\s+(?:(?P<type>\w+)\s+)?\"[^\"\n]*\"|"
    rb"(?P<key>[\w:.]+)\s*=\s*(?P<value>\[[^\]\[=]*\]|\((?:[^()=]|\([^()=]*\))*\)|" + STRING + rb"|[-+.\w]+)|"
    rb"" + STRING + rb"|[(){}]",
    re.DOTALL,
)
NO_PUNCTUATION = bytes.maketrans(b"()[],", b"     ")
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # converts z up to y up
Prim = dict[bytes, bytes]  # the attributes of a prim, and its type as b"def"


def looks_like_usd(data: bytes) -> bool:
    """Return whether the first bytes are those of an OpenUSD file, or of a ZIP with one as its first file."""
    name = data[30 : 30 + int.from_bytes(data[26:28], "little")].lower()
    is_package = data.startswith(b"PK\3\4") and name.endswith((b".usda", b".usdc", b".usd"))
    return is_package or data.startswith((b"#usda", b"PXR-USDC"))


def read_usd(path: Path) -> SplatFile:
    """Read the Gaussians of a `.usda` or `.usdz` file.  Raises DataError if it is damaged, binary, or without them."""
    notes: set[str] = set()
    try:
        stage, prims = _parse(_read_layer(path))
        unit = float(stage.get(b"metersPerUnit", b"1"))
        axes = np.diag([unit, unit, unit, 1.0]) @ (Z_UP if stage.get(b"upAxis") == b'"Z"' else np.eye(4))
        parts = [(_read_parameters(path, prim, notes), axes @ _matrix(path, parents)) for prim, parents in prims]
    except (ValueError, LookupError, RuntimeError, DeprecationWarning, zipfile.BadZipFile) as error:
        raise DataError(
            f"{path}: is damaged, or has values of unsupported types ({one_line(error)}); copy or export it again"
        ) from error
    if not parts:
        raise DataError(f"{path}: has no prim {SPLAT.decode()}, which OpenUSD 26.03 defines; export it again")
    for note in sorted(notes):
        LOG.warning("%s: %s", path, note)
    parameters, placement = join_parts(path, parts)
    return SplatFile(parameters, placement=placement)


def _read_layer(path: Path) -> bytes:
    """Return the text of a layer; in a package, it is the first file."""
    data = read_file(path, "a .usda or .usdz file", limit=MAX_FILE)
    if data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            first = archive.infolist()[0]
            if first.compress_type != zipfile.ZIP_STORED:
                raise DataError(f"{path}: {quote(first.filename)} is compressed, not stored; export it again")
            data = archive.read(first)
    if not data.startswith(b"#usda"):
        kind = "a binary OpenUSD file" if data.startswith(b"PXR-USDC") else "not an OpenUSD text file"
        raise DataError(f"{path}: {kind}; expected '#usda' at its start: convert it with `usdcat IN --out OUT.usda`")
    return data


def _parse(text: bytes) -> tuple[Prim, list[tuple[Prim, Sequence[Prim]]]]:
    """Return the metadata of a stage, and each prim with Gaussians, with its parents and itself, in order."""
    stack: list[Prim] = [{}]
    prims: list[tuple[Prim, Sequence[Prim]]] = []
    following: Prim = {}
    depth = 0  # number of open parentheses, which enclose metadata
    for match in TOKEN.finditer(text):
        token = match[0]
        if match["def"]:
            following = {b"def": match["type"] or b""}
        elif match["key"] and (not depth or len(stack) == 1):
            stack[-1].setdefault(match["key"], match["value"])
        elif token in (b"(", b")"):
            depth += 1 if token == b"(" else -1
        elif token == b"{" and not depth:
            stack.append(following)
            following = {}
        elif token == b"}" and not depth and len(stack) > 1:
            if stack[-1].get(b"def") == SPLAT:
                prims.append((stack[-1], stack[1:]))
            stack.pop()
    if len(stack) != 1:
        raise ValueError("a brace is not closed")
    return stack[0], prims


def _read_parameters(path: Path, prim: Prim, notes: set[str]) -> Parameters:
    """Return the Gaussians of a prim in the axes of a PLY."""

    def table(name: str, width: int) -> NDArray[np.float32]:
        value = prim.get(name.encode(), prim.get(f"{name}h".encode()))  # names of 16-bit floats end in h
        if value is None:
            raise DataError(f"{path}: its Gaussians have no {name}; export the file again, without time samples")
        return _numbers(value).reshape(-1, width).astype(np.float32)

    means = table("positions", 3)
    harmonics = table("radiance:sphericalHarmonicsCoefficients", 3).reshape(len(means), -1)
    degree = columns_to_sh_degree(harmonics.shape[1] - 3)
    warn_dropped(path, degree)
    parameters = {
        "means": means,
        "quats": table("orientations", 4),
        "log_scales": scales_to_logs(table("scales", 3), notes),
        "logit_opacity": opacities_to_logits(table("opacities", 1), notes),
        "sh_base": harmonics[:, :3],
        "sh_rest": harmonics[:, 3 : 3 * sh_coefficients(MAX_DEGREE)],
    }
    if len(set(map(len, parameters.values()))) > 1 or harmonics.shape[1] != 3 * sh_coefficients(degree):
        raise DataError(f"{path}: the attributes of its Gaussians have different counts; export it again")
    return flip_axes(parameters)


def _numbers(value: bytes) -> NDArray[np.float64]:
    """Return the numbers of a value.  Raises DeprecationWarning, like NumPy, for other text."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        return np.fromstring(value.translate(NO_PUNCTUATION).decode("ascii"), sep=" ")


def _matrix(path: Path, parents: Sequence[Prim]) -> NDArray[np.float64]:
    """Return the matrix, [4, 4], from the coordinates of the last prim to those of the stage."""
    from scipy.spatial.transform import Rotation

    result = np.eye(4)
    for prim in parents:
        for order in re.findall(rb'"([^"]*)"', prim.get(b"xformOpOrder", b"")):
            name, matrix = order.removeprefix(b"!invert!"), np.eye(4)
            kind, values = name.split(b":")[1].decode(), _numbers(prim[name])
            if kind == "transform":
                matrix = values.reshape(4, 4).T
            elif kind == "translate":
                matrix[:3, 3] = values
            elif kind == "scale":
                matrix[:3, :3] *= values
            elif kind == "orient":
                matrix[:3, :3] = rotation_matrix(*(values / np.linalg.norm(values)))
            elif kind.startswith("rotate"):
                matrix[:3, :3] = Rotation.from_euler(kind[6:].lower(), values, degrees=True).as_matrix()
            else:
                raise DataError(
                    f"{path}: the transform {quote(name.decode())} is not supported; apply (bake) the transforms in "
                    "the program that exported the file, and export it again"
                )
            result = result @ (np.linalg.inv(matrix) if order != name else matrix)
    return result
