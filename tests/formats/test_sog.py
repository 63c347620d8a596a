"""SOG: published bytes, both containers, both versions, and invalid declarations."""

import errno
import io
import json
import os
import shutil
import subprocess
import sys
import tracemalloc
import zipfile
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError, OutputError
from clsplat.formats.packing import morton_order
from clsplat.formats.palette import ENTRIES, fit_codebook, fit_palette, nearest_entries
from clsplat.formats.splats import WriteOptions
from clsplat.formats.table import detect, read, write
from tests.support.data_sets import data_set
from tests.support.models import assert_close, interop, round_trip, splats


def test_published_bytes_of_a_sog():
    path = interop("train1000.sog")
    assert detect(path).name == "SOG"
    actual = {name: table[0] for name, table in read(path).parameters.items()}
    np.testing.assert_allclose(actual["means"], (-2.631508, -0.98734, -1.482454), atol=2e-6)
    np.testing.assert_allclose(actual["log_scales"], (-5.693027, -4.337001, -4.804688), atol=1e-5)
    np.testing.assert_allclose(actual["quats"], (0.868391, -0.285616, 0.219064, 0.341075), atol=1e-6)
    np.testing.assert_allclose(actual["logit_opacity"], 0.133531, atol=1e-5)
    np.testing.assert_allclose(actual["sh_rest"][::3][:4], (0.014241, 0.016862, -0.073519, -0.052921), atol=1e-6)


def test_sog_of_another_program_equals_its_source():
    source, result = read(interop("playbot31k.ply")), read(interop("playbot31k.sog"))
    kept = np.sort(source.parameters["means"], axis=0), np.sort(result.parameters["means"], axis=0)
    np.testing.assert_allclose(kept[0], kept[1], atol=1e-4)


def test_version_1_is_read():
    actual = read(data_set("splats") / "playcanvas-logo_sog").parameters
    assert len(actual["means"]) == 307_128
    np.testing.assert_allclose(actual["log_scales"].max(axis=0), (-1.0510782, -1.2544534, -0.9433849), atol=1e-5)
    np.testing.assert_allclose(actual["logit_opacity"].max(), 5.537334, atol=1e-5)


@pytest.mark.parametrize(("count", "degree"), [(1, 3), (63, 0), (300, 1), (1100, 2)])
def test_sog_round_trip_is_within_its_steps(tmp_path, rng, count, degree):
    source = splats(rng, count, degree, "mip")
    copy = round_trip(tmp_path / "a.sog", source, WriteOptions(quality="high"))
    expected = source.rows(morton_order(source.parameters["means"]))
    assert (copy.mode, copy.rendering) == ("mip", source.rendering)
    assert_close(copy, expected, 0.8, means=0.002, log_scales=0.05, opacity=0.0101, sh_base=0.05, sh_rest=0.5)


def test_palette_with_an_entry_per_distinct_vector_is_exact(tmp_path, rng):
    """Eight different colors in a thousand Gaussians."""
    source = splats(rng, 1024)
    source.parameters["sh_rest"][:] = source.parameters["sh_rest"][rng.integers(0, 8, 1024)].round(1)
    actual = round_trip(tmp_path / "a.sog", source).parameters["sh_rest"]
    expected = source.rows(morton_order(source.parameters["means"])).parameters["sh_rest"]
    np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_folder_and_bundle_have_the_same_content(tmp_path, rng):
    source = splats(rng, 200, 1)
    bundled = round_trip(tmp_path / "a.sog", source)
    write(tmp_path / "folder" / "meta.json", source)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        images = {archive.read(name) for name in archive.namelist() if name != "meta.json"}
    assert images == {file.read_bytes() for file in (tmp_path / "folder").glob("*.webp")}
    for place in (tmp_path / "folder", tmp_path / "folder" / "meta.json"):
        for name, table in read(place).parameters.items():
            np.testing.assert_array_equal(table, bundled.parameters[name])


