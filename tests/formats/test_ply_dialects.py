"""PLY files of other programs: mip marks, discs, and compressed splats."""

import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.core.errors import DataError
from clsplat.formats.ply import write_ply
from clsplat.formats.splats import FLAT_LOG_SCALE, FLATNESS
from clsplat.formats.table import detect, read, write
from tests.support.models import as_text, interop, round_trip, splats

MARKS = {
    "comment SplatRenderMode: mip": "mip",
    "comment splatrendermode:MIP": "mip",
    "comment postshot.anti_aliasing=1": "mip",
    "comment postshot.anti_aliasing=0": "default",
    "comment SplatRenderMode: default": "default",
    "comment made of mip maps": "default",
}


def packed():
    """Return header and body of a compressed PLY with 1,000 splats of SH degree 3, in 4 chunks."""
    return interop("train1000.compressed.ply").read_bytes().split(b"end_header\n", 1)


@pytest.mark.parametrize("mark", MARKS)
def test_every_spelling_of_the_mip_mark_is_read(mark, tmp_path, rng):
    path = tmp_path / "a.ply"
    write_ply(path, splats(rng, 3).parameters, {})
    path.write_bytes(path.read_bytes().replace(b"comment SplatRenderMode: default", mark.encode()))
    assert read(path).mode == MARKS[mark]


@pytest.mark.parametrize(("unit", "third"), [(0, FLAT_LOG_SCALE), (-10, -16 + FLATNESS)])
def test_disc_gets_a_tiny_third_axis(tmp_path, rng, unit, third):
    path, source = tmp_path / "a.ply", splats(rng, 5).parameters
    source["log_scales"] = np.maximum(source["log_scales"], -6) + np.float32(unit)
    source["log_scales"][:, 0] = np.float32(unit - 6)
    write_ply(path, source, {})
    header, body = path.read_bytes().split(b"end_header\n", 1)
    rows = np.delete(np.frombuffer(body, "<f4").reshape(5, -1), 57, axis=1)
    path.write_bytes(header.replace(b"property float scale_2\n", b"") + b"end_header\n" + rows.tobytes())
    actual = read(path).parameters
    np.testing.assert_array_equal(actual["log_scales"][:, :2], source["log_scales"][:, :2])
    np.testing.assert_allclose(actual["log_scales"][:, 2], third, rtol=1e-6)
    np.testing.assert_array_equal(actual["quats"], source["quats"])


def test_published_bytes_of_a_compressed_ply(rng):
    """Values worked out by hand from the first splat of a file that splat-transform wrote."""
    path = interop("train1000.compressed.ply")
    assert detect(path).name == "compressed PLY"
    actual = {name: table[0] for name, table in read(path).parameters.items()}
    np.testing.assert_allclose(actual["means"], (-2.633789, -0.987691, -1.480688), atol=2e-6)
    np.testing.assert_allclose(actual["log_scales"], (-5.685699, -4.33116, -4.80418), atol=1e-5)
    np.testing.assert_allclose(actual["quats"], (0.867207, -0.281322, 0.22326, 0.344913), atol=1e-6)
    np.testing.assert_allclose(actual["logit_opacity"], 0.149296, atol=1e-5)
    np.testing.assert_allclose(actual["sh_base"], (-0.85329, -0.360405, -0.564274), atol=1e-5)
    np.testing.assert_allclose(actual["sh_rest"][::3][:4], (0.015625, 0.015625, -0.078125, -0.046875), atol=1e-7)


@pytest.mark.parametrize(("name", "rows"), [("train1000", 1000), ("playbot31k", 31_000)])
def test_compressed_ply_of_another_program_equals_its_source(name, rows):
    """Its splats are sorted: each is matched with the nearest of the source."""
    source, result = read(interop(f"{name}.ply")), read(interop(f"{name}.compressed.ply"))
    assert len(result) == rows
    distance, nearest = cKDTree(source.parameters["means"]).query(result.parameters["means"])
    assert np.median(distance) < 5e-3
    kept = source.rows(nearest)
    difference = np.abs(result.parameters["sh_base"] - kept.parameters["sh_base"])
    assert np.median(difference) < 0.01


