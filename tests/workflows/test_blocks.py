"""`clsplat blocks`: a scene is partitioned, its blocks are trained separately, and merged."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import clsplat
from clsplat.cli import app
from clsplat.core.errors import ClsplatError, ConfigError, DataError, EmptyRegionError
from clsplat.core.schedule import schedule_values
from clsplat.density.control import Box
from clsplat.pipeline.loading import load
from clsplat.scene.detect import read_scene
from clsplat.workflows import finetune
from tests.support.multiscale_scene import write_multiscale

pytestmark = pytest.mark.slow

COUNT = 3
SHORT = ("optimize.steps=12", "checkpoint.every=4", "optimize.log_every=6", "model.sh_degree=1")
MIP = ("model.world_filter={type: smoothing, variance: 0.2}", "model.screen_filter={type: mip, variance: 0.1}")
NEVER = 0.9  # share of a view's pixels: then views belong to the block where they stand, or to their best


def train(scene: Path, coarse: Path, out: Path, *overrides: str, **options) -> dict:
    return clsplat.train_in_blocks(scene, out, coarse=coarse, overrides=[*SHORT, *overrides], **options)


@pytest.fixture(scope="module")
def trained(tiny_scene: Path, few_steps: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A scene in three blocks; tests do not modify it."""
    out = tmp_path_factory.mktemp("blocks") / "out"
    return out, train(tiny_scene, few_steps, out, blocks=COUNT, min_coverage=NEVER)


def boxes(actual: dict) -> list:
    return [Box(**block["cell"]) for block in actual["blocks"]]


def by_owner(model: clsplat.Model, actual: dict) -> clsplat.Model:
    """A model with its Gaussians in the order of the blocks that own them."""
    held = np.stack([box.contains(model.means) for box in boxes(actual)])
    assert (held.sum(axis=0) == 1).all()
    return model[np.argsort(held.argmax(axis=0), kind="stable")]


def test_merged_model_equals_an_undivided_run_with_all_cameras(tiny_scene, few_steps, tmp_path):
    coarse = clsplat.load(few_steps)
    coarse.logit_opacity[::50] = -9  # in no view
    coarse.save(tmp_path / "coarse.ply")
    whole = train(tiny_scene, tmp_path / "coarse.ply", tmp_path / "whole", *MIP, blocks=1)
    parts = train(tiny_scene, tmp_path / "coarse.ply", tmp_path / "parts", *MIP, blocks=COUNT, min_coverage=0)
    assert [len(block["views"]) for block in parts["blocks"]] == [8] * COUNT
    assert [block["start"] for block in parts["blocks"]] == [whole["gaussians"]] * COUNT
    first, other = (clsplat.load(Path(found["run"]) / "point_cloud_raw.ply") for found in (whole, parts))
    for table, values in by_owner(first, parts).tables().items():
        np.testing.assert_array_equal(other.tables()[table], values)
    assert other.tables().keys() >= {"filter_variance"}
    assert (by_owner(coarse, parts).means != other.means[: len(coarse)]).any()  # they were trained


def test_crops_of_an_untrained_partition_are_the_coarse_model(trained, few_steps):
    out, actual = trained
    starts = [clsplat.load(out / f"block_{i:02d}.ply") for i in range(COUNT)]
    own = [start[box.contains(start.means)] for start, box in zip(starts, boxes(actual), strict=True)]
    assert [len(model) for model in own] == [block["gaussians"] for block in actual["blocks"]]
    whole = by_owner(clsplat.load(few_steps), actual)
    for table, values in whole.tables().items():
        np.testing.assert_array_equal(np.concatenate([model.tables()[table] for model in own]), values)


def test_every_camera_is_used_and_views_are_fewer_than_all(trained, tiny_scene):
    _, actual = trained
    names = [[view["name"] for view in block["views"]] for block in actual["blocks"]]
    train_views = [view.name for view in read_scene(tiny_scene).split("train")]
    assert set().union(*names) == set(train_views)
    assert min(map(len, names)) < len(train_views)


def test_block_trains_with_the_full_extent_and_grows_in_its_cell(trained, tiny_scene):
    out, actual = trained
    for block in actual["blocks"]:
        settings = load(str(out / block["name"] / "pipeline.yaml")).settings
        assert settings.scene.train.names == [view["name"] for view in block["views"]]
        assert settings.scene.extent == read_scene(tiny_scene).extent
        (densify,) = [stage for stage in settings.training.during if stage.stage == "densify"]
        assert densify.inside.model_dump() == block["growth"]
        model = clsplat.load(out / block["name"])
        assert boxes(actual)[int(block["name"][-2:])].contains(model.means).all()


