"""Whole runs with changing weights, penalties, and split rules: bits, resume, and the report."""

import json
import re
import shutil

import numpy as np
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.formats.table import read as read_ply
from clsplat.metrics.views import QUANTILES, distribution
from clsplat.viewer.charts import Line, line_chart
from tests.support.runs import train

pytestmark = pytest.mark.slow

PENALTY = "{type: covariance_trace, weight: 0.5, pixels: 1.0}"
LOSSES = f"optimize.losses=[{{type: l1, weight: [[10, 0.8], [40, 0.4]]}}, {{type: l2, weight: 2.0}}, {PENALTY}]"
RULES = (
    "densify.rules=[{type: clone}, {type: split_textured, texture_above: {quantile: 0.5, of: pixels}, "
    "gradient_above: 0.0, radius_above: 0.5}, {type: split_oversized, pixels: 1.5, radius_above: 0.5}, "
    "{type: merge_neighbors}, {type: prune_unimportant, share: 0.01}]"
)
PLAIN = ("densify.rules=[{type: prune_faint}]", "optimize.steps=20")
SETTINGS = (LOSSES, RULES, "optimize.log_every=5", "optimize.checkpoint.keep=9")


@pytest.fixture(scope="module")
def finished(tiny_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("micro") / "run"
    return train(tiny_scene, out, *SETTINGS)


def test_every_rule_and_penalty_has_an_effect(finished):
    lines = [json.loads(line) for line in (finished.out / "metrics.jsonl").read_text().splitlines()]
    edits = [line for line in lines if line["kind"] == "densify"]
    growing, thinning = ("clone", "split_textured", "split_oversized"), ("merge_neighbors", "prune_unimportant")
    for name in (*growing, *thinning):
        total, grown = (sum(edit[key][name] for edit in edits) for key in ("causes", "grown"))
        assert total > 0, name
        assert 0 < grown <= total if name in growing else grown == 0, name
    actual = [line for line in lines if line["kind"] == "distribution"]
    assert actual[-1]["step"] == 50
    assert all(len(line["anisotropy"]) == len(QUANTILES) for line in actual)
    page = (finished.out / "report.html").read_text()
    assert "anisotropy" in page
    assert re.search("changed by each rule.*split_oversized", page)
    matches = re.findall(r"<figcaption>(\S+) ", page)
    assert len(matches) == len(set(matches)) > 0, "a view is shown twice"


def test_legends_stay_below_the_title_and_break_into_rows():
    names = ["clone", "split_textured", "split_oversized", "prune_unimportant", "merge_neighbors", "prune_faint"]
    chart = line_chart("Gaussians changed by each rule", [Line([(0.0, 0.0), (1.0, 1.0)], name) for name in names])
    rows = re.findall(r'<text x="56" y="(\d+)">(<tspan.*?)</text>', chart)
    assert [y for y, _ in rows] == ["29", "43"]
    assert re.findall(r">(\w+)</tspan>", "".join(row for _, row in rows)) == names
    assert "<tspan" not in line_chart("loss", [Line([(0.0, 0.0), (1.0, 1.0)], "alone")])


def test_narrow_logarithmic_axis_has_tick_labels():
    chart = line_chart("anisotropy", [Line([(0.0, 1.05), (1.0, 1.7)])], logarithmic=True)
    assert re.findall(r'text-anchor="end">([\d.]+)<', chart) == ["1.2", "1.4", "1.6"]


def test_resumed_run_has_the_same_bits(finished, tiny_scene, tmp_path):
    whole = (finished.out / "point_cloud.ply").read_bytes()
    again = shutil.copytree(finished.out, tmp_path / "again")
    for step in (30, 40, 50):
        (again / "checkpoints" / f"step_{step:06d}.npz").unlink()
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (again / name).unlink()
    assert (again / "checkpoints" / "step_000020.npz").exists()
    resumed = train(tiny_scene, tmp_path / "again", *SETTINGS, resume=True)
    assert (resumed.out / "point_cloud.ply").read_bytes() == whole
    assert resumed.records.read("densify") == finished.records.read("densify")


@pytest.fixture(scope="module")
def without_penalty(tiny_scene, tmp_path_factory):
    return train(tiny_scene, tmp_path_factory.mktemp("micro") / "none", "optimize.losses=[l1]", *PLAIN).out


@pytest.mark.parametrize("penalty", ["{type: covariance_trace, above: 0.0", "{type: anisotropy, above: 1.0"])
def test_penalties_move_gaussians(tiny_scene, tmp_path, without_penalty, penalty):
    """A heavy one shrinks what it is about; without weight the run is the same without it."""
    runs, measured = {"none": without_penalty}, {}
    for name, weight in (("zero", 0.0), ("heavy", 1000.0)):
        settings = f"optimize.losses=[l1, {penalty}, weight: {weight}}}]"
        runs[name] = train(tiny_scene, tmp_path / name, settings, *PLAIN).out
    for name, out in runs.items():
        scales = np.exp(read_ply(out / "point_cloud.ply").parameters["log_scales"].astype(np.float64))
        measured[name] = np.median((scales**2).sum(axis=1) if "trace" in penalty else np.ptp(np.log(scales), axis=1))
    assert measured["zero"] == pytest.approx(measured["none"], rel=1e-3)
    assert measured["heavy"] < 0.5 * measured["none"]


def test_ramp_of_weights_needs_no_more_memory(finished, tiny_scene, tmp_path):
    steady = LOSSES.replace("[[10, 0.8], [40, 0.4]]", "0.8")
    run = train(tiny_scene, tmp_path / "run", steady, *SETTINGS[1:])
    assert finished.rasterizer.workspace._arrays.keys() == run.rasterizer.workspace._arrays.keys()


def test_distribution_of_known_gaussians(device, rng):
    case = random_case(rng, 5)
    case.parameters["log_scales"][:] = np.log([[1, 1, 1], [1, 1, 2], [1, 1, 3], [1, 1, 4], [1, 1, 5]])
    case.parameters["logit_opacity"][:] = 0
    result = distribution(case.model(device).gaussians)
    np.testing.assert_allclose(result["anisotropy"], np.quantile([1, 2, 3, 4, 5], QUANTILES), rtol=1e-6)
    np.testing.assert_allclose(result["size"][2], np.sqrt(11 / 3), rtol=1e-6)
    assert result["opacity"] == [0.5] * 5
