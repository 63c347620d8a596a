"""`clsplat lod`: levels are merged, trained, measured, and written; invalid input is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import clsplat
from clsplat.api.commands import evaluate
from clsplat.cli import app
from clsplat.core.errors import ConfigError, DataError, Interrupted, OutputError
from clsplat.formats.table import model_bytes, read
from clsplat.gaussians.sky import Sky
from clsplat.runs import runner
from clsplat.workflows import lod
from clsplat.workflows.lod import LodPlan, decimate, format_table
from tests.support.runs import NO_PROCESS

pytestmark = pytest.mark.slow

STEPS = 20


@pytest.fixture(scope="module")
def trained(few_steps: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Three levels of a run's model, the coarser two trained."""
    folder = tmp_path_factory.mktemp("lod") / "site"
    return folder, clsplat.write_levels(few_steps, folder, levels=3, steps=STEPS)


def tree(folder: Path) -> dict[Path, bytes]:
    return {file.relative_to(folder): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def test_levels_are_trained_and_measured(trained, few_steps, tiny_scene):
    folder, actual = trained
    whole = len(read(few_steps / "point_cloud.ply"))
    counts = [level["gaussians"] for level in actual["levels"]]
    assert counts == [whole, (whole + 1) // 2, ((whole + 1) // 2 + 1) // 2]
    assert json.loads((folder / "lod-meta.json").read_text())["counts"] == counts
    training = folder.with_name("site.training")
    for number in (1, 2):
        for file, key in ((f"level_{number}.ply", "merged_psnr"), (f"level_{number}/point_cloud.ply", "psnr")):
            measured = evaluate(training / file, tiny_scene)["test"]["1"]["psnr"]
            assert actual["levels"][number][key] == pytest.approx(measured, abs=1e-9)
        assert json.loads((training / f"level_{number}" / "metrics.json").read_text())["steps"] == STEPS
        assert "\nname: lod\n" in (training / f"level_{number}" / "pipeline.yaml").read_text()
    first = actual["levels"][0]
    assert first["psnr"] == first["merged_psnr"] == evaluate(few_steps)["test"]["1"]["psnr"]


def test_numbers_are_formatted_as_in_other_commands(monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(lod, "decimate", lambda model, keep: range(1200))
    lod._decimate_repeatedly(range(2400), LodPlan(levels=2), None)
    assert "level 1: 1,200 Gaussians" in caplog.text


def test_each_level_is_merged_from_the_previous_trained_one(trained):
    training = trained[0].with_name("site.training")
    expected = decimate(clsplat.load(training / "level_1" / "point_cloud.ply"))
    np.testing.assert_array_equal(clsplat.load(training / "level_2.ply").means, expected.means)


def test_sizes_match_the_files(trained):
    folder, actual = trained
    assert actual["bytes"] == model_bytes(folder) == sum(map(len, tree(folder).values()))
    meta = (folder / "lod-meta.json").stat().st_size
    assert sum(level["bytes"] for level in actual["levels"]) == actual["bytes"] - meta


def test_sky_goes_with_the_levels(few_steps, tmp_path, rng, caplog):
    sky = Sky(rng.random((64, 3), np.float32))
    replace(clsplat.load(few_steps), sky=sky).save(tmp_path / "model.ply")
    caplog.set_level("INFO")
    clsplat.write_levels(tmp_path / "model.ply", tmp_path / "site", levels=2)
    np.testing.assert_array_equal(clsplat.load(tmp_path / "site").sky.texels, sky.texels)
    assert "the sky of the finest level is in lod-meta_sky.json" in caplog.text


def test_written_level_0_is_a_model(trained, few_steps, tiny_scene):
    folder, actual = trained
    psnr = evaluate(folder, tiny_scene)["test"]["1"]["psnr"]
    assert psnr == pytest.approx(actual["levels"][0]["psnr"], abs=1)


def test_model_file_is_merged_without_a_device(few_steps, tmp_path, monkeypatch):
    def opens(device):
        raise AssertionError("a device is opened")

    monkeypatch.setattr("clsplat.runs.model_file.open_verified", opens)
    file = tmp_path / "model.ply"
    file.write_bytes((few_steps / "point_cloud.ply").read_bytes())
    result = clsplat.write_levels(file, tmp_path / "site", levels=2, keep=0.3)
    whole = len(read(file))
    assert [level["gaussians"] for level in result["levels"]] == [whole, int(0.3 * whole + 0.5)]
    assert result["split"] is None
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["model.ply", "site"]
    assert format_table(result).splitlines()[0].split() == ["level", "Gaussians", "MB"]


@pytest.fixture
def model_file(few_steps: Path, tmp_path: Path) -> Path:
    """A model file with unknown photographs."""
    file = tmp_path / "model.ply"
    file.write_bytes((few_steps / "point_cloud.ply").read_bytes())
    return file


def test_merging_without_training_is_reported(model_file, tmp_path):
    result = CliRunner().invoke(app, ["lod", str(model_file), str(tmp_path / "site"), "--steps", "0"])
    assert result.exit_code == 0, result.output
    assert "model.ply: its photos are unknown, so levels are merged without training" in result.output


@pytest.mark.parametrize("option", ["steps", "downscale", "device"])
def test_options_that_need_photographs_are_refused_without_them(option, model_file, tmp_path):
    message = rf"model\.ply: its photos are unknown, so --{option} cannot be used; pass --scene, or omit --{option}$"
    with pytest.raises(ConfigError, match=message):
        clsplat.write_levels(model_file, tmp_path / "site", **{option: STEPS})
    assert [path.name for path in tmp_path.iterdir()] == ["model.ply"]


@pytest.fixture
def moved(few_steps: Path, tiny_scene: Path, tmp_path: Path) -> Path:
    """A run whose photographs have moved."""
    run = tmp_path / "run"
    shutil.copytree(few_steps, run)
    settings = (run / "pipeline.yaml").read_text()
    (run / "pipeline.yaml").write_text(settings.replace(str(tiny_scene), str(tmp_path / "gone")))
    return run


@pytest.mark.parametrize("there", [False, True])
def test_zero_steps_need_no_photographs(there, moved, tmp_path, caplog):
    if there:
        (tmp_path / "gone").mkdir()
    result = clsplat.write_levels(moved, tmp_path / "site", levels=2, steps=0)
    assert (len(result["levels"]), result["split"]) == (2, None)
    assert "levels are merged without training, and are not evaluated" in caplog.text


def test_device_is_refused_if_the_photographs_have_moved(moved, tmp_path):
    message = r"run: its photos cannot be read, so --device cannot be used; pass --scene, or omit --device$"
    with pytest.raises(ConfigError, match=message):
        clsplat.write_levels(moved, tmp_path / "site", levels=2, steps=0, device="nosuch")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_missing_photographs_are_refused_with_a_remedy(moved, tmp_path):
    with pytest.raises(
        DataError, match=r"gone, is missing; .* \(pass --scene DIR, or --steps 0 to merge without photos\)$"
    ):
        clsplat.write_levels(moved, tmp_path / "site")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_damaged_model_is_reported(few_steps, tmp_path):
    shutil.copytree(few_steps, tmp_path / "run")
    (tmp_path / "run" / "point_cloud.ply").write_bytes(b"")
    with pytest.raises(DataError, match=r"point_cloud\.ply: .*[^)]$"):
        clsplat.write_levels(tmp_path / "run", tmp_path / "site")


def test_one_level_is_not_trained(few_steps, tmp_path):
    clsplat.write_levels(few_steps, tmp_path / "site", levels=1)
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


@pytest.mark.parametrize(("name", "steps"), [("file/site", 0), ("n" * 245, STEPS)])
def test_unwritable_path_is_refused_before_the_work(name, steps, few_steps, tmp_path, monkeypatch):
    def works(*_):
        raise AssertionError("the work begins")

    monkeypatch.setattr("clsplat.workflows.lod.decimate", works)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot be written"):
        clsplat.write_levels(few_steps, tmp_path / name, steps=steps)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_leftovers_of_a_killed_process_are_removed(model_file, tmp_path):
    for name in (f".site.{NO_PROCESS}-0.partial", f".other.{NO_PROCESS}-0.partial"):
        (tmp_path / name / "0_0").mkdir(parents=True)
    clsplat.write_levels(model_file, tmp_path / "site", levels=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f".other.{NO_PROCESS}-0.partial", "model.ply", "site"]


def interrupted(pipeline, run, run_stages=runner.run_stages):
    run.interrupted = True
    run_stages(pipeline, run)


def test_interrupted_training_resumes(few_steps, tmp_path, monkeypatch, trained):
    run_stages = runner.run_stages
    monkeypatch.setattr(runner, "run_stages", interrupted)
    with pytest.raises(Interrupted, match=r"^stopped in level_1; run the same command again to resume$"):
        clsplat.write_levels(few_steps, tmp_path / "site", levels=3, steps=STEPS)
    assert not (tmp_path / "site").exists()
    monkeypatch.setattr(runner, "run_stages", run_stages)
    with pytest.raises(ConfigError, match=r"site\.training: has the training of levels with different steps"):
        clsplat.write_levels(few_steps, tmp_path / "site", levels=3, steps=STEPS + 1)
    clsplat.write_levels(few_steps, tmp_path / "site", levels=3, steps=STEPS)
    assert tree(tmp_path / "site") == tree(trained[0])


def test_training_does_not_resume_with_other_photographs(few_steps, tiny_scene, tmp_path, monkeypatch):
    shutil.copytree(tiny_scene, tmp_path / "scene")
    ask = {"folder": tmp_path / "site", "scene": tmp_path / "scene", "levels": 2, "steps": STEPS}
    monkeypatch.setattr(runner, "run_stages", interrupted)
    with pytest.raises(Interrupted):
        clsplat.write_levels(few_steps, **ask)
    first, second, *_ = sorted((tmp_path / "scene" / "train").iterdir())
    second.write_bytes(first.read_bytes())
    with pytest.raises(ConfigError, match=r"the training of levels with different photographs"):
        clsplat.write_levels(few_steps, **ask)


def test_folder_of_levels_is_a_model(trained, tiny_scene, tmp_path):
    """With a scene, like any model file."""
    result = clsplat.write_levels(trained[0], tmp_path / "site", tiny_scene, levels=2, steps=STEPS)
    assert result["levels"][0]["gaussians"] == trained[1]["levels"][0]["gaussians"]


def test_photographs_have_the_requested_size(few_steps, tmp_path):
    clsplat.write_levels(few_steps, tmp_path / "site", levels=2, steps=STEPS, downscale=2)
    assert "20x20 px" in (tmp_path / "site.training" / "level_1" / "log.txt").read_text()


def test_zero_steps_only_measure_the_levels(few_steps, tmp_path):
    result = clsplat.write_levels(few_steps, tmp_path / "site", levels=2, steps=0)
    assert result["levels"][1]["psnr"] == result["levels"][1]["merged_psnr"]
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ({"levels": 0}, r"--levels 0: expected 1 to 12$"),
        ({"levels": 13}, r"--levels 13: expected 1 to 12$"),
        ({"keep": 0.0}, "--keep 0: expected a fraction"),
        ({"keep": 1.0}, "--keep 1: expected a fraction"),
        ({"keep": float("nan")}, "--keep nan: expected a fraction"),
        ({"steps": -1}, "--steps -1: expected at least 20"),
        ({"downscale": 0.5}, "--downscale 0.5: expected a divisor"),
        ({"downscale": 2.0, "steps": 0}, "--downscale 2: needs training; set --steps above 0"),
    ],
)
def test_invalid_plan_is_refused(plan, message):
    with pytest.raises(ConfigError, match=message):
        LodPlan(**plan)


def test_empty_model_and_a_folder_in_use_are_refused(few_steps, tmp_path):
    model = clsplat.load(few_steps)
    model[:0].save(tmp_path / "empty.ply")
    with pytest.raises(DataError, match=r"empty\.ply: the model has no Gaussians to merge"):
        clsplat.write_levels(tmp_path / "empty.ply", tmp_path / "site")
    with pytest.raises(ConfigError, match="already exists; use a new folder"):
        clsplat.write_levels(few_steps, tmp_path)


def test_command_prints_a_table_and_suggests_one_file_for_few(few_steps, tmp_path):
    arguments = ["lod", str(few_steps), str(tmp_path / "site"), "--levels", "2", "--steps", str(STEPS)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    text = " ".join(result.output.split())
    assert "below a million, a single SOG is better" in text
    assert "level Gaussians MB PSNR, dB before training" in text
    assert "site/lod-meta.json: " in text.replace(" /", "/")
    assert "PSNR of test views, not yet quantized" in text
