"""SPZ: published bytes, every version, and invalid declarations."""

import gzip
import struct
import sys
import tracemalloc
import zlib
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.core.errors import ConfigError, DataError, MemoryLimitError
from clsplat.core.harmonics import basis
from clsplat.formats.packing import morton_order
from clsplat.formats.sog_quantize import log_weights
from clsplat.formats.splats import ReadOptions, WriteOptions, flip_axes, normalize_quats
from clsplat.formats.spz import AXES
from clsplat.formats.table import detect, read, write
from tests.support.models import angles, assert_close, interop, round_trip, splats, spz_version_4

STEPS = {"means": 2**-13, "log_scales": 1 / 32, "opacity": 0.501 / 255, "sh_base": 0.501 / 255 / 0.15}


def version_4(path, source, **more):
    pytest.importorskip("zstandard")
    write(path, source, WriteOptions(**more))
    path.write_bytes(spz_version_4(path.read_bytes()))
    return path.read_bytes()


@pytest.mark.parametrize("version", [3, 4])
def test_published_bytes_of_an_spz(version):
    """Positions as the file has them, up and back; then as a PLY has them, whose order it keeps."""
    path = interop(f"train1000.v{version}.spz")
    assert detect(path).name == "SPZ"
    actual = {name: table[0] for name, table in flip_axes(read(path).parameters).items()}
    np.testing.assert_allclose(actual["means"], (2.095947, 0.599854, -1.219238), atol=1e-6)
    np.testing.assert_allclose(actual["log_scales"], (-5.6875, -5.0625, -5.125), atol=0)
    np.testing.assert_allclose(actual["quats"], (0.993998, 0.009686, -0.03321, 0.103783), atol=1e-6)
    assert not actual["sh_rest"].any()
    turned = {name: table[0] for name, table in read(path).parameters.items()}
    np.testing.assert_allclose(turned["means"], (2.095947, -0.599854, 1.219238), atol=1e-6)
    np.testing.assert_allclose(turned["quats"], (0.993998, 0.009686, 0.03321, -0.103783), atol=1e-6)


@pytest.mark.parametrize("version", [3, 4])
def test_spz_of_another_program_equals_its_source(version):
    source, result = read(interop("playbot31k.ply")), read(interop(f"playbot31k.v{version}.spz"))
    kept = np.sort(source.parameters["means"], axis=0), np.sort(result.parameters["means"], axis=0)
    np.testing.assert_allclose(kept[0], kept[1], atol=2e-4)
    assert angles(read(interop("train1000.ply")), read(interop(f"train1000.v{version}.spz"))).max() < 0.2


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_round_trip_is_within_its_steps(tmp_path, rng, degree):
    source = splats(rng, 200, degree, "mip")
    copy = round_trip(tmp_path / "a.spz", source, WriteOptions(quality="high"))
    expected = source.rows(morton_order(source.parameters["means"]))
    assert copy.mode == "mip"
    assert_close(copy, expected, 0.25, sh_rest=1 / 256, **STEPS)


def test_both_versions_give_the_same_values(tmp_path, rng):
    source = splats(rng, 100)
    version_4(tmp_path / "b.spz", source)
    a, b = round_trip(tmp_path / "a.spz", source), read(tmp_path / "b.spz")
    for name, table in a.parameters.items():
        np.testing.assert_array_equal(table, b.parameters[name])


def test_positions_get_as_many_bits_as_needed(tmp_path, rng, caplog):
    for largest, fraction in ((1.0, 12), (2047.0, 12), (2049.0, 11), (4095.0, 11), (5000.0, 10), (8388607.0, 0)):
        source = splats(rng, 50, 0)
        source.parameters["log_scales"][:] = -9.9  # no larger steps for larger Gaussians
        caplog.clear()
        source.parameters["means"][0] = largest
        expected = source.rows(morton_order(source.parameters["means"])).parameters
        actual = round_trip(tmp_path / "a.spz", source).parameters["means"]
        away, least = np.abs(actual - expected["means"]).max(axis=1), 2.0 ** -(fraction + 1)
        assert (away <= np.maximum(np.exp(-9.9) / 4 * np.exp2(-log_weights(expected) / 2), least)).all()
        lost = (
            f"coordinate, {largest:g}, SPZ rounds all positions to {2.0**-fraction:.3g} instead of 0.000244 scene units"
        )
        warned = [record for record in caplog.records if record.levelname == "WARNING"]
        assert (lost in caplog.text) == bool(warned) == (fraction < 12)
    source.parameters["means"][0] = 8388608.0
    with pytest.raises(
        DataError, match=r"SPZ stores positions up to 8388607, but the model reaches 8\.38861e\+06; crop the model"
    ):
        write(tmp_path / "a.spz", source)
    source = splats(rng, 50)
    fine = round_trip(tmp_path / "a.spz", source, WriteOptions(quality="high")).parameters["means"]
    assert np.abs(fine - source.rows(morton_order(source.parameters["means"])).parameters["means"]).max() < 2e-6