def test_compressed_ply_without_ranges_of_colors(tmp_path):
    header, body = packed()
    for end in ("min", "max"):
        for color in "rgb":
            header = header.replace(f"property float {end}_{color}\n".encode(), b"")
    chunks = np.frombuffer(body[: 4 * 72], "<f4").reshape(4, 18)[:, :12]
    (tmp_path / "b.ply").write_bytes(header + b"end_header\n" + chunks.tobytes() + body[4 * 72 :])
    colors = read(tmp_path / "b.ply").parameters["sh_base"] * 0.28209479177387814 + 0.5
    levels = np.frombuffer(body, "<u4", 4000, 4 * 72).reshape(1000, 4)[:, 3] >> np.uint32(24)
    np.testing.assert_allclose(colors[:, 0], levels / 255, atol=1e-6)


def test_empty_model_is_read(tmp_path, rng):
    assert len(round_trip(tmp_path / "a.ply", splats(rng, 0))) == 0


BROKEN = {
    "no chunks": (lambda h, b: (h.replace(b"element chunk 4", b"element chunks 4"), b), "in 'element chunk'"),
    "too few chunks": (lambda h, b: (h.replace(b"element chunk 4", b"element chunk 3"), b), "3 chunks for 1000 splats"),
    "floats": (lambda h, b: (h.replace(b"uint packed_scale", b"float packed_scale"), b), "'property uint'"),
    "short harmonics": (lambda h, b: (h, b[:-1]), "truncated"),
    "harmonics of nothing": (
        lambda h, b: (re.sub(rb"property uchar \w+\n", b"", h.replace(b"sh 1000", b"sh 5")), b),
        "5 rows of 0 properties",
    ),
    "harmonics of others": (lambda h, b: (h.replace(b"element sh 1000", b"element sh 999"), b), "999 rows"),
    "harmonics from 1 on": (lambda h, b: (h.replace(b"f_rest_0\n", b"f_rest_9\n"), b), "numbered from 0;"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_damaged_compressed_ply_is_refused(fault, tmp_path):
    change, words = BROKEN[fault]
    (tmp_path / "b.ply").write_bytes(b"end_header\n".join(change(*packed())))
    with pytest.raises(DataError, match=words):
        read(tmp_path / "b.ply")


@pytest.mark.parametrize("degree", [0, 3])
def test_ascii_ply_is_its_binary_twin(degree, tmp_path, rng):
    write(tmp_path / "a.ply", splats(rng, 20, degree, "mip"))
    text = as_text((tmp_path / "a.ply").read_bytes())
    for name, content in (("b.ply", text), ("c.ply", text.replace(b"\n", b"\r\n"))):
        (tmp_path / name).write_bytes(content)
        result = read(tmp_path / name)
        assert result.mode == "mip"
        for table, values in read(tmp_path / "a.ply").parameters.items():
            np.testing.assert_array_equal(result.parameters[table], values)
    (tmp_path / "b.ply").write_bytes(text.replace(b"element vertex 20", b"element vertex 999999999"))
    with pytest.raises(DataError, match=r"declares 999999999 vertices, .* bytes; the file is truncated"):
        read(tmp_path / "b.ply")


def test_degree_four_of_a_ply_is_cut_to_three(tmp_path, rng, caplog):
    write(tmp_path / "a.ply", splats(rng, 5, 3))
    before = read(tmp_path / "a.ply").parameters["sh_rest"].reshape(5, 15, 3)
    wide = np.pad(before, ((0, 0), (0, 9), (0, 0)), constant_values=7).transpose(0, 2, 1).reshape(5, 72)
    data = (tmp_path / "a.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(5, -1)
    more = "".join(f"property float f_rest_{i}\n" for i in range(45, 72)).encode()
    head = head.replace(b"property float opacity\n", more + b"property float opacity\n")
    rows = np.concatenate([table[:, :9], wide, table[:, 54:]], axis=1)
    (tmp_path / "b.ply").write_bytes(head + b"end_header\n" + rows.astype("<f4").tobytes())
    np.testing.assert_array_equal(read(tmp_path / "b.ply").parameters["sh_rest"].reshape(5, 15, 3), before)
    assert caplog.messages == [f"{tmp_path / 'b.ply'}: dropped the SH bands of degree 4"]
