"""The splat PLY: exact round trips, tolerant reading, and one-sentence refusals."""

import tracemalloc

import numpy as np
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.core.errors import DataError, OutputError
from clsplat.formats import ply
from clsplat.formats.ply import write_ply
from clsplat.formats.splats import PARAMETERS
from clsplat.formats.table import read as read_ply
from clsplat.gaussians.model import Rendering, load
from tests.support.data_sets import data_set


def parameters(rng, count=20, degree=3):
    p = {name: random_case(rng, count).parameters[name] for name in PARAMETERS}
    p["sh_rest"] = p["sh_rest"][:, : 3 * ((degree + 1) ** 2 - 1)]
    return p


def payload(data: bytes) -> bytes:
    return data.split(b"end_header\n", 1)[1]


@pytest.mark.parametrize(("count", "degree"), [(0, 3), (1, 0), (20, 1), (1, 2), (20, 3)])
def test_round_trip(tmp_path, rng, degree, count):
    path = tmp_path / "a" / "model.ply"
    written = parameters(rng, count, degree)
    write_ply(path, written, {"near": 0.2, "background": "white"})
    file = read_ply(path)
    assert file.rendering == {"near": 0.2, "background": "white"}
    for name in PARAMETERS:
        np.testing.assert_array_equal(file.parameters[name], written[name])


def test_layout_matches_the_reference(tmp_path, rng):
    """Property by property, as other programs read it."""
    path, p = tmp_path / "model.ply", parameters(rng, 3)
    write_ply(path, p, {})
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    values = np.frombuffer(body, "<f4").reshape(3, 62)
    np.testing.assert_array_equal(values[:, 3:6], 0)
    by_channel = p["sh_rest"].reshape(3, 15, 3)
    np.testing.assert_array_equal(values[:, 9:24], by_channel[:, :, 0])  # all red, then green, then blue
    np.testing.assert_array_equal(values[:, 39:54], by_channel[:, :, 2])
    np.testing.assert_array_equal(values[:, 58:], p["quats"])


def test_reference_file_survives_unchanged(tmp_path):
    path = data_set("splats") / "train-1000.ply"
    file = read_ply(path)
    assert len(file.parameters["means"]) == 1000
    assert file.parameters["sh_rest"].shape == (1000, 45)
    write_ply(tmp_path / "copy.ply", file.parameters, {})
    assert payload((tmp_path / "copy.ply").read_bytes()) == payload(path.read_bytes())


def test_reads_any_order_and_types(tmp_path, rng):
    """Another program's dialect: double, big endian, CRLF, no normals, no f_rest, extra properties and elements."""
    p = parameters(rng, 5, degree=0)
    columns = {"rot": p["quats"], "scale": p["log_scales"], "f_dc": p["sh_base"]}
    names = [f"{name}_{i}" for name, table in columns.items() for i in range(table.shape[1])]
    dtype = np.dtype(
        [("confidence", ">u1"), *((n, ">f8") for n in names), ("opacity", ">f4"), *((n, ">f4") for n in "zyx")]
    )
    table = np.zeros(5, dtype)
    for name, values in columns.items():
        for i in range(values.shape[1]):
            table[f"{name}_{i}"] = values[:, i]
    table["opacity"] = p["logit_opacity"][:, 0]
    for i, axis in enumerate("xyz"):
        table[axis] = p["means"][:, i]
    kinds = {">u1": "uchar", "|u1": "uchar", ">f8": "double", ">f4": "float"}
    lines = ["ply", "format binary_big_endian 1.0", "comment other", "element vertex 5"]
    lines += [f"property {kinds[dtype.fields[n][0].str]} {n}" for n in dtype.names]
    lines += ["element camera 1", "property float focal", "end_header"]
    path = tmp_path / "other.ply"
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode() + table.tobytes() + b"\0\0\0\0")
    file = read_ply(path)
    for name in PARAMETERS:
        np.testing.assert_array_equal(file.parameters[name], p[name])


def test_other_elements_around_the_vertices_are_skipped(tmp_path, rng):
    p, path = parameters(rng, 4, degree=1), tmp_path / "model.ply"
    write_ply(path, p, {"near": 0.2})
    header, body = path.read_bytes().split(b"end_header\n", 1)
    before, vertex = header.split(b"element vertex")
    before += b"element camera 3\nproperty double focal\nproperty short kind\n"
    after = b"element face 1\nproperty list uchar int vertices\nend_header\n"
    faces = b"\x01\0\0\0\0"
    path.write_bytes(before + b"element vertex" + vertex + after + b"\7" * 30 + body + faces)
    file = read_ply(path)
    assert file.rendering == {"near": 0.2}
    for name in PARAMETERS:
        np.testing.assert_array_equal(file.parameters[name], p[name])