@pytest.mark.parametrize("most", [16_000, "[[0, 15000], [8, 16000]]"])
def test_gaussian_limit_is_split_by_visible_pairs(most, tiny_scene, few_steps, tmp_path):
    """All blocks grow to their parts; many of the Gaussians outside are pruned meanwhile, and leave no room."""
    rules = "[{type: clone, gradient_above: 1.0e-7, size_below: 0.05}, {type: prune_faint, opacity_below: 0.11}]"
    grows = f"densify.rules={rules}", f"densify.max_gaussians={most}", "densify.every=4", "densify.start=3"
    result = train(tiny_scene, few_steps, tmp_path / "out", *grows, blocks=COUNT)
    assert 12_000 < result["metrics"]["gaussians"] <= 16_000
    for block in result["blocks"]:
        settings = load(str(tmp_path / "out" / block["name"] / "pipeline.yaml")).settings
        (densify,) = [stage for stage in settings.training.during if stage.stage == "densify"]
        assert max(schedule_values(densify.max_gaussians)) == pytest.approx(block["pairs"] * 16_000)


def test_merged_run_is_measured_with_all_views(trained):
    out, actual = trained
    assert Path(actual["run"]) == out / "merged"
    assert actual["metrics"] == json.loads((out / "merged" / "metrics.json").read_text())
    assert (actual["metrics"]["test"]["1"]["views"], actual["metrics"]["train"]["1"]["views"]) == (2, 8)
    merged = clsplat.load(out / "merged.ply").means
    parts = [clsplat.load(out / f"block_{i:02d}").means for i in range(COUNT)]
    np.testing.assert_array_equal(merged, np.concatenate(parts))
    np.testing.assert_array_equal(clsplat.load(out / "merged").means, merged)


def test_killed_and_missing_blocks_resume_with_equal_bits(trained, tiny_scene, few_steps, tmp_path):
    out = shutil.copytree(trained[0], tmp_path / "out")
    for name in ("metrics.json", "checksums.json", "point_cloud.ply", "checkpoints/step_000012.npz"):
        (out / "block_01" / name).unlink()
    shutil.rmtree(out / "block_02")
    shutil.rmtree(out / "merged")
    (out / "merged.ply").unlink()
    train(tiny_scene, few_steps, out, blocks=COUNT, min_coverage=NEVER)
    assert "resumed at step 8" in (out / "block_01" / "log.txt").read_text()
    assert (out / "merged.ply").read_bytes() == (trained[0] / "merged.ply").read_bytes()
    assert (out / "partition.json").read_bytes() == (trained[0] / "partition.json").read_bytes()


def test_folder_of_blocks_and_its_scene_can_move(trained, tiny_scene, few_steps, tmp_path):
    scene, out = tmp_path / "scene", tmp_path / "moved"
    shutil.copytree(tiny_scene, scene)
    shutil.copytree(trained[0], out)
    for name in ("metrics.json", "checksums.json", "point_cloud.ply", "checkpoints/step_000012.npz"):
        (out / "block_01" / name).unlink()
    train(scene, few_steps, out, blocks=COUNT, min_coverage=NEVER)
    assert "resumed at step 8" in (out / "block_01" / "log.txt").read_text()
    assert "resumed at step 12" in (out / "block_00" / "log.txt").read_text()
    for name in ("merged.ply", "merged/point_cloud.ply", "partition.json"):
        assert (out / name).read_bytes() == (trained[0] / name).read_bytes()


def test_finished_blocks_are_not_trained_again(trained, tiny_scene, few_steps, monkeypatch):
    monkeypatch.setattr("clsplat.workflows.finetune.run_pipeline", lambda *_: pytest.fail("a run begins"))
    again = train(tiny_scene, few_steps, trained[0], blocks=COUNT, min_coverage=NEVER)
    assert again == trained[1]


def test_failing_block_is_named_and_others_are_trained(tiny_scene, few_steps, tmp_path):
    (tmp_path / "out").mkdir()
    train(tiny_scene, few_steps, tmp_path / "out", blocks=COUNT, min_coverage=NEVER, only_plan=True)
    (tmp_path / "out" / "block_01").write_text("in the way")
    with pytest.raises(ClsplatError, match=r"1 of 3 blocks failed; the first, block_01: .*the same command") as caught:
        train(tiny_scene, few_steps, tmp_path / "out", blocks=COUNT, min_coverage=NEVER)
    assert caught.value.exit_code == 7
    assert [(tmp_path / "out" / f"block_{i:02d}" / "metrics.json").is_file() for i in (0, 2)] == [True] * 2
    assert not (tmp_path / "out" / "merged.ply").exists()