@pytest.mark.parametrize("at", [1, 2, 9, 16, 17, 18])
def test_folder_keeps_its_old_model_until_the_new_is_complete(at, tmp_path, rng, monkeypatch):
    """The n-th sync or rename of a write fails: images of one model never stand under the meta.json of another."""
    path, calls = tmp_path / "meta.json", []
    old, new = (splats(rng, 30, 0) for _ in range(2))
    write(path, old)
    before = read(path).parameters["means"]
    (tmp_path / "photo.webp").write_bytes(b"of nobody")

    def failing(function):
        def call(*arguments):
            calls.append(function)
            if len(calls) == at:
                raise OSError(errno.ENOSPC, "No space left on device")
            return function(*arguments)

        return call

    with monkeypatch.context() as patch:
        for name in ("fsync", "replace"):
            patch.setattr(os, name, failing(getattr(os, name)))
        with pytest.raises(OutputError, match="No space left"):
            write(path, new)
    actual = read(path).parameters["means"]
    if at == 18:  # of the folder, after the rename: a power cut may still undo it, so both are kept
        assert not np.array_equal(actual, before)
        return
    np.testing.assert_array_equal(actual, before)
    assert len(list(tmp_path.glob("*.webp"))) == 5 + 1
    write(path, new)
    assert len(list(tmp_path.glob("*.webp"))) == 5 + 1
    assert not np.array_equal(read(path).parameters["means"], before)


def test_replacing_meta_removes_only_its_own_images(tmp_path, rng):
    """But no other file that a meta.json names, and none outside of the folder."""
    folder, other = folder_of(tmp_path, rng, means__files=["letter.txt", "../other.webp"]), tmp_path / "other.webp"
    for file in (folder / "letter.txt", other):
        file.write_bytes(b"mine")
    write(folder / "meta.json", splats(rng, 40, 0))
    assert len(read(folder)) == 40
    assert not (folder / "quats.webp").exists()
    assert (folder / "letter.txt").read_bytes() == other.read_bytes() == b"mine"


def test_larger_palette_is_more_accurate(tmp_path, rng):
    source = splats(rng, 2050, 1)
    errors = []
    for quality in ("small", "balanced"):
        actual = round_trip(tmp_path / "a.sog", source, WriteOptions(quality=quality)).parameters["sh_rest"]
        expected = source.rows(morton_order(source.parameters["means"])).parameters["sh_rest"]
        errors.append(float(np.square(actual - expected).mean()))
    assert errors[1] < errors[0] < 0.1**2


def test_codebook_is_more_accurate_than_equal_steps(rng):
    values = rng.normal(size=20_000) ** 3
    entries = fit_codebook(values)
    assert len(entries) == ENTRIES
    assert (np.diff(entries) >= 0).all()
    error = np.square(entries[nearest_entries(values, entries)] - values).mean()
    equal = np.linspace(values.min(), values.max(), ENTRIES)
    assert error < 0.2 * np.square(equal[nearest_entries(values, equal)] - values).mean()
    few = np.float32([3, 1, 2, 2])
    np.testing.assert_array_equal(fit_codebook(few)[nearest_entries(few, fit_codebook(few))], few)


@pytest.mark.parametrize("far", [[-1e5] * 50, [1e8], [1e15, -1e15, 3e8]])
def test_outliers_barely_affect_other_values(far, rng):
    values = rng.normal(-5, 1.2, 60_000)

    def error(entries):
        return np.square(entries[nearest_entries(values, entries)] - values).mean()

    assert error(fit_codebook(np.append(values, far))) < 2 * error(fit_codebook(values))


def test_every_point_gets_its_nearest_integer_vector(rng):
    points = rng.integers(-511, 512, (400, 45)).astype(np.float32)
    points[0, 0] = 511
    vectors, labels = fit_palette(points, 32, np.ones(400))
    distance = np.square(points[:, None].astype(np.int64) - np.rint(vectors).astype(np.int64)).sum(axis=2)
    assert (distance[np.arange(400), labels] <= distance.min(axis=1) * 1.02).all()
    assert len(np.unique(labels)) > 28


def test_palette_is_more_accurate_for_heavier_points(rng):
    points = rng.normal(size=(4000, 9)).astype(np.float32)
    weights = np.where(np.arange(4000) % 10 == 0, 50.0, 0.1)

    def error(actual):
        return (weights * np.square(actual[0][actual[1]] - points).sum(axis=1)).sum()

    evenly, weighted = fit_palette(points, 64, np.zeros(4000)), fit_palette(points, 64, weights)
    assert error(weighted) < 0.8 * error(evenly)