def test_refusals(tmp_path, rng):
    good = tmp_path / "good.ply"
    write_ply(good, parameters(rng), {})
    data = good.read_bytes()

    def commented(text):
        return data.replace(b"comment clsplat {}", b"comment clsplat " + text)

    broken = {
        "truncated": (data[:-10], "truncated"),
        "header only": (data[:200], "not a PLY"),
        "empty": (b"", "the file is empty; copy"),
        "text": (b"hello", "not a PLY"),
        "huge count": (data.replace(b"element vertex 20", b"element vertex 99999999999999"), "truncated"),
        "ascii": (data.replace(b"binary_little_endian", b"ascii"), "expected one number for each property"),
        "points only": (data.replace(b"property float opacity", b"property float intensity"), "not a splat"),
        "odd f_rest": (data.replace(b"property float f_rest_44", b"property float extra"), "44 f_rest"),
        "no vertices": (data.replace(b"element vertex", b"element point"), "no vertices"),
        "lists": (data.replace(b"property float nx", b"property list uchar int nx"), "cannot read"),
        "twice": (data.replace(b"property float nx", b"property float ny"), "twice"),
        "f_rest from 1 on": (data.replace(b"f_rest_0\n", b"f_rest_45\n"), "45 f_rest.*numbered from 0"),
        "count of many digits": (data.replace(b"vertex 20", b"vertex " + b"9" * 5000), "line 5: cannot read"),
        "no count": (data.replace(b"element vertex 20", b"element vertex"), "line 5: cannot read"),
        "nothing after element": (data.replace(b"element vertex 20", b"element"), "line 5: cannot read"),
        "near of 400 digits": (commented(b'{"near": ' + b"9" * 400 + b"}"), "near = a number of 1329 bits; expected"),
        "near below 0": (commented(b'{"near": -1}'), "near = -1; expected"),
        "near that is no number": (commented(b'{"near": NaN}'), "near = nan; expected"),
        "near that is text": (commented(b'{"near": "x"}'), "near = 'x'; expected"),
        "variance that is endless": (commented(b'{"screen_variance": 1e999}'), "screen_variance = inf; expected"),
    }
    nan = bytearray(data)
    nan[data.index(b"end_header\n") + 11 : data.index(b"end_header\n") + 15] = np.float32(np.nan).tobytes()
    broken["NaN"] = (bytes(nan), "not finite")
    for name, (content, words) in broken.items():
        path = tmp_path / "bad.ply"
        path.write_bytes(content)
        with pytest.raises(DataError, match=words) as error:
            read_ply(path)
        assert str(path) in str(error.value), name
        assert "\n" not in str(error.value)
    with pytest.raises(DataError, match="cannot be read"):
        read_ply(tmp_path / "missing.ply")


@pytest.mark.parametrize("text", [b"[" * 50_000, b'{"background": ["x"]}', b'{"near": null}', b"[1]", b"was here"])
def test_comment_unrelated_to_rendering_is_ignored(text, tmp_path, rng):
    path = tmp_path / "model.ply"
    write_ply(path, parameters(rng), {})
    path.write_bytes(path.read_bytes().replace(b"comment clsplat {}", b"comment clsplat " + text))
    assert load(path).rendering.near == Rendering().near
    assert load(path).rendering.background is None


def test_filter_whose_square_overflows_is_refused_silently(tmp_path, rng, recwarn):
    write_ply(tmp_path / "a.ply", parameters(rng) | {"filter_variance": np.ones((20, 1), np.float32)}, {})
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:-4] + np.float32(1e30).tobytes())
    with pytest.raises(DataError, match="filter_variance have values that are not finite"):
        read_ply(tmp_path / "a.ply")
    assert not recwarn.list


def test_doubles_beyond_floats_are_refused_without_a_warning(tmp_path, recwarn):
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 1", *(f"property double {n}" for n in names)]
    path = tmp_path / "model.ply"
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + np.full(len(names), 1e300).tobytes())
    with pytest.raises(DataError, match="not finite"):
        read_ply(path)
    assert not recwarn.list


def test_writing_is_all_or_nothing(tmp_path, rng):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        write_ply(tmp_path / "file" / "model.ply", parameters(rng), {})
    assert (tmp_path / "file").read_text() == "in the way"
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def make_model(count: int, degree: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(count)
    widths = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3}
    widths |= {"sh_rest": 3 * ((degree + 1) ** 2 - 1), "filter_variance": 1, "motion": 5}
    return {name: rng.random((count, width), dtype=np.float32) for name, width in widths.items()}


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 33])
def test_rows_are_written_and_read_in_blocks(count, tmp_path, monkeypatch):
    """The same bytes, and the same tables."""
    model = make_model(count)
    whole = ply.write_ply(tmp_path / "whole.ply", model, {})
    monkeypatch.setattr(ply, "ROWS", 16)
    assert ply.write_ply(tmp_path / "parts.ply", model, {}) == whole
    in_parts = ply.read_ply(tmp_path / "parts.ply").parameters
    monkeypatch.undo()
    for name, table in ply.read_ply(tmp_path / "whole.ply").parameters.items():
        np.testing.assert_array_equal(in_parts[name], table)
        assert in_parts[name].dtype == table.dtype


def test_model_is_in_memory_once(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "ROWS", 1000)
    model = make_model(40_000, degree=1)
    size = sum(table.nbytes for table in model.values())
    tracemalloc.start()
    try:
        ply.write_ply(tmp_path / "model.ply", model, {})
        assert tracemalloc.get_traced_memory()[1] < 0.2 * size
        tracemalloc.reset_peak()
        ply.read_ply(tmp_path / "model.ply")
        assert tracemalloc.get_traced_memory()[1] < 1.3 * size
    finally:
        tracemalloc.stop()