def test_block_with_only_damaged_checkpoints_restarts(trained, tiny_scene, few_steps, tmp_path, caplog):
    out = tmp_path / "out"
    shutil.copytree(trained[0], out)
    (out / "block_01" / "point_cloud.ply").unlink()
    for path in (out / "block_01" / "checkpoints").iterdir():
        path.write_bytes(b"damaged")
    train(tiny_scene, few_steps, out, blocks=COUNT, min_coverage=NEVER)
    assert "block_01: no checkpoint is intact; training starts over" in caplog.text
    assert (out / "merged.ply").read_bytes() == (trained[0] / "merged.ply").read_bytes()


def test_block_that_ends_empty_is_left_out(trained, tiny_scene, few_steps, tmp_path, monkeypatch, caplog):
    def empty(pipeline, folder, *options):
        if folder.name == "block_01":
            raise EmptyRegionError("crop: none lies inside")
        return finetune.train_in_folder(pipeline, folder, *options)

    out = tmp_path / "out"
    shutil.copytree(trained[0], out)
    monkeypatch.setattr("clsplat.workflows.blocks.train_in_folder", empty)
    train(tiny_scene, few_steps, out, blocks=COUNT, min_coverage=NEVER)
    assert "block_01: no Gaussians are left in its cell; continuing without it" in caplog.text
    parts = [clsplat.load(trained[0] / f"block_{i:02d}").means for i in (0, 2)]
    np.testing.assert_array_equal(clsplat.load(out / "merged").means, np.concatenate(parts))


def test_empty_box_is_reported_separately(few_steps, tiny_scene, tmp_path):
    file = tmp_path / "x.yaml"
    stages = [{"init": {"source": "model", "file": str(few_steps)}}, {"crop": {"inside": {"low": [99, 99, 99]}}}]
    file.write_text(json.dumps({"name": "x", "stages": stages}))
    with pytest.raises(EmptyRegionError):
        clsplat.run(file, tiny_scene, tmp_path / "out")


def test_blocks_from_a_store_equal_local_ones(tiny_scene, few_steps, tmp_path, monkeypatch):
    train(tiny_scene, few_steps, tmp_path / "here", blocks=2, min_coverage=NEVER)
    on, out, here = tmp_path / "lab.yaml", tmp_path / "out", []
    run = finetune.run_pipeline
    monkeypatch.setattr(finetune, "run_pipeline", lambda *words: here.append(words[1].out.name) or run(*words))
    on.write_text(f"engine: inline\nstore: '{tmp_path / 'store'}'\n")
    for _ in range(2):  # the second time all is done
        train(tiny_scene, few_steps, out, blocks=2, min_coverage=NEVER, on=on)
        assert here == ["merged"]
    assert (out / "merged.ply").read_bytes() == (tmp_path / "here" / "merged.ply").read_bytes()
    cells = clsplat.status(tmp_path / "store")["cells"]
    assert [(cell["name"], cell["state"]) for cell in cells] == [("block_00", "published"), ("block_01", "published")]
    on.write_text("engine: inline\n")
    with pytest.raises(ConfigError, match="--on: blocks need a store; add `store`"):
        train(tiny_scene, few_steps, out, blocks=2, min_coverage=NEVER, on=on)


def test_status_lists_every_block(trained, tmp_path):
    out = tmp_path / "out"
    assert clsplat.status(trained[0])["state"] == "done"
    shutil.copytree(trained[0], out)
    shutil.rmtree(out / "merged")
    (out / "block_02" / "status.json").write_text("{")
    result = CliRunner().invoke(app, ["status", str(out)])
    assert result.exit_code == 0, result.output
    first, *parts = result.stdout.splitlines()
    assert first.endswith("out: unfinished, 2 of 4 runs are done")
    messages = [Path(part.strip().split(" at ")[0].split(";")[0]).name for part in parts]
    assert messages == ["block_00: done", "block_01: done", "block_02: unknown", "merged: waiting"]
    (out / "blocks.json").write_text("[]")
    with pytest.raises(DataError, match=r"blocks.json: the number of blocks is missing; restore"):
        clsplat.status(out)


@pytest.mark.parametrize("damaged", ["block_01/point_cloud.ply", "block_01.ply", "partition.json", "block_02", None])
def test_check_finds_damaged_blocks(trained, tmp_path, damaged):
    out = tmp_path / "out"
    shutil.copytree(trained[0], out)
    if damaged == "block_02":
        shutil.rmtree(out / damaged)
    elif damaged:
        (out / damaged).write_bytes((out / damaged).read_bytes()[:-9])
    result = clsplat.check(out)
    assert [item["file"] for item in result["objects"] if not item["whole"]] == ([damaged] if damaged else [])
    assert len(result["objects"]) > 30
    shown = CliRunner().invoke(app, ["check", str(out)])
    assert f"clsplat blocks … --out {out}` again" in str(shown.exception) if damaged else shown.exit_code == 0


