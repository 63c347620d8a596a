"""Runs that train a field with a hash grid: bits, files, and the recipe."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError, MemoryLimitError
from clsplat.nerf.shape import FieldShape
from clsplat.nerf.training import field_plan
from clsplat.pipeline.loading import load
from clsplat.stages.train_field import TrainField
from clsplat.training import archive
from tests.support.fields import PIPELINE, SHAPE, bits, resumed, train_single_threaded
from tests.support.runs import train

pytestmark = pytest.mark.slow

GRID = "grid: {levels: 3, coarsest: 4, finest: 24, entries: 1024, corner: [-2, -2, -2], side: 4}"
OWN = SHAPE.replace("skip: 0", f"skip: 0, degrees: 0, {GRID}")


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("pipelines") / "grid.yaml"
    file.write_text(PIPELINE.replace(SHAPE, OWN).replace("rate: 2.0e-3", "rate: 1.0e-2\n      epsilon: 1.0e-15"))
    return str(file)


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory, pipeline: str) -> Path:
    out = tmp_path_factory.mktemp("runs") / "grid"
    train(tiny_scene, out, pipeline=pipeline)
    return out


def test_grid_parameters_are_trained(finished):
    field = clsplat.load_field(finished)
    own = slice(field.shape.network_length, field.shape.network_length + field.shape.grid.parameter_count)
    moved = np.abs(field.parameters - field.shape.initial_parameters(0))[own]
    assert 0.05 < (moved > 1e-3).mean() < 0.95  # some lie where no sample is
    assert json.loads((finished / "metrics.json").read_text())["parameters"] == field.shape.parameter_count


def test_killed_grid_run_resumes_to_the_same_bits(finished, tiny_scene, tmp_path, pipeline):
    assert bits(resumed(finished, tiny_scene, tmp_path / "run", pipeline)) == bits(finished)


def test_grid_bits_do_not_depend_on_the_thread_count(finished, tiny_scene, tmp_path, pipeline):
    assert bits(train_single_threaded(tiny_scene, tmp_path / "run", pipeline)) == bits(finished)


def test_grid_file_gives_the_metrics_of_its_run(finished):
    recorded = json.loads((finished / "metrics.json").read_text())
    result = clsplat.evaluate(finished / "field.npz", downscales=[2])
    assert result["test"]["2"] == recorded["test"]["2"]


def test_file_whose_grid_has_another_shape_is_refused(finished, tmp_path):
    notes, arrays = archive.read(finished / "field.npz")
    notes["shape"]["grid"]["entries"] = 2048
    with (tmp_path / "field.npz").open("wb") as file:
        archive.write(file, notes, arrays.items())
    with pytest.raises(DataError, match=r"parameters are not \[\d+, 1\]"):
        clsplat.load_field(tmp_path / "field.npz")


@pytest.mark.parametrize("missing", ["grid.side", "grid.levels", "width"])
def test_file_without_a_key_of_its_shape_is_refused(finished, tmp_path, missing):
    """Defaults may change."""
    notes, arrays = archive.read(finished / "field.npz")
    own, _, key = missing.rpartition(".")
    del (notes["shape"][own] if own else notes["shape"])[key]
    with (tmp_path / "field.npz").open("wb") as file:
        archive.write(file, notes, arrays.items())
    with pytest.raises(DataError, match=rf"lacks {missing}; expected an intact file of the stage export_field"):
        clsplat.load_field(tmp_path / "field.npz")


def test_recipe_uses_a_grid_instead_of_sines():
    (stage, *_) = load("mip_grid").stages
    assert isinstance(stage, TrainField)
    assert stage.field.grid is not None
    assert stage.field.degrees == 0
    assert stage.field.grid.table[:, 3].max() == 1  # some levels are shared
    assert FieldShape.model_validate(stage.field.model_dump()) == stage.field


def test_too_large_field_is_refused_before_allocation(tiny_scene, pipeline):
    large = {"levels": 16, "coarsest": 2048, "finest": 4096, "entries": 1 << 22}
    changes = [f"train_field.field.grid.{name}={value}" for name, value in large.items()]
    limits = SimpleNamespace(memory=4 << 30, allocation=4 << 30)
    run = SimpleNamespace(
        scene=clsplat.read_scene(tiny_scene),
        photographs=SimpleNamespace(budget=1 << 30),
        device=SimpleNamespace(info=limits),
    )
    with pytest.raises(MemoryLimitError, match=r"4 tables of 1,024 MiB.*use fewer levels or entries of the grid"):
        load(pipeline, changes).stages[0].check_run(run)
    load(pipeline).stages[0].check_run(run)


def test_cube_no_photograph_shows_is_refused_before_allocation(tiny_scene, pipeline):
    scene = clsplat.read_scene(tiny_scene)
    for changes, fault in (
        (
            ["corner=[50, 50, 50]"],
            r"no training view sees its cube at depths from 0.5 to 9; it spans .* to \(54, 54, 54\).*",
        ),
        (["corner=[1.5, 1.5, 1.5]", "side=0.1"], r"none of the scene's [\d,]+ points is in its cube; it spans .*"),
    ):
        stage = load(pipeline, [f"train_field.field.grid.{change}" for change in changes]).stages[0]
        match = rf"{fault}, and the cameras of .*tiny look at .*; set `grid.corner`, `grid.side`"
        with pytest.raises(ConfigError, match=match):
            stage.check_run(SimpleNamespace(scene=scene))


def test_memory_plan_of_a_field_is_accurate(finished):
    """Pictures of the evaluation are not in it."""
    field = clsplat.load_field(finished).shape
    taken = json.loads((finished / "metrics.json").read_text())["device_memory"]
    assert 0.4 * taken < field_plan(field, 0).total_bytes < 1.5 * taken