def test_palette_does_not_depend_on_the_thread_count(rng):
    """Sums of whole numbers below 2^24: any order of a product gives the same."""
    from clsplat.formats import palette as module

    points = rng.normal(size=(3000, 45)).astype(np.float32)
    before = fit_palette(points, 64, np.ones(3000))
    block = module.BLOCK
    try:
        module.BLOCK = 7  # other shapes take other paths through the library
        after = fit_palette(points, 64, np.ones(3000))
    finally:
        module.BLOCK = block
    np.testing.assert_array_equal(before[0], after[0])
    np.testing.assert_array_equal(before[1], after[1])


def test_transparent_splat_keeps_its_color(tmp_path, rng):
    source = splats(rng, 100, 0)
    source.parameters["logit_opacity"][:] = -20
    copy = round_trip(tmp_path / "a.sog", source, WriteOptions(quality="high"))
    expected = source.rows(morton_order(source.parameters["means"]))
    assert_close(copy, expected, 0.8, sh_base=0.1, opacity=1.01 / 255)


def folder_of(tmp_path, rng, **changes):
    """A folder with the names that other programs give, and changes to its meta.json."""
    write(tmp_path / "a.sog", splats(rng, 100, 1))
    shutil.unpack_archive(tmp_path / "a.sog", tmp_path / "s", "zip")
    meta = json.loads((tmp_path / "s" / "meta.json").read_text())
    for place, value in changes.items():
        *parts, last = place.split("__")
        part = meta
        for name in parts:
            part = part[name]
        part[last] = value
    (tmp_path / "s" / "meta.json").write_text(json.dumps(meta))
    return tmp_path / "s"