def test_steps_are_shared_by_views_with_compensating_rates(tiny_scene, few_steps, tmp_path):
    shared = {"blocks": 2, "min_coverage": NEVER, "steps": "shared"}
    result = train(tiny_scene, few_steps, tmp_path / "out", "optimize.steps=16", **shared)
    for block in result["blocks"]:
        folder, share = tmp_path / "out" / block["name"], len(block["views"]) / 8
        assert json.loads((folder / "metrics.json").read_text())["steps"] == 16 * share
        rates = load(str(folder / "pipeline.yaml")).settings.training.rates
        assert rates.log_scales == pytest.approx(4.0e-3 / share**0.5)
        assert rates.means.initial == pytest.approx(6.4e-5 / share**0.5)


def test_coarse_model_is_trained_if_none_is_given(tiny_scene, tmp_path):
    coarse = ("optimize.steps=6", "optimize.views.resolution=1")
    result = clsplat.train_in_blocks(
        tiny_scene, tmp_path / "out", blocks=2, coarse_overrides=coarse, overrides=SHORT, only_plan=True
    )
    assert result["run"] is None
    assert json.loads((tmp_path / "out" / "coarse" / "metrics.json").read_text())["steps"] == 6
    assert result["gaussians"] == len(clsplat.load(tmp_path / "out" / "coarse"))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "model.background={type: envmap}",
            "model.background cannot be used with blocks: each block would learn its own",
        ),
        ("model.time={degree: 1}", "model.time cannot be used with blocks: moving Gaussians leave their cells"),
        ("optimize.modules.exposure={}", "optimize.modules cannot be used with blocks: exposure would differ"),
        ("scene.validation=4", "scene.validation cannot be used with blocks: a block has no validation views"),
        (
            "densify.inside={low: [0, null, null]}",
            "densify.inside cannot be used with blocks: each block sets it; leave it out",
        ),
        (
            "densify.budget={type: parabola, gaussians: 900}",
            "densify.budget cannot be used with blocks: it limits the whole",
        ),
        ("init.source=random", "expected `init: {source: model}` first, and an 'optimize' stage"),
    ],
)
def test_settings_that_blocks_cannot_share_are_refused(override, message, tiny_scene, few_steps, tmp_path):
    with pytest.raises(ConfigError, match=message):
        train(tiny_scene, few_steps, tmp_path / "out", override)
    assert not (tmp_path / "out").exists()


def test_folder_without_a_coarse_model_is_refused(tiny_scene, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"empty: has no pipeline\.yaml; expected a model file or a run folder"):
        train(tiny_scene, tmp_path / "empty", tmp_path / "out")


def test_scene_of_several_sizes_is_refused(tiny_scene, few_steps, tmp_path):
    write_multiscale(tiny_scene, tmp_path / "scene", 2)
    with pytest.raises(DataError, match="has photos in several sizes; blocks need a single size"):
        train(tmp_path / "scene", few_steps, tmp_path / "out")


@pytest.mark.parametrize(("option", "value"), [("blocks", 0), ("min_coverage", 1.0), ("steps", "some")])
def test_options_out_of_bounds_are_refused(option, value, tiny_scene, few_steps, tmp_path):
    with pytest.raises(ConfigError, match=f"--{option.replace('_', '-')} "):
        train(tiny_scene, few_steps, tmp_path / "out", **{option: value})


def test_plan_by_points_needs_points(tiny_scene, tmp_path):
    shutil.copytree(tiny_scene, tmp_path / "scene")
    (tmp_path / "scene" / "points3d.ply").unlink()
    refused = CliRunner().invoke(app, ["inspect", str(tmp_path / "scene"), "--blocks", "2"])
    assert isinstance(refused.exception, DataError)
    assert "has no points to partition; `clsplat blocks --plan` trains a coarse model first" in str(refused.exception)


def test_inspect_shows_a_plan_by_the_points_before_training(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["inspect", str(tiny_scene), "--blocks", "2", "--json"])
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert [block["name"] for block in data["blocks"]] == ["block_00", "block_01"]
    assert data["gaussians"] == len(read_scene(tiny_scene).points)
    assert all(0 < low <= high for low, high in (block["seconds"] for block in data["blocks"]))
    assert not list(tmp_path.iterdir())


def test_command_shows_the_plan(tiny_scene, few_steps, tmp_path):
    arguments = ["blocks", "--scene", str(tiny_scene), "--coarse", str(few_steps), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*arguments, "--plan", "--blocks", "2"])
    assert result.exit_code == 0, result.output
    names = [line.split()[0] for line in result.stdout.splitlines() if "%" in line]
    assert names == ["block_00", "block_01", "scene"]
    assert "estimated time" in result.stdout
    assert all(re.search(r"\d min", line) for line in result.stdout.splitlines() if "%" in line)
    refused = CliRunner().invoke(app, [*arguments, "--plan", "--blocks", "3"])
    assert "has a scene in blocks with different blocks" in str(refused.exception)
