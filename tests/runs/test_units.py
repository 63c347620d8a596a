"""A scene in any unit of length gives the same model: the near plane and all other lengths scale with it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from clsplat import FieldModel, FieldRenderer, load_field
from clsplat import run as run_pipeline
from clsplat.api.commands import evaluate
from clsplat.core.errors import DataError
from clsplat.formats.splats import SplatFile, WriteOptions
from clsplat.formats.table import write
from clsplat.gaussians.model import Model, Rendering, load
from clsplat.nerf.shape import FieldShape
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.scene.detect import read_scene
from clsplat.scene.quality import near_plane
from clsplat.scene.scene import PointCloud, Scene, camera_extent
from clsplat.training import archive
from tests.support.commands import clsplat
from tests.support.models import splats
from tests.support.transforms_scene import scaled

FACTORS = 1e-4, 1e5
STEPS = "optimize.steps=50", "optimize.checkpoint.every=25", "optimize.checkpoint.keep=2"


@pytest.fixture(scope="module")
def runs(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[float, Path]:
    """Finished runs of a scene in several units of length, by its factor."""
    folder, runs = tmp_path_factory.mktemp("units"), dict[float, Path]()
    for factor in (1.0, *FACTORS):
        scene, runs[factor] = scaled(tiny_scene, folder / f"scene_{factor:g}", factor), folder / f"run_{factor:g}"
        settings = [part for setting in STEPS for part in ("--set", setting)]
        clsplat("run", "smoke", "--scene", scene, "--out", runs[factor], *settings)
    return runs


def trained_psnr(run: Path) -> float:
    return json.loads((run / "metrics.json").read_text())["test"]["1"]["psnr"]


def near_of(run: Path) -> float | str:
    return load_pipeline(str(run / "pipeline.yaml")).settings.model.near


@pytest.mark.slow
@pytest.mark.parametrize("factor", FACTORS)
def test_scene_trains_alike_in_any_unit_of_length(runs, factor):
    assert trained_psnr(runs[factor]) == pytest.approx(trained_psnr(runs[1]), abs=0.1)
    assert near_of(runs[factor]) == pytest.approx(factor * near_of(runs[1]), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, *FACTORS])
def test_file_of_another_program_is_drawn_in_any_unit(runs, factor, tmp_path):
    model = load(runs[factor])
    replace(model, rendering=Rendering()).save(tmp_path / "foreign.ply")
    assert not load(tmp_path / "foreign.ply").rendering.near
    metrics = evaluate(tmp_path / "foreign.ply", runs[factor].with_name(f"scene_{factor:g}"))
    assert metrics["test"]["1"]["psnr"] == pytest.approx(trained_psnr(runs[1]), abs=0.2)
    assert 0 < load(tmp_path / "foreign.ply").near < 0.1 * factor, "without a scene, by the size of the model"


@pytest.mark.slow
def test_resumed_run_keeps_its_near_plane(runs):
    run, file = runs[1], runs[1] / "pipeline.yaml"
    assert (
        "up to date"
        in clsplat(
            "run",
            "smoke",
            "--scene",
            run.with_name("scene_1"),
            "--out",
            run,
            "--resume",
            *(part for setting in STEPS for part in ("--set", setting)),
        ).stdout
    )
    number = near_of(run)
    assert f"near: {number}" in file.read_text()
    clsplat("resume", run, "--steps", "60")
    assert near_of(run) == number


def test_near_plane_is_a_fraction_of_the_scene(tiny_scene):
    scene = read_scene(tiny_scene)
    assert near_plane(replace(scene, points=None)) == pytest.approx(0.04 * scene.extent, rel=0.005)
    view = scene.split("train")[0]
    close = view.position + 0.1 * view.world_to_camera[2, :3]
    points = PointCloud(np.tile(close, (99, 1)).astype(np.float32), np.zeros((99, 3), np.float32))
    assert near_plane(replace(scene, points=points)) == pytest.approx(0.05, rel=0.01), "half of where points begin"


@pytest.mark.parametrize("factor", [1e-4, 1.0, 1e5])
def test_cameras_with_one_center_have_an_extent(tiny_scene, factor):
    def extent(scene: Scene, count: int, *, with_points: bool) -> float:
        views = [replace(view, world_to_camera=view.world_to_camera * [1, 1, 1, factor]) for view in scene.views[:1]]
        points = scene.points.positions.astype(float) * factor if with_points and scene.points else None
        return camera_extent(views * count, points)

    scene = read_scene(tiny_scene)
    assert extent(scene, 2, with_points=True) == extent(scene, 1, with_points=True)
    assert extent(scene, 1, with_points=True) / factor == pytest.approx(3.8, rel=0.1), "the distance of the points"
    assert extent(scene, 1, with_points=False) / factor == pytest.approx(3.8, rel=0.1), "the depth of zero"


FIELD = {"steps": 8, "rays": 128, "photographs": 4, "warm_up": 0, "rate": 0.01, "epsilon": 1e-15}
SHAPE = {"near": 0.5, "far": 9, "coarse_samples": 16, "fine_samples": 16, "depth": 1, "width": 32, "skip": None}
GRID = {"levels": 3, "coarsest": 4, "finest": 24, "entries": 1024, "corner": [-2, -2, -2], "side": 4}
FIELD_STAGES = [
    {"train_field": {**FIELD, "field": {**SHAPE, "grid": GRID}}},
    "export_field",
    {"evaluate": {"split": "test"}},
]


def unit_of(scene: Scene) -> float | str:
    return FieldShape().with_unit(scene).unit


@pytest.mark.slow
def test_field_trains_alike_in_any_unit_of_length(tiny_scene, tmp_path):
    fields, pictures, pipeline = {}, {}, tmp_path / "field.yaml"
    pipeline.write_text(json.dumps({"name": "field", "stages": FIELD_STAGES}))
    for factor in (1.0, *FACTORS):
        folder, run = scaled(tiny_scene, tmp_path / f"scene_{factor:g}", factor), tmp_path / f"run_{factor:g}"
        run_pipeline(pipeline, folder, run)
        scene, fields[factor] = read_scene(folder), load_field(run)
        written = load_pipeline(str(run / "pipeline.yaml")).stages[0].field
        assert fields[factor].shape.unit == written.unit == written.unit_auto == unit_of(scene)
        pictures[factor] = FieldRenderer(fields[factor]).render(scene.split("test")[0], depth=True)
    for factor in FACTORS:
        assert fields[factor].shape.unit == pytest.approx(factor * fields[1].shape.unit, rel=0.01)
        assert trained_psnr(tmp_path / f"run_{factor:g}") == pytest.approx(trained_psnr(tmp_path / "run_1"), abs=0.1)
        np.testing.assert_allclose(pictures[factor].depth / factor, pictures[1].depth, rtol=0.02)


def test_field_has_the_unit_of_its_scene(tiny_scene):
    scene = read_scene(tiny_scene)
    assert FieldShape(unit=3.0).with_unit(scene).unit == 3
    turning = [replace(view, world_to_camera=view.world_to_camera * [1, 1, 1, 0]) for view in scene.views]
    assert unit_of(replace(scene, views=tuple(turning), extent=8.06)) == 2, "cameras that only turn"


@pytest.mark.parametrize("unit", [0, -1.0, float("nan"), float("inf"), 1e-20, "meters", None])
def test_invalid_unit_of_a_field_is_refused(unit):
    with pytest.raises(ValidationError, match="expected 'auto' or a length from 1e-15 to 1e"):
        FieldShape(unit=unit)


def test_field_file_without_a_unit_is_in_scene_units(tmp_path):
    shape = FieldShape(unit=2.0, depth=1, skip=None, width=4, color_width=4, degrees=1)
    FieldModel(shape, np.zeros(shape.table_length, np.float32), Rendering()).save(tmp_path / "new.npz")
    assert load_field(tmp_path / "new.npz").shape == shape
    notes, arrays = archive.read(tmp_path / "new.npz")
    old = {key: value for key, value in notes["shape"].items() if not key.startswith("unit")}
    for name, written in (("old", old), ("auto", {**old, "unit": "auto"})):
        with (tmp_path / f"{name}.npz").open("wb") as file:
            archive.write(file, {**notes, "shape": written}, arrays.items())
    assert load_field(tmp_path / "old.npz").shape.unit == 1
    with pytest.raises(DataError, match="unit 'auto' instead of a number"):
        load_field(tmp_path / "auto.npz")
    with pytest.raises(ValueError, match=r"'auto'; use FieldShape\.with_unit"):
        FieldModel(FieldShape(), np.zeros(FieldShape().table_length, np.float32), Rendering())


@pytest.mark.parametrize("name", ["a.spz", "a.sog", "a.glb", "a.splat"])
def test_files_hold_positions_in_small_units(rng, tmp_path, name):
    parameters = splats(rng, 200).parameters
    means, log_scales = parameters["means"] * np.float32(1e-4), parameters["log_scales"] + np.float32(np.log(1e-4))
    source = SplatFile({**parameters, "means": means, "log_scales": log_scales}, {}, "default")
    write(tmp_path / name, source, WriteOptions(quiet=True))
    distances = np.linalg.norm(means[:, None] - load(tmp_path / name).means, axis=2).min(axis=1)
    assert distances.max() < 5e-6


def test_a_view_in_which_nothing_is_drawn_is_reported(tiny_scene, tmp_path, rng, caplog):
    model = Model(**splats(rng, 50).parameters)
    for distance, reported in ((0, False), (500, True)):
        replace(model, means=model.means + np.float32(distance)).save(tmp_path / "a.ply")
        caplog.clear()
        evaluate(tmp_path / "a.ply", tiny_scene)
        assert ("almost nothing is rendered in 2 of 2 views" in caplog.text) is reported
