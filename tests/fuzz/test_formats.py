"""Damaged model files of every format are read or refused, quickly and with little memory."""

import base64
import io
import json
import struct
import warnings
import zipfile
import zlib
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from clsplat.formats.splats import ReadOptions
from clsplat.formats.streamed_sog import LeafLimits, write_lod
from clsplat.formats.table import CODECS, detect, model_bytes, read, write
from clsplat.gaussians.validate import examine
from tests.fuzz.mutation import damaged, fuzzed, one_of, rearranged_json
from tests.fuzz.outcome import outcome
from tests.support.models import interop, join_glb, ksplat, splats, split_glb, spz_tree, spz_version_4

RNG = np.random.default_rng(0)
WORDS = {
    "compressed PLY": ["element chunk 1\n", "element sh 5\n", "property uchar f_rest_0\n", "uint packed_scale\n"],
    "SPZ": ["NGSP", "\x1f\x8b"],
    "SOG": ["meta.json", "means_l.webp", "../x", '"files":["a"]', '"count":', "RIFF", "VP8L", "WEBP", '"codebook":[]'],
    "streamed SOG": ["lodLevels", "filenames", "0_0/meta.json", '"lods":{}', '"children":[]', '"count":', "../", "-1"],
    "GLB": [
        "glTF",
        "JSON",
        '"byteStride":',
        '"sparse":{}',
        '"count":',
        '"matrix":[]',
        '"children":[0]',
        "5121",
        '"uri":""',
    ],
}
KINDS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
NAMES = {"compressed PLY": "a.compressed.ply", "SPZ": "a.spz", "SOG": "a.sog", "GLB": "a.glb", "splat": "a.splat"}
NAMES |= {"glTF": "a.gltf", "OpenUSD": "a.usda"}
AXES = struct.pack("<2I4s2II", 7, 4, b"abcd", 0xADBE0003, 4, 12)  # records of an SPZ file


def seeds(name: str, folder: Path) -> list[bytes]:
    """Small files of a format."""
    if name == "ksplat":
        return [ksplat(degree=degree, level=level) for degree in range(3) for level in range(1, 3)]
    if name == "compressed PLY":
        return [interop("train1000.compressed.ply").read_bytes()]
    if name == "glTF":
        return [as_gltf(data) for data in seeds("GLB", folder)]
    results = []
    for count, degree, mode in ((3, 0, "mip"), (40, 1, "default"), (5, 3, "mip")):
        write(folder / NAMES[name], splats(RNG, count, degree, mode))
        results.append((folder / NAMES[name]).read_bytes())
        if name == "SPZ":
            results += [spz_version_4(results[-1])] * bool(find_spec("zstandard"))
            plain = zlib.decompress(results[0], 31)
            results.append(plain[:14] + bytes([plain[14] | 2]) + plain[15:] + AXES)
        if name == "GLB":
            spz = (seeds("SPZ", folder))[-1]
            results.append(join_glb(spz_tree(spz, np.ones((2, 3))), spz))
    return results


