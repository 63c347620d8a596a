"""Models for format tests, and files of other programs."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.conformance.scenes import Case
from clsplat.formats.splat import HEADER, SECTION
from clsplat.formats.splats import PARAMETERS, ReadOptions, SplatFile, WriteOptions, normalize_quats, opacities
from clsplat.formats.table import read, write
from clsplat.gaussians.model import Model, Rendering
from tests.support.data_sets import data_set


def interop(name: str) -> Path:
    """A file that another program wrote, or skip the test where it is missing."""
    path = data_set("splats") / "interop" / name
    if not path.exists():
        pytest.skip(f"no file {path}")
    return path


def spz_version_4(data: bytes) -> bytes:
    """Return an SPZ file of version 3 as one of version 4: a Zstandard frame per plane, after a table of sizes."""
    import zstandard

    plain = zlib.decompress(data, 31)
    (count,), degree = struct.unpack_from("<I", plain, 8), plain[12]
    sizes = [count * width for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if width]
    planes = [plain[end - size : end] for end, size in zip(16 + np.cumsum(sizes), sizes, strict=True)]
    frames = [zstandard.ZstdCompressor(12).compress(plane) for plane in planes]
    table = b"".join(struct.pack("<2Q", len(f), len(p)) for f, p in zip(frames, planes, strict=True))
    header = plain[:4] + struct.pack("<I", 4) + plain[8:15] + struct.pack("<BI12x", len(planes), 32)
    return header + table + b"".join(frames)


def splats(rng: np.random.Generator, count: int = 600, degree: int = 3, mode: str = "default") -> SplatFile:
    """Gaussians with values as trained ones have."""
    tables = {
        "means": rng.normal(0, 2, (count, 3)),
        "quats": rng.normal(0, 1, (count, 4)),
        "log_scales": rng.uniform(-8, 1, (count, 3)),
        "logit_opacity": rng.normal(0, 3, (count, 1)),
        "sh_base": rng.normal(0, 0.8, (count, 3)).clip(-3, 3),
        "sh_rest": rng.normal(0, 0.1, (count, 3 * ((degree + 1) ** 2 - 1))),
    }
    numbers = {"near": 0.05, "screen_variance": 0.1, "compensate": 1.0} if mode == "mip" else {}
    return SplatFile({name: table.astype(np.float32) for name, table in tables.items()}, numbers, mode)


def round_trip(
    path: Path, source: SplatFile, options: WriteOptions | None = None, reading: ReadOptions | None = None
) -> SplatFile:
    """Write a model and read it."""
    write(path, source, options)
    return read(path, reading)


def angles(a: SplatFile, b: SplatFile) -> np.ndarray:
    """The angles between the rotations of two models, [N] degrees."""
    cosine = np.abs((normalize_quats(a.parameters["quats"]) * normalize_quats(b.parameters["quats"])).sum(axis=1))
    return np.degrees(2 * np.arccos(np.minimum(cosine, 1)))


def assert_close(actual: SplatFile, expected: SplatFile, turned: float, **bounds: float) -> None:
    """Compare two models table by table: rotations in degrees, opacities in [0, 1], others in their own units."""
    a, b = actual.parameters, expected.parameters
    assert list(a) == list(PARAMETERS)
    assert angles(actual, expected).max() <= turned
    for name, bound in bounds.items():
        if name == "opacity":
            difference = np.abs(opacities(a["logit_opacity"]) - opacities(b["logit_opacity"]))
        else:
            assert a[name].shape == b[name].shape, name
            assert a[name].dtype == np.float32
            difference = np.abs(a[name].astype(np.float64) - b[name])
        assert difference.max(initial=0) <= bound, f"{name}: {difference.max()} > {bound}"


def split_glb(data):
    """The JSON and the binary chunk of a .glb file, whose lengths are checked."""
    magic, version, length = struct.unpack_from("<4s2I", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<2I", data, 12)
    assert kind == 0x4E4F534A
    assert size % 4 == 0
    rest, kind = struct.unpack_from("<2I", data, 20 + size)
    assert kind == 0x004E4942
    assert 28 + size + rest == len(data)
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def join_glb(tree, binary):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + len(binary))
    return head + struct.pack("<2I", len(text), 0x4E4F534A) + text + struct.pack("<2I", len(binary), 0x4E4942) + binary


def spz_tree(data, bounds=None, name="KHR_gaussian_splatting_compression_spz_2"):
    """The JSON of a .glb with an SPZ file inside, as the draft of the extension says."""
    position = {"componentType": 5126, "count": 1, "type": "VEC3"}
    if bounds is not None:
        position |= {"min": bounds.min(axis=0).tolist(), "max": bounds.max(axis=0).tolist()}
    extensions = {"KHR_gaussian_splatting": {"extensions": {name: {"bufferView": 0}}}}
    primitive = {"mode": 0, "attributes": {"POSITION": 0}, "extensions": extensions}
    tree = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
    size = {"byteLength": len(data)}
    return {**tree, "accessors": [position], "buffers": [size], "bufferViews": [{"buffer": 0, **size}]}


def as_text(data):
    """A binary PLY of floats as ascii."""
    head, _, body = data.partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(-1, head.count(b"property float"))
    lines = "\n".join(" ".join(repr(float(value)) for value in row) for row in table)
    return head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode() + b"\n"


def ksplat(count=3, rows=3, degree=1, level=1, buckets=1, full=0, partial=1, held=3, sections=1, most=1):
    header, section = bytearray(HEADER), bytearray(SECTION)
    struct.pack_into("<BB2x4IH", header, 0, 0, 1, most, sections, rows, count, level)
    struct.pack_into("<4IfHxx4IH", section, 0, count, rows, 256, buckets, 5.0, 12, 32767, 0, full, partial, degree)
    row = (24, 42, 72)[degree] if degree < 3 else 72
    return bytes(header + section) + struct.pack("<I3f", held, 1, 2, 3) + bytes(row * rows)


def equal(one: clsplat.Model, other: clsplat.Model) -> bool:
    tables = one.tables()
    return tables.keys() == other.tables().keys() and all(
        np.array_equal(table, other.tables()[name]) for name, table in tables.items()
    )


WIDTHS = {0: 0, 1: 9, 2: 24, 3: 45}  # of sh_rest, by degree


def model_of(case: Case, degree: int = 3) -> Model:
    tables = {**case.parameters, "sh_rest": case.parameters["sh_rest"][:, : WIDTHS[degree]]}
    return Model(**tables, rendering=Rendering(screen_variance=case.variance, compensate=case.compensate))