REFUSED = {
    "count": ({"count": 10**8}, "declares 100000000 splats"),
    "no count": ({"count": None}, "count is None; expected a whole number"),
    "version": ({"version": 3}, "version 3; expected 1 or 2"),
    "path": ({"means__files": ["../means_l.webp", "x"]}, "the name of a file in the same folder"),
    "names": ({"means__files": 3}, "expected one or two file names"),
    "one file": ({"means__files": ["means_l.webp"]}, "lists 1 files"),
    "missing": ({"quats__files": ["other.webp"]}, "cannot be read"),
    "codebook": ({"scales__codebook": [1.0] * 255}, "expected 256 numbers"),
    "text": ({"sh0__codebook": ["x"] * 256}, "expected 256 numbers"),
    "huge": ({"means__mins": [1e300, 0, 0]}, r"expected 3 numbers below 1e\+30"),
    "bands": ({"shN__bands": 4}, "from 1 to 3"),
    "palette": ({"shN__count": 2**40}, "shN.count is 1099511627776; expected a whole number from 1 to 65536"),
    "longer palette": ({"shN__count": 60000}, "centroids of shN has .* px; expected 180000 to"),
    "shorter palette": ({"shN__count": 2}, r"labels of shN use \d+ centroids, but shN.count is 2"),
    "not JSON": ({"means": 3}, "has no 'means'"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_damaged_meta_is_refused(fault, tmp_path, rng):
    changes, words = REFUSED[fault]
    with pytest.raises(DataError, match=words):
        read(folder_of(tmp_path, rng, **changes))


def test_image_of_another_size_is_refused_before_decoding(tmp_path, rng):
    folder = folder_of(tmp_path, rng)
    large, small = (
        cv2.imencode(".webp", np.zeros((side, side, 4), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        for side, quality in ((4000, 101), (12, 101))
    )
    for data, words in (
        (large, "4000 x 4000 px; expected 100 to"),
        (large[:100], "4000 x 4000 px"),
        (b"RIFF", "not a lossless WebP"),
        ((folder / "quats.webp").read_bytes()[:60], "cannot be decoded"),
        (small[:12] + b"VP8 " + small[16:], "not a lossless WebP"),
    ):
        (folder / "quats.webp").write_bytes(data)
        with pytest.raises(DataError, match=words):
            read(folder)


def test_damaged_bundle_is_refused(tmp_path, rng):
    path = tmp_path / "a.sog"
    write(path, splats(rng, 100, 1))
    data = path.read_bytes()
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 25))
    for content, words in (
        (data[:-30], "a damaged ZIP"),
        (data.replace(b"webpPK", b"wepbPK"), "has no '.*webp'"),
        (bomb.getvalue(), "more than 16777216 bytes"),
    ):
        path.write_bytes(content)
        with pytest.raises(DataError, match=words):
            read(path)


def repacked(path, kind, **files):
    """A bundle with other files, or other compression."""
    with zipfile.ZipFile(path) as archive:
        held = {name: archive.read(name) for name in archive.namelist()} | files
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, data in held.items():
            archive.writestr(name, data)
    return held


def test_bundle_with_unknown_compression_is_refused(tmp_path, rng):
    path = tmp_path / "a.sog"
    write(path, splats(rng, 100, 1))
    repacked(path, zipfile.ZIP_LZMA)
    with pytest.raises(DataError, match=r"'meta.json' uses an unsupported compression; expected .* stored or deflated"):
        read(path)
    repacked(path, zipfile.ZIP_DEFLATED)
    assert len(read(path)) == 100


def test_unpacked_bundle_size_is_limited(tmp_path, rng):
    path = tmp_path / "a.sog"
    write(path, splats(rng, 100, 0))
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
    for part in ("means", "scales", "quats", "sh0"):
        meta[part]["files"] = ["z", "z"]
    repacked(path, zipfile.ZIP_DEFLATED, **{"meta.json": json.dumps(meta), "z": bytes(1 << 26)})
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"'z' has more than .* bytes"):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()


def test_file_listed_twice_is_read_once(tmp_path, rng):
    path = tmp_path / "a.sog"
    write(path, splats(rng, 100, 0))
    held = repacked(path, zipfile.ZIP_STORED)
    meta = json.loads(held["meta.json"])
    meta["quats"]["files"] = meta["scales"]["files"] = ["quats.webp"] * 2
    noise = bytes(rng.integers(0, 256, 1 << 17, np.uint8))  # more than a bundle may hold twice
    repacked(path, zipfile.ZIP_STORED, **{"meta.json": json.dumps(meta), "quats.webp": held["quats.webp"] + noise})
    assert len(read(path)) == 100


def test_bundle_files_may_be_in_a_subfolder(tmp_path, rng):
    write(tmp_path / "s" / "meta.json", splats(rng, 50, 0))
    shutil.make_archive(str(tmp_path / "a"), "zip", tmp_path, "s")
    shutil.move(tmp_path / "a.zip", tmp_path / "a.sog")
    for name, table in read(tmp_path / "a.sog").parameters.items():
        np.testing.assert_array_equal(table, read(tmp_path / "s").parameters[name])


def sums(folder: Path, count: int = 24) -> list[str]:
    """The SHA-256 of so many models as SOG."""
    results = []
    for seed in range(count):
        write(folder / "a.sog", splats(np.random.default_rng(seed), 60, 0), WriteOptions(quiet=True))
        results.append(sha256((folder / "a.sog").read_bytes()).hexdigest())
    return results


def test_cpus_with_and_without_avx_512_write_equal_bytes(tmp_path):
    """NumPy computes logarithms in other ways with it, whose last bit differs."""
    core = pytest.importorskip("numpy._core._multiarray_umath")
    wide = [
        name for name in core.__cpu_dispatch__ if core.__cpu_features__[name] and name.startswith(("AVX512", "X86_V4"))
    ]
    if not wide:
        pytest.skip("this processor has no AVX-512")
    code = (
        "import sys; from pathlib import Path; from tests.formats.test_sog import sums; print(*sums(Path(sys.argv[1])))"
    )
    narrow = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(wide)}
    args = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(args, env=narrow, capture_output=True, text=True, check=True)
    assert done.stdout.split() == sums(tmp_path)


@pytest.mark.parametrize("place", [-7.3, 5e5])
def test_position_precision_depends_only_on_the_range(place, tmp_path, rng):
    source = splats(rng, 400, 0)
    source.parameters["means"][:] += place
    actual = round_trip(tmp_path / "a.sog", source, WriteOptions(quality="high")).parameters["means"]
    expected = source.rows(morton_order(source.parameters["means"])).parameters["means"]
    assert np.abs(actual - expected).max() < (0.05 if place == 5e5 else 1e-3)  # float32 holds steps of 0.03 there
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        means = json.loads(archive.read("meta.json"))["means"]
    ends = np.sign(expected) * np.log1p(np.abs(expected.astype(np.float64)))
    assert (means["mins"] <= ends.min(axis=0)).all()
    assert (means["maxs"] >= ends.max(axis=0)).all()