def as_gltf(data: bytes) -> bytes:
    """A .glb file as .gltf, with a data URI."""
    tree, binary = split_glb(data)
    tree["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(binary).decode()
    return json.dumps(tree).encode()


def reads_or_refuses(path: Path) -> None:
    """Also what a reader tells of numbers that are not finite."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = outcome(read, path)
        outcome(detect, path)
        outcome(examine, path)
        kept = outcome(read, path, ReadOptions(not_finite="keep"))
    if model is not None:
        assert kept is not None
        assert all(np.isfinite(table).all() for table in model.parameters.values())
        widths = {len(table) for table in model.parameters.values()}
        assert len(widths) == 1


def test_every_reader_is_fuzzed():
    own = {"PLY", "streamed SOG"}  # in test_ply.py, and below
    assert {codec.name for codec in CODECS if codec.read} == own | NAMES.keys() | {"ksplat"}


@pytest.mark.parametrize("name", [*NAMES, "ksplat"])
def test_damaged_model_is_read_or_refused(name, folder: Path):
    path = folder / NAMES.get(name, "a.ksplat")

    @fuzzed(30, data=damaged(seeds(name, folder), WORDS.get(name, ())))
    def reads(data):
        path.write_bytes(data)
        reads_or_refuses(path)

    reads()


def test_damaged_content_of_an_spz_is_read_or_refused(folder: Path):
    """The damage lies inside of the compression."""
    plain = [zlib.decompress(data, 31) for data in seeds("SPZ", folder) if data[:2] == b"\x1f\x8b"]

    @fuzzed(30, data=damaged(plain, WORDS["SPZ"]))
    def reads(data):
        (folder / "b.spz").write_bytes(zlib.compress(data, 1, wbits=31))
        reads_or_refuses(folder / "b.spz")

    reads()


def test_damaged_sog_member_is_read_or_refused(folder: Path):
    """The ZIP is whole; its meta.json or an image is not."""
    with zipfile.ZipFile(io.BytesIO(seeds("SOG", folder)[1])) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}

    @fuzzed(40, data=damaged([members["meta.json"], *members.values()], WORDS["SOG"]))
    def reads(data):
        like = next((name for name, held in members.items() if held[:4] == data[:4]), "meta.json")
        with zipfile.ZipFile(folder / "b.sog", "w") as archive:
            for name, held in members.items():
                archive.writestr(name, data if name == like else held)
        reads_or_refuses(folder / "b.sog")

    reads()


def test_damaged_tree_of_levels_is_read_or_refused(folder: Path):
    """The parts are whole; their lod-meta.json is not, or is another tree."""
    levels = [splats(RNG, count, 1) for count in (60, 20)]
    write_lod(folder / "levels", levels, limits=LeafLimits(40, 2.0, 10))
    path = folder / "levels" / "lod-meta.json"
    whole = path.read_bytes()

    @fuzzed(60, data=damaged([whole], WORDS["streamed SOG"]), other=rearranged_json([json.loads(whole)]))
    def reads(data, other):
        path.write_bytes(data)
        reads_or_refuses(path)
        path.write_bytes(other)
        reads_or_refuses(path)
        outcome(model_bytes, path)

    reads()


def test_glb_of_another_shape_is_read_or_refused(folder: Path):
    """Its JSON is whole, but no glTF."""
    tree, binary = split_glb(seeds("GLB", folder)[0])
    spz = seeds("SPZ", folder)[-1]
    doubled = {**tree, "nodes": [*({"children": [i + 1] * 2} for i in range(50)), {}]}

    @fuzzed(300, data=rearranged_json([tree, tree, tree, doubled]))
    def reads(data):
        (folder / "b.glb").write_bytes(join_glb(json.loads(data), binary))
        reads_or_refuses(folder / "b.glb")

    @fuzzed(100, data=rearranged_json([spz_tree(spz, np.ones((2, 3)))]))
    def unpacks(data):
        (folder / "b.glb").write_bytes(join_glb(json.loads(data), spz))
        reads_or_refuses(folder / "b.glb")
        (folder / "b.gltf").write_bytes(as_gltf(join_glb(json.loads(data), spz)) if b'"buffers": [{' in data else data)
        reads_or_refuses(folder / "b.gltf")

    reads()
    unpacks()


def test_sog_of_another_shape_is_read_or_refused(folder: Path):
    """Its meta.json is whole, but no SOG; its ZIP, of any kind, may have a damaged byte, and may unpack to much."""
    with zipfile.ZipFile(io.BytesIO(seeds("SOG", folder)[1])) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(members.pop("meta.json"))
    bomb = {**meta, **{name: {**meta[name], "files": ["large"] * 2} for name in ("means", "scales", "quats", "sh0")}}
    for kind in KINDS:
        with zipfile.ZipFile(folder / f"{kind}.sog", "w", kind) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
            if kind == zipfile.ZIP_DEFLATED:
                archive.writestr("large", bytes(160_000_000))

    @fuzzed(60, data=rearranged_json([meta, meta, bomb]), kind=one_of(KINDS), place=lambda random: 2 * random.random())
    def reads(data, kind, place):
        packed = io.BytesIO((folder / f"{kind}.sog").read_bytes())
        with zipfile.ZipFile(packed, "a", kind) as archive:
            archive.writestr("meta.json", data)
        result = bytearray(packed.getvalue())
        if place < 1:
            result[int(place * len(result))] ^= 1 << 4
        (folder / "b.sog").write_bytes(result)
        reads_or_refuses(folder / "b.sog")

    reads()
