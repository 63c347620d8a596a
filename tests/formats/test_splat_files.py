"""`.splat` and `.ksplat` files."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.core.errors import ConfigError, DataError
from clsplat.formats.splat import ROW
from clsplat.formats.splats import opacities
from clsplat.formats.table import detect, read, write
from tests.support.models import angles, assert_close, interop, ksplat, round_trip, splats

PUBLISHED = bytes.fromhex("c2851ec15dd5db3eba33d54072ce773ee8e8ca3d8e23743e7a8d597cff80757d")
LEVELS = {"L0": (1e-6, 1e-6, 1e-6), "L1": (2e-4, 0.002, 0.001), "L2": (2e-4, 0.002, 0.013)}


def by_size(source):
    """The rows of a model in the order of a `.splat` file."""
    p = source.parameters
    size = p["log_scales"].astype(np.float64).sum(axis=1) + np.log(opacities(p["logit_opacity"])[:, 0])
    return source.rows(np.argsort(-size, kind="stable"))


def test_published_bytes_of_a_splat(tmp_path):
    (tmp_path / "a").write_bytes(PUBLISHED)
    assert detect(tmp_path / "a").name == "splat", "by content, for the name says nothing"
    actual = {name: table[0] for name, table in read(tmp_path / "a").parameters.items()}
    np.testing.assert_allclose(actual["means"], (-9.907656, 0.429362, 6.662564), atol=1e-6)
    np.testing.assert_allclose(actual["log_scales"], (-1.418824, -2.311857, -1.433735), atol=1e-6)
    np.testing.assert_allclose(actual["logit_opacity"], np.log(0x7C / (255 - 0x7C)), atol=1e-5)


@pytest.mark.parametrize("name", ["train1000"])
def test_splat_of_another_program_equals_its_source(name):
    source, result = read(interop(f"{name}.ply")), read(interop(f"{name}.splat"))
    expected = by_size(source)
    same = np.flatnonzero((result.parameters["means"] == expected.parameters["means"]).all(axis=1))
    assert len(same) > 0.9 * len(result), "ties are in another order"
    assert angles(result.rows(same), expected.rows(same)).max() < 1.8, "its writer truncates to 1/128"
    result, expected = result.rows(same), expected.rows(same)
    np.testing.assert_allclose(result.parameters["log_scales"], expected.parameters["log_scales"], atol=1e-5)


def test_splat_round_trip_is_within_its_steps(tmp_path, rng):
    source = splats(rng, 300)
    source.parameters["sh_base"][:] = np.clip(source.parameters["sh_base"], -1.7, 1.7)
    copy = round_trip(tmp_path / "a.splat", source)
    expected = by_size(source)
    expected.parameters["sh_rest"] = np.zeros((300, 0), np.float32)
    bounds = {"means": 0, "log_scales": 1e-6, "opacity": 0.501 / 255, "sh_base": 0.501 / 255 / 0.2820947, "sh_rest": 0}
    assert_close(copy, expected, 0.8, **bounds)


def test_data_lost_in_splat_is_reported(tmp_path, rng, caplog):
    source = splats(rng, 10)
    source.parameters["sh_base"][:] = 0
    source.parameters["sh_base"][4:7] = -3
    write(tmp_path / "a.splat", source)
    assert "splat stores colors from 0 to 1; values of 3 Gaussians were clipped" in caplog.text
    assert "splat stores no SH coefficients" in caplog.text


def test_text_of_numbers_is_not_a_splat(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"0.001 0.0020.001 0.0020.001 0.02" * 5)
    assert detect(tmp_path / "a.txt") is None
    with pytest.raises(DataError, match=r"unknown model format; expected one of .ply, "):
        read(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("data", "words"), [(PUBLISHED[:-1], "31 bytes, not a multiple of 32"), (b"\xff" * 64, "finite")]
)
def test_damaged_splat_is_refused(data, words, tmp_path):
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(DataError, match=words):
        read(tmp_path / "a.splat")


def test_scales_of_a_splat_may_be_logarithms(tmp_path, rng, caplog):
    source = splats(rng, 40, 0)
    write(tmp_path / "a.splat", source)
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), ROW).copy()
    expected = np.log(rows["scale"])
    rows["scale"] = expected
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    np.testing.assert_array_equal(read(tmp_path / "a.splat").parameters["log_scales"], expected)
    assert "its scales are negative: they are read as logarithms" in caplog.text
    rows["scale"] = np.abs(expected)
    rows["scale"][0] = -1
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    with pytest.raises(DataError, match="has scales below 0"):
        read(tmp_path / "a.splat")


@pytest.mark.parametrize("level", LEVELS)
def test_ksplat_of_another_program_equals_its_source(level):
    """Its writer keeps degree 2 and the order of the source."""
    source, result = read(interop("train1000.ply")), read(interop(f"train1000.{level}.ksplat"))
    assert detect(interop(f"train1000.{level}.ksplat")).name == "ksplat"
    degree = result.sh_degree
    position, scale, sh = LEVELS[level]
    assert len(result) == len(source)
    expected = source.rows(cKDTree(source.parameters["means"]).query(result.parameters["means"])[1])
    expected.parameters["sh_rest"] = expected.parameters["sh_rest"][:, : 3 * ((degree + 1) ** 2 - 1)]
    bounds = {"means": position, "log_scales": scale, "sh_rest": sh, "opacity": 1.01 / 255}
    assert_close(result, expected, 0.2, **bounds)


@pytest.mark.parametrize("level", LEVELS)
def test_larger_ksplat_has_buckets(level):
    result = read(interop(f"playbot31k.{level}.ksplat"))
    source = read(interop("playbot31k.ply"))
    assert len(result) == len(source)
    for axis in range(3):
        a, b = np.sort(result.parameters["means"][:, axis]), np.sort(source.parameters["means"][:, axis])
        np.testing.assert_allclose(a, b, atol=1e-3)


def test_positions_of_a_ksplat_are_relative_to_their_bucket(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(ksplat())
    actual = read(tmp_path / "a.ksplat").parameters
    np.testing.assert_allclose(actual["means"], [[-1.5, -0.5, 0.5]] * 3)
    assert actual["sh_rest"].shape == (3, 9)


DAMAGED = {
    "more splats than places": ({"count": 4}, "4 splats in 3 rows"),
    "degree": ({"degree": 3}, "SH degree 3"),
    "places": ({"rows": 3, "buckets": 10**6}, "truncated"),
    "empty buckets": ({"held": 2}, "fewer than the declared"),
    "full buckets": ({"full": 1}, "do not match"),
    "no places": ({"most": 0}, "not a .ksplat"),
}


def test_ksplat_without_a_section_count_has_all_sections(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(ksplat(sections=0))
    assert len(read(tmp_path / "a.ksplat")) == 3
    (tmp_path / "a.ksplat").write_bytes(ksplat(count=0, sections=0)[:4096])
    with pytest.raises(DataError, match=r"a\.ksplat: has no splats; export it again"):
        read(tmp_path / "a.ksplat")


def test_splat_is_recognized_unless_the_name_is_of_another(tmp_path):
    for name in ("a", "a.bin", "a.splat"):
        (tmp_path / name).write_bytes(PUBLISHED * 40)
        assert len(read(tmp_path / name)) == 40
    (tmp_path / "a.ksplat").write_bytes(PUBLISHED * 200)
    with pytest.raises(DataError, match=r"not a \.ksplat file"):
        read(tmp_path / "a.ksplat")


@pytest.mark.parametrize("fault", DAMAGED)
def test_damaged_ksplat_is_refused(fault, tmp_path):
    change, words = DAMAGED[fault]
    (tmp_path / "a.ksplat").write_bytes(ksplat(**change))
    with pytest.raises(DataError, match=words):
        read(tmp_path / "a.ksplat")


def test_ksplat_is_not_written(tmp_path, rng):
    with pytest.raises(ConfigError, match=r"ksplat can be read but not written; use a name that ends in .ply, "):
        write(tmp_path / "a.ksplat", splats(rng, 3))
