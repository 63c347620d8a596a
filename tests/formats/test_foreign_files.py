"""Files of three other projects: read or refused for the right reason, with the values that are published."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.formats.splats import SH_C0, SplatFile, flip_axes, normalize_quats, opacities
from clsplat.formats.table import read
from tests.support.data_sets import data_set

FOLDERS = ("khr", "minimal", "usd3dgs")
NO_MODEL = (".webp", ".provenance.json", ".golden.usda")  # files next to models
EMPTY = {"empty-vertex.ply", "empty-points-v2.spz"}
REFUSED = {
    "khr_extensible_fallback.gltf": "kernel is 'customShape'",
    # PLY
    "duplicate-sh-index.ply": "has 3 f_rest properties",
    "invalid-sh-name.ply": "has 3 f_rest properties",
    "list-property.ply": "line 15: cannot read 'property list",
    "mesh-not-gaussian.ply": "not a splat file",
    "missing-opacity.ply": "has no opacity",
    "nan-opacity-binary-le.ply": "logit_opacity have values that are not finite",
    "non-contiguous-sh.ply": "has 3 f_rest properties",
    "out-of-range-double.ply": "means have values that are not finite",
    "sh-count-not-rgb.ply": "has 2 f_rest properties",
    "sh-invalid-degree.ply": "has 6 f_rest properties",
    "truncated-binary-le.ply": "is truncated",
    # SOG
    "bad-bands.sog": "shN.bands is 4",
    "bad-zip.sog": "damaged ZIP",
    "corrupt-plane.sog": "has 16384 x 16384 px",
    "count-exceeds-plane.sog": "has 1 x 1 px",
    "device-plane-name.sog": "has no 'NUL.webp'",
    "empty-count.sog": "count is 0",
    "escaping-plane-name.sog": r"'../scales.webp'; expected the name of a file in the same folder",
    "huge-bands.sog": r"shN.bands is 1e\+300",
    "huge-count.sog": r"count is 1e\+300",
    "huge-palette-count.sog": r"shN.count is 1e\+300",
    "huge-version.sog": r"version 1e\+300",
    "labels-out-of-range.sog": "use 2 centroids, but shN.count is 1",
    "lossy-plane.sog": "not a lossless WebP",
    "malformed-meta.sog": "not valid JSON",
    "missing-plane.sog": "has no 'scales.webp'",
    "no-meta.sog": "has no 'meta.json'",
    "not-sog.json": "unknown model format",
    "not-sog.sog": "damaged ZIP",
    "short-codebook.sog": "expected 256 numbers",
    "unbundled-missing-plane/meta.json": r"sh0.webp: cannot be read",
    "version-1.sog": "version None",
    "version-3.sog": "version 3",
    # SPZ
    "bad-crc-v2.spz": "incorrect data check",
    "bad-fhcrc-v2.spz": "header crc mismatch",
    "bad-isize-v2.spz": "incorrect length check",
    "corrupt-deflate.spz": "invalid block type",
    "count-exceeds-stream-v2.spz": "more than it can contain",
    "decode-nonfinite-v1.spz": "means have values that are not finite",
    "gzip-not-spz.spz": "not an SPZ file",
    "huge-count-v2.spz": "more than it can contain",
    "not-spz.spz": "expected an SPZ file",
    "plaintext-v4.spz": "expected 6 streams",
    "sh-degree-5-v2.spz": "SH degree 5",
    "short-stream.spz": "not an SPZ file",
    "trailing-after-member-v2.spz": "8 bytes after its gzip data",
    "trailing-decompressed-v2.spz": "data after its 1 splats",
    "truncated-deflate-v2.spz": "too short",
    "truncated-gzip-header.spz": "not an SPZ file",
    "truncated-payload-v2.spz": "too short",
    "version-0.spz": "version 0",
    "version-5.spz": "version 5",
}


@cache
def outcomes() -> dict[Path, SplatFile | str]:
    """The model, or the reason for refusing it, of each file but the pages about them."""
    roots = [data_set("splats") / name for name in FOLDERS]
    results: dict[Path, SplatFile | str] = {}
    for path in sorted(file for root in roots for file in root.rglob("*") if file.is_file() and file.suffix != ".md"):
        try:
            results[path] = read(path)
        except (DataError, ConfigError) as error:
            results[path] = str(error)
    return results


def test_each_file_is_read_or_refused_for_its_reason():
    refused = {path: found for path, found in outcomes().items() if isinstance(found, str)}
    unexpected = []
    for path, message in refused.items():
        words = REFUSED.get(path.name, REFUSED.get(f"{path.parent.name}/{path.name}"))
        if path.name.endswith(NO_MODEL):
            words = "unknown model format|can be written but not read"
        if words is None or not re.search(words, message):
            unexpected.append(message)
    assert not unexpected, "\n".join(unexpected)
    companions = sum(path.name.endswith(NO_MODEL) for path in refused)
    models = [found for found in outcomes().values() if not isinstance(found, str)]
    assert (len(outcomes()), len(models), len(refused) - companions, companions) == (121, 49, 53, 19)
    empty = {path.name for path, found in outcomes().items() if not isinstance(found, str) and not len(found)}
    assert empty == EMPTY


def test_models_have_the_numbers_that_their_makers_state():
    stated = {
        path: json.loads(path.read_bytes())["output"]
        for path in outcomes()
        if path.suffix == ".json" and "prov" in path.name
    }
    assert len(stated) == 6
    for path, output in stated.items():
        actual = outcomes()[path.with_name(output["file"])]
        assert isinstance(actual, SplatFile)
        assert (len(actual), actual.sh_degree) == (output["gaussian_count"], output["sh_degree"])


def golden(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a text file of OpenUSD."""
    matches = re.findall(r"(\w+) = \[(.*)\]", path.read_text("utf-8"))
    return {name: np.array([float(number) for number in re.findall(r"[-+.\w]+", text)]) for name, text in matches}


