"""Whole runs with rules and losses: their decisions, and bitwise resume and repetition."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from clsplat.scene.points import read_points_ply, write_points_ply
from tests.support.runs import train

pytestmark = pytest.mark.slow

PRUNE = "{type: prune_faint, opacity_below: 0.005}"
GAINFUL = "{type: clone, statistic: gain, gradient_above: 0.1, size_below: 0.1}"
SPARE = "{type: prune_redundant, error_rise: 0.1, views: 3}"


def test_run_resumes_and_repeats_bit_for_bit(tiny_scene, tmp_path):
    """With what no recipe has; test_recipes.py has the others."""
    settings = (
        "optimize.views_per_update=3",
        f"densify.rules=[{GAINFUL}, {SPARE}]",
        "optimize.checkpoint.keep=9",
        "optimize.log_every=5",
    )
    first = train(tiny_scene, tmp_path / "first", *settings)
    whole = (first.out / "point_cloud.ply").read_bytes()
    edits = first.records.read("densify")
    assert all(sum(edit["causes"][name] for edit in edits) > 20 for name in ("clone", "prune_redundant"))
    again = shutil.copytree(first.out, tmp_path / "again")
    for step in (30, 40, 50):
        (again / "checkpoints" / f"step_{step:06d}.npz").unlink()
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (again / name).unlink()
    resumed = train(tiny_scene, again, *settings, resume=True)
    assert (again / "point_cloud.ply").read_bytes() == whole
    assert resumed.records.read("densify") == edits


def test_parabolic_growth_ends_exactly_at_its_target(tiny_scene, tmp_path):
    """Every Gaussian may grow at each of the five edits, 10 to 30, of which the draws take as many as the curve has."""
    settings = [
        *(
            "optimize.steps=40",
            "init.source=random",
            "init.count=100",
            "densify.every=5",
            "densify.start=5",
            "densify.stop=31",
        ),
        *("densify.budget={type: parabola, gaussians: 300}", "optimize.evaluate.every=100", "reset_opacity.every=1000"),
        "densify.rules=[{type: clone, gradient_above: 1.0e-12, size_below: 100.0}, {type: grow_scored, views: 3}]",
    ]
    edits = train(tiny_scene, tmp_path / "run", *settings).records.read("densify")
    assert [edit["after"] for edit in edits] == [172, 228, 268, 292, 300]


def times(scene, factor, folder):
    """Copy a scene, with the same photographs, and convert it to other units of length."""
    shutil.copytree(scene, folder)
    for file in folder.glob("transforms_*.json"):
        data = json.loads(file.read_text())
        for frame in data["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] *= factor
            frame["transform_matrix"] = matrix.tolist()
        file.write_text(json.dumps(data))
    points = read_points_ply(folder / "points3d.ply")
    write_points_ply(folder / "points3d.ply", replace(points, positions=points.positions * np.float32(factor)))
    return folder


def test_mcmc_does_not_depend_on_the_unit_of_length(tiny_scene, tmp_path):
    """Within 0.02 dB, in ten times the units: rates, noise, penalties and sizes are shares of the scene's extent."""
    results = []
    for factor in (1, 10):
        scene = times(tiny_scene, factor, tmp_path / f"scene{factor}")
        settings = (
            *(f"model.near={0.2 * factor}", "optimize.steps=80", "densify.start=10", "densify.every=10"),
            *("densify.stop=60", "optimize.evaluate.every=1000", "densify.max_gaussians=4000"),
            *("add_noise.stop=60", "add_noise.opacity_below=0.6"),  # where the opacities of so short a run are
        )
        run = train(scene, tmp_path / f"run{factor}", *settings, pipeline="mcmc_7k")
        results.append(json.loads((run.out / "metrics.json").read_text())["test"]["1"]["psnr"])
    assert results[0] > 13
    assert results[1] == pytest.approx(results[0], abs=0.02)
