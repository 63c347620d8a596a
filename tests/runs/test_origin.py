"""A scene in world coordinates: a run and its files keep the origin."""

import json
from pathlib import Path

import numpy as np
import pytest

from clsplat.api.commands import convert, evaluate, view
from clsplat.api.rendering import render_path
from clsplat.core.errors import ConfigError
from clsplat.formats.ply import MAX_HEADER, parse_ply_header
from clsplat.gaussians.model import Model, load
from clsplat.scene.images import read_image
from tests.support.runs import train
from tests.support.transforms_scene import write_shifted

ORIGIN = np.array([500_000.0, 4_500_000, 100])
STAGES = """\
name: few
scene: {holdout: 4}
stages:
  - init
  - optimize: {steps: 4, losses: [{type: l1}]}
  - crop: {inside: {low: [null, null, null]}}
  - export
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run of a scene, and one of the same scene in world coordinates."""
    folder = tmp_path_factory.mktemp("origin")
    (folder / "few.yaml").write_text(STAGES)
    for name, shift in (("local", 0.0), ("world", ORIGIN)):
        write_shifted(folder / f"{name}_scene", shift)
        train(folder / f"{name}_scene", folder / name, pipeline=str(folder / "few.yaml"))
    return folder


def psnr(model, folder):
    return evaluate(model, folder / "world_scene")["train"]["1"]["psnr"]


def test_run_equals_its_local_twin_and_names_the_origin(runs):
    local, world = (load(runs / name) for name in ("local", "world"))
    for name, table in local.tables().items():
        np.testing.assert_array_equal(table, world.tables()[name])
    np.testing.assert_array_equal(world.origin, ORIGIN)
    data = (runs / "world" / "point_cloud.ply").read_bytes()
    comments = parse_ply_header(runs, data[:MAX_HEADER]).comments
    assert json.loads(comments[0].removeprefix("clsplat "))["origin"] == ORIGIN.tolist()
    assert b"origin" not in (runs / "local" / "point_cloud.ply").read_bytes()
    assert json.loads((runs / "world" / "metrics.json").read_text())["origin"] == ORIGIN.tolist()


@pytest.mark.parametrize("name", ["a.ply", "a.glb", "a.splat", "world.ply"])
def test_file_is_evaluated_at_the_scene_origin(runs, tmp_path, name):
    convert(runs / "world", tmp_path / name, world=name == "world.ply")
    assert psnr(tmp_path / name, runs) == pytest.approx(
        psnr(runs / "world", runs), abs=0.5 if "splat" in name else 1e-3
    )


def test_world_coordinates_need_doubles(runs, tmp_path):
    convert(runs / "world", tmp_path / "a.ply", world=True)
    data = (tmp_path / "a.ply").read_bytes()
    header = parse_ply_header(tmp_path, data)
    rows = np.frombuffer(data, header.dtype, header.count, header.start)
    result, expected = np.stack([rows[axis] for axis in "xyz"], axis=1), load(runs / "world").means + ORIGIN
    np.testing.assert_array_equal(result, expected)
    with pytest.raises(
        ConfigError, match=r"a\.spz: world coordinates around \(500000, 4500000, 100\) exceed the precision"
    ):
        convert(runs / "world", tmp_path / "a.spz", world=True)


def test_boxes_are_in_world_coordinates(runs, tmp_path):
    x = float(np.sort(load(runs / "world").means[:, 0])[1] + ORIGIN[0]) + 1e-3
    box = [*(ORIGIN - 9), x, *(ORIGIN[1:] + 9)]
    assert convert(runs / "world", tmp_path / "a.ply", crop=box)["gaussians"] == 2
    values = f"crop.inside.high=[{x},null,null]", "init.source=model", f"init.file={runs / 'world'}", "optimize.steps=1"
    train(runs / "world_scene", tmp_path / "run", *values, pipeline=str(runs / "few.yaml"))
    assert len(load(tmp_path / "run")) == 2


def test_merged_models_have_one_origin(runs, tmp_path):
    pipeline = load(runs / "world")
    moved = pipeline.with_origin(ORIGIN + np.array([1, 2, 3]))
    moved.save(tmp_path / "moved.ply")
    convert([runs / "world", tmp_path / "moved.ply"], tmp_path / "both.ply")
    both = load(tmp_path / "both.ply")
    np.testing.assert_allclose(both.means[: len(pipeline)], both.means[len(pipeline) :], atol=1e-6)
    np.testing.assert_array_equal(both.origin, ORIGIN)


def test_camera_path_is_in_world_coordinates(runs, tmp_path):
    pictures = {}
    for name, origin in (("local", np.zeros(3)), ("world", ORIGIN)):
        pose = np.eye(4)
        pose[:3, 3] = origin + np.array([0, 0, 3])
        frames = [{"camera_to_world": pose.ravel().tolist(), "fov": 60}]
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"camera_path": frames, "render_width": 64, "render_height": 48}))
        result = render_path(runs / name, video=None, out=tmp_path / name, path=str(path))
        pictures[name] = [read_image(Path(file)) for file in result["files"]]
    np.testing.assert_array_equal(pictures["local"], pictures["world"])
    assert np.std(pictures["world"]) > 1


def test_page_names_the_origin(runs, tmp_path):
    page = view(runs / "world", runs / "local", out=tmp_path / "a.html").read_text()
    assert "(500000, 4500000, 100)" in page


def test_foreign_floats_in_world_coordinates_get_an_origin(runs, tmp_path, caplog):
    first = load(runs / "world")
    Model(**{**first.tables(), "means": first.means + ORIGIN}).save(tmp_path / "a.ply")
    pipeline = load(tmp_path / "a.ply")
    assert np.abs(pipeline.means).max() < 100
    np.testing.assert_allclose(pipeline.means + pipeline.origin, first.means + ORIGIN, atol=0.3)