def test_harmonics_beyond_one_are_clipped_with_a_warning(tmp_path, rng, caplog):
    source = splats(rng, 10)
    source.parameters["sh_rest"][3, 5] = 2.9
    copy = round_trip(tmp_path / "a.spz", source)
    assert "values of 1 Gaussians were clipped" in caplog.text
    assert 127 / 128 <= np.abs(copy.parameters["sh_rest"]).max() <= 1


def test_out_of_range_values_are_clipped_with_a_warning(tmp_path, rng, caplog):
    source = splats(rng, 10)
    source.parameters["sh_base"][2:4, 1] = 9
    source.parameters["log_scales"][5, 0] = -12
    round_trip(tmp_path / "a.spz", source)
    assert "colors from -0.44 to 1.44; values of 2 Gaussians were clipped" in caplog.text
    assert "scales from 4.5e-05 to 379; values of 1 Gaussians were clipped" in caplog.text


def legacy(version, count=2, flags=0, rest=b""):
    """A file of version 1 or 2, degree 0: all at (1, -2, 0.5), opacity 1, quaternion (1, 0, 0, 0)."""
    positions = (
        np.float16([1, -2, 0.5]).tobytes()
        if version == 1
        else b"".join(struct.pack("<i", int(v * 4096))[:3] for v in (1, -2, 0.5))
    )
    first = [positions, b"\xff", b"\x80" * 3, b"\x50" * 3, b"\x80\x7f\x80" if version < 3 else b""]
    header = struct.pack("<4s2I4B", b"NGSP", version, count, 0, 12, flags, 0)
    return header + b"".join(plane * count for plane in first) + rest


@pytest.mark.parametrize("version", [1, 2])
def test_older_versions_are_read(version, tmp_path):
    (tmp_path / "a.spz").write_bytes(gzip.compress(legacy(version)))
    actual = read(tmp_path / "a.spz").parameters
    np.testing.assert_allclose(actual["means"], [[1, 2, -0.5]] * 2)
    np.testing.assert_allclose(np.abs(actual["quats"]), [[1, 0, 0, 0]] * 2, atol=0.005)
    np.testing.assert_array_equal(actual["log_scales"], np.full((2, 3), -5))


def test_axes_and_losses_are_reported_unless_the_caller_knows(tmp_path, rng, caplog):
    caplog.set_level("INFO")
    first = replace(splats(rng, 20), rendering={"background": "white"})
    for name in ("a.spz", "b.spz"):
        write(tmp_path / name, first)
        read(tmp_path / name)
    assert [
        (text.split(":")[0], "does not store" in text, "read with the axes" in text) for text in caplog.messages
    ] == [(str(tmp_path / name), writes, not writes) for name in ("a.spz", "b.spz") for writes in (True, False)]
    caplog.clear()
    write(tmp_path / "a.spz", first, WriteOptions(quiet=True))
    read(tmp_path / "a.spz", ReadOptions(quiet=True))
    assert not caplog.messages


def test_unknown_extensions_are_skipped(tmp_path):
    path = tmp_path / "a.spz"
    other = struct.pack("<2I4s", 7, 4, b"abcd")
    path.write_bytes(gzip.compress(legacy(2, flags=2, rest=other)))
    assert len(read(path)) == 2
    long = struct.pack("<2I", 7, 200_000) + bytes(200_000)
    path.write_bytes(gzip.compress(legacy(2, flags=2, rest=long + struct.pack("<2II", 0xADBE0003, 4, 17))))
    with pytest.raises(DataError, match="its axes record has 4 bytes, 11000000; expected 4 bytes with a number"):
        read(path)
    damaged = bytearray(gzip.compress(legacy(2, flags=2, rest=other)))
    damaged[-5] ^= 1  # of the checksum, which is read with the records
    path.write_bytes(damaged)
    with pytest.raises(DataError, match="incorrect data check"):
        read(path)
    path.write_bytes(gzip.compress(legacy(2, flags=2, rest=other + struct.pack("<2IH", 0xADBE0003, 2, 1))))
    with pytest.raises(DataError, match="its axes record has 2 bytes, nothing"):
        read(path)