def test_values_are_those_of_the_golden_files():
    """In the axes of OpenUSD, y up and z back."""
    pairs = {
        path.with_name(path.name.removesuffix(".golden.usda")): golden(path)
        for path in outcomes()
        if path.suffix == ".usda"
    }
    assert len(pairs) == 3
    for path, expected in pairs.items():
        actual = outcomes()[path]
        assert isinstance(actual, SplatFile)
        p = flip_axes(actual.parameters)
        harmonics = np.concatenate([p["sh_base"], p["sh_rest"]], axis=1)
        values = {
            "positions": p["means"],
            "scales": np.exp(p["log_scales"]),
            "opacities": opacities(p["logit_opacity"]),
            "orientations": normalize_quats(p["quats"]),
            "sphericalHarmonicsCoefficients": harmonics,
        }
        for name, table in values.items():
            np.testing.assert_allclose(table.ravel(), expected[name], atol=2e-5, err_msg=f"{path.name}: {name}")


@pytest.mark.parametrize("ending", ["glb", "gltf"])
def test_khr_matrix_has_its_values_in_each_number_type(ending):
    """Fifteen parts; all but one have linear colors."""
    actual = outcomes()[data_set("splats") / "khr" / f"khr_conformance_matrix.{ending}"]
    assert isinstance(actual, SplatFile)
    p = flip_axes(actual.parameters)
    np.testing.assert_array_equal(p["means"], [[1, 2, 3]] * 15)
    np.testing.assert_allclose(np.abs(p["quats"]), [[0, 1, 0, 0]] * 15, atol=1e-6)
    alpha = np.sort(opacities(p["logit_opacity"])[:, 0])
    np.testing.assert_allclose(alpha, [0.25] * 14 + [0.75], atol=0.002)
    color = np.array([0.1, 0.2, 0.3]) * SH_C0 + 0.5
    linear = (p["sh_rest"] == 0).all(axis=1) & (np.abs(p["sh_base"] - [0.1, 0.2, 0.3]).max(axis=1) > 1e-6)
    assert linear.sum() == 11
    shown = p["sh_base"][linear] * SH_C0 + 0.5
    np.testing.assert_allclose(shown, [1.055 * color ** (1 / 2.4) - 0.055] * 11, atol=1e-5)