def test_declared_axes_are_turned_to_those_of_a_ply(tmp_path, caplog):
    """Each name gives the same scene: its points, and the color that each direction sees."""
    caplog.set_level("INFO")
    axes = {"L": (-1, 0, 0), "R": (1, 0, 0), "U": (0, -1, 0), "D": (0, 1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
    path, draw = tmp_path / "a.spz", np.random.default_rng(0).integers
    planes = [draw(0, 256, 2 * 13), draw(140, 180, 2 * 3), draw(60, 196, 2 * 3), draw(0, 256, 2 * 45)]
    rest = b"".join(plane.astype(np.uint8).tobytes() for plane in planes)
    direction = np.array([0.48, 0.6, 0.64])
    for number, name in enumerate(AXES, 1):
        header = struct.pack("<4s2I4B", b"NGSP", 2, 2, 3, 12, 2, 0)
        path.write_bytes(header + rest + struct.pack("<2II", 0xADBE0003, 4, number))
        result = read(path)
        path.write_bytes(header + rest + struct.pack("<2II", 0xADBE0003, 4, 6))
        stored = read(path)  # of the axes of a PLY
        matrix = np.array([axes[letter] for letter in name], np.float64).T
        assert f"axes that it declares, {name}" in caplog.text
        np.testing.assert_allclose(result.parameters["means"], stored.parameters["means"] @ matrix.T, atol=1e-6)
        colors = [
            basis(seen[None]) @ one.parameters["sh_rest"].reshape(2, 15, 3)
            for one, seen in ((stored, direction), (result, matrix @ direction))
        ]
        np.testing.assert_allclose(*colors, atol=1e-5)
        spreads = [
            Rotation.from_quat(np.roll(normalize_quats(one.parameters["quats"]), -1, axis=1)).as_matrix()
            * np.exp(one.parameters["log_scales"])[:, None, :]
            for one in (stored, result)
        ]
        before, after = (spread @ spread.transpose(0, 2, 1) for spread in spreads)
        np.testing.assert_allclose(matrix @ before @ matrix.T, after, atol=1e-5 * before.max())


@pytest.mark.parametrize("ends", [[], [5, 40, 40]])
def test_plain_file_equals_one_in_gzip_members(ends, tmp_path):
    data = legacy(2)
    (tmp_path / "a.spz").write_bytes(data)
    members = [data[start:end] for start, end in pairwise([0, *ends, len(data)])] + [b""] * bool(ends)
    (tmp_path / "b.spz").write_bytes(b"".join(map(gzip.compress, members)))
    for name, table in read(tmp_path / "a.spz").parameters.items():
        np.testing.assert_array_equal(table, read(tmp_path / "b.spz").parameters[name])


@pytest.mark.parametrize("degree", [0, 3])
def test_more_splats_than_an_old_version_allows_are_refused(degree, tmp_path):
    """A gzip file of 2 MB could stand for a hundred million splats."""
    header = struct.pack("<4s2I4B", b"NGSP", 3, 10_000_000, degree, 12, 0, 0)
    data = gzip.compress(header + bytes(1 << 22), 1)
    (tmp_path / "a.spz").write_bytes(data + bytes(2_000_000))
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"declares 10000000 splats, .* more than it can contain"):
            read(tmp_path / "a.spz")
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_more_splats_than_the_memory_holds_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.formats.splats.available_memory", lambda: 100)
    (tmp_path / "a.spz").write_bytes(gzip.compress(legacy(2)))
    with pytest.raises(
        MemoryLimitError, match=r"a\.spz: declares 2 Gaussians, which need 0.0 GiB of memory, but only 0.0 GiB is free"
    ):
        read(tmp_path / "a.spz")


def test_degree_four_is_cut_to_three(tmp_path, caplog):
    body = legacy(2)[16:] + b"\x90" * (2 * 72)
    (tmp_path / "a.spz").write_bytes(gzip.compress(struct.pack("<4s2I4B", b"NGSP", 2, 2, 4, 12, 0, 0) + body))
    assert np.abs(read(tmp_path / "a.spz").parameters["sh_rest"]).tolist() == [[0.125] * 45] * 2
    assert "degree 4" in caplog.text


REFUSED = {
    "other version": (gzip.compress(legacy(5)), "version 5"),
    "count": (gzip.compress(legacy(2, 2)[:8] + struct.pack("<I", 2**31) + legacy(2)[12:]), "more than it can contain"),
    "short": (gzip.compress(legacy(2)[:-1]), "too short"),
    "long": (gzip.compress(legacy(2) + b"a"), "has data after its 2 splats"),
    "gzip": (gzip.compress(legacy(2))[:20], "not an SPZ|ends early"),
    "cut by its trailer": (gzip.compress(legacy(2))[:-8], "is truncated before the checksum of its gzip data; copy"),
    "cut by three bytes": (gzip.compress(legacy(2))[:-3], "is truncated before the checksum of its gzip data; copy"),
    "cut with records": (gzip.compress(legacy(2, flags=2))[:-3], "is truncated before the checksum"),
    "rubbish": (gzip.compress(legacy(2)) + b"rubbish", "has 7 bytes after its gzip data; copy"),
    "two members": (gzip.compress(legacy(2)) * 2, "has data after its 2 splats"),
    "checksum of bytes": (b"\x1f\x8b\x08\0\0\0\0\0\0\xff\xff\xff\xff", "in gzip"),
    "plain and short": (legacy(3)[:-1], "more than it can contain|too short"),
    "plain and long": (legacy(2) + b"a", "has data after its 2 splats"),
    "header": (b"NGSP\4\0\0\0", "shorter than its header of 16 bytes"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_damaged_spz_is_refused(fault, tmp_path):
    data, words = REFUSED[fault]
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(DataError, match=words):
        read(tmp_path / "a.spz")


def test_streams_of_wrong_sizes_are_refused(tmp_path, rng):
    path = tmp_path / "a.spz"
    data = version_4(path, splats(rng, 40))
    table = struct.unpack_from("<12Q", data, 32)
    cases = {
        "has data after its last stream": data + b"x",
        "has 5 streams": data[:15] + b"\5" + data[16:],
        "table at byte 4294967295": data[:16] + b"\xff" * 4 + data[20:],
        "expected 360 decompressed bytes for 40 splats": data[:40] + struct.pack("<Q", table[1] + 1) + data[48:],
        f"declares {2**40} bytes": data[:32] + struct.pack("<Q", 2**40) + data[40:],
        "a stream is damaged": data[:128] + bytes(8) + data[136:],
    }
    for words, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(DataError, match=words):
            read(path)


def test_decompression_bomb_is_refused_early(tmp_path):
    """A stream that would become 1 GiB, in a file that declares two splats."""
    zstandard = pytest.importorskip("zstandard")
    frame = zstandard.ZstdCompressor(1).compress(bytes(1 << 26)) * 16
    sizes = [18, 2, 6, 6, 8]
    table = struct.pack("<2Q", len(frame), 18) + b"".join(struct.pack("<2Q", 0, size) for size in sizes[1:])
    header = struct.pack("<4s2I4BI12x", b"NGSP", 4, 2, 0, 12, 0, 5, 32)
    assert len(header) == 32
    (tmp_path / "a.spz").write_bytes(header + table + frame)
    with pytest.raises(DataError, match="a stream is too long; expected 18"):
        read(tmp_path / "a.spz")
    (tmp_path / "a.spz").write_bytes(zlib.compress(legacy(2) + bytes(1 << 26), wbits=31))
    with pytest.raises(DataError, match="has data after its 2 splats"):
        read(tmp_path / "a.spz")


def test_version_4_without_zstandard_names_the_package(tmp_path, rng, monkeypatch):
    version_4(tmp_path / "a.spz", splats(rng, 3))
    monkeypatch.setitem(sys.modules, "zstandard", None)
    monkeypatch.setitem(sys.modules, "compression", None)
    with pytest.raises(ConfigError, match=r"pip install '\.\[spz\]'"):
        read(tmp_path / "a.spz")


@pytest.mark.parametrize("version", [3, 4])
def test_reading_needs_little_more_memory_than_the_model(version, tmp_path, rng):
    """All planes but the positions of a file of version 4 are of equal bytes, so that the file is small."""
    zstandard = pytest.importorskip("zstandard") if version == 4 else None
    count = 200_000
    planes = [bytes(count * width) for width in (9, 1, 3, 3, 4, 45)]
    header = struct.pack("<4s2I4B", b"NGSP", version, count, 3, 12, 0, 0)
    if zstandard:
        planes[0] = rng.bytes(count // 100).ljust(9 * count, b"\0")
        frames = [zstandard.ZstdCompressor(1).compress(plane) for plane in planes]
        sizes = b"".join(struct.pack("<2Q", len(f), len(p)) for f, p in zip(frames, planes, strict=True))
        content = header[:-1] + struct.pack("<BI12x", 6, 32) + sizes + b"".join(frames)
    else:
        content = gzip.compress(header + b"".join(planes))
    path = tmp_path / "a.spz"
    path.write_bytes(content)
    tracemalloc.start()
    try:
        result = read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(content) < 70_000
    assert len(result) == count
    assert peak / count < 1.3 * 59 * 4, f"{peak / count:.0f} bytes a splat; the model has {59 * 4}"


def test_more_splats_than_version_4_allows_are_refused(tmp_path):
    """Zstandard itself has no such bound: a file of 40 kB could stand for 20 million splats."""
    pytest.importorskip("zstandard")
    count, path = 20_000_000, tmp_path / "a.spz"
    table = b"".join(struct.pack("<2Q", 8000, count * width) for width in (9, 1, 3, 3, 4))
    path.write_bytes(struct.pack("<4s2I4BI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32) + table + bytes(5 * 8000))
    with pytest.raises(
        DataError, match=r"20000000 splats, 400000000 bytes in total, more than it can contain \([0-9]+\); .*copy"
    ):
        read(path)
