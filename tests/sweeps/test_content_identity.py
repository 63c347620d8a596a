"""Runs are compared and cells are named by the content of files, not by paths."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.pipeline import matrix
from clsplat.pipeline.input_files import content_hashes, hash_content
from clsplat.pipeline.loading import load
from clsplat.stages.video import Video
from clsplat.sweeps import cell as fingerprint
from clsplat.sweeps.batch import prepare_cell
from clsplat.sweeps.cell import CellRun, Scenes
from clsplat.sweeps.task import run_cell
from tests.support.cells import CELL, WRITES, command, keys
from tests.support.runs import FEW, killed, train


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def from_model(model: Path | str, scene: Path, notes: Path) -> str:
    return keys("smoke", scene, notes, "init.source=model", f"init.file='{model}'")


def test_key_includes_the_content_of_a_folders_model(few_steps, tiny_scene, tmp_path):
    first, other = (tmp_path / name for name in ("one", "other"))
    for folder in (first, other):
        folder.mkdir()
        for name in ("point_cloud.ply", "metrics.json"):
            shutil.copy(few_steps / name, folder / name)
    key = from_model(first, tiny_scene, tmp_path / "notes")
    assert from_model(other, tiny_scene, tmp_path / "notes") == key
    (other / "point_cloud_sky.json").write_text("{}")
    assert from_model(other, tiny_scene, tmp_path / "notes") != key, "it has a sky now"
    (first / "point_cloud.ply").write_bytes(b"another")
    assert from_model(first, tiny_scene, tmp_path / "notes") != key
    (first / "point_cloud.ply").unlink()
    with pytest.raises(
        DataError, match="one: contains no model; expected a model file or the folder of a finished run"
    ):
        from_model(first, tiny_scene, tmp_path / "notes")


def test_unreadable_input_is_reported(few_steps, tiny_scene, tmp_path, monkeypatch):
    assert hash_content(tmp_path / ("m" * 300)) == ""

    def refuse(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("clsplat.pipeline.input_files.model_path", refuse)
    with pytest.raises(DataError, match=r"few: cannot be read \(Permission denied\); check its permissions"):
        hash_content(few_steps)
    assert content_hashes(load("smoke", [f"scene.path={tiny_scene}", f"init.file='{few_steps}'"])) == {}


def test_list_of_names_is_read_from_the_dataset_folder(tiny_scene, tmp_path, monkeypatch):
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    (scene / "list.txt").write_text("train/r_000\n")
    (tmp_path / "list.txt").write_text("train/r_000\n")
    monkeypatch.chdir(tmp_path)
    checked = load("smoke", [f"scene.path={scene}", "scene.holdout={file: list.txt}"])
    cell = CellRun.from_pipeline("x", checked, "s", "b")
    (tmp_path / "list.txt").write_text("train/r_001\n")
    assert CellRun.from_pipeline("x", checked, "s", "b").key == cell.key
    assert cell.files.keys() == {str(scene / "list.txt")}


def test_camera_path_name_is_not_a_file(tmp_path, monkeypatch):
    write(tmp_path / "ellipse", "a file of that name")
    monkeypatch.chdir(tmp_path)
    assert Video().input_path("path", None) is None
    assert Video(path="mine.json").input_path("path", None) == Path("mine.json")


def test_sweep_computes_the_expected_keys(tiny_scene, store, tmp_path):
    result = prepare_cell(matrix.Cell("x", load("smoke", [f"scene.path={tiny_scene}"])), Scenes(tmp_path), store)
    assert result.in_class("b").key == keys("smoke", tiny_scene, tmp_path)


def test_cell_reads_the_same_files_from_any_folder(tiny_scene, store, options, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    for folder, text in ((tmp_path, b"of the sweep"), (tmp_path / "elsewhere", b"of the worker")):
        (folder / "m.ply").write_bytes(text)
    monkeypatch.chdir(tmp_path)
    overrides = [f"scene.path={os.path.relpath(tiny_scene)}", "init.source=model", "init.file=m.ply"]
    cell = CellRun.from_json(CellRun.from_pipeline("x", load("smoke", overrides), "s", "b").json())
    monkeypatch.chdir("elsewhere")
    placed = load(str(write(tmp_path / "cell.yaml", cell.text))).settings
    assert Path(placed.stages[0].file) == tmp_path / "m.ply"
    assert Path(placed.scene.path).samefile(tiny_scene)
    reads = "import sys, pathlib; assert '" + str(tmp_path / "m.ply") + "' in pathlib.Path(sys.argv[1]).read_text()"
    assert run_cell(cell, store, command(reads), options).state == "published"
    (tmp_path / "m.ply").write_bytes(b"another")
    outcome = run_cell(replace(cell, spec={**cell.spec, "bits": "c"}), store, command(WRITES), options)
    assert (outcome.state, outcome.exit_code) == ("failed", 3)
    assert f"{tmp_path / 'm.ply'} differs from the file with which the sweep started" in outcome.message


def test_file_that_changes_while_a_cell_runs_fails_it(store, options, tmp_path):
    file = write(tmp_path / "m.ply", "as it was")
    cell = replace(CELL, files={str(file): hash_content(file)})
    changes = f"import pathlib; pathlib.Path({str(file)!r}).write_text('another')"
    outcome = run_cell(cell, store, command(changes), options)
    assert (outcome.state, outcome.exit_code) == ("failed", 3)


def test_run_resumes_with_a_moved_file_but_not_another(tiny_scene, tmp_path, caplog):
    lists = [write(tmp_path / f"{name}.txt", f"train/r_00{view}\n") for name, view in zip("abc", "001", strict=True)]
    chosen = [f"scene.holdout={{file: '{path}'}}" for path in lists]
    train(tiny_scene, tmp_path / "run", *FEW, chosen[0])
    killed(tmp_path / "run", tmp_path / "killed")
    lists[0].unlink()
    with pytest.raises(ConfigError, match=r"saved with other settings: scene\.holdout\.file was"):
        train(tiny_scene, tmp_path / "killed", *FEW, chosen[2], resume=True)
    with caplog.at_level("INFO", "clsplat"):
        train(tiny_scene, tmp_path / "killed", *FEW, chosen[1], resume=True)
    assert (tmp_path / "killed" / "point_cloud.ply").read_bytes() == (tmp_path / "run" / "point_cloud.ply").read_bytes()
    assert "resumed at step 8" in caplog.text


def test_libraries_that_change_results_are_in_keys(tiny_scene, tmp_path, monkeypatch):
    before = fingerprint.code_digest.__wrapped__()
    monkeypatch.setattr("zlib.ZLIB_RUNTIME_VERSION", "0")
    assert fingerprint.code_digest.__wrapped__() != before
    tools = fingerprint.tools_digest.__wrapped__()
    monkeypatch.setattr(fingerprint, "version", lambda name: "0")
    assert fingerprint.tools_digest.__wrapped__() != tools
    shutil.copytree(tiny_scene / "train", tmp_path / "photographs")
    scenes = [tmp_path / "photographs", tiny_scene]
    specs = [CellRun.from_pipeline("x", load("photos", [f"scene.path={scene}"]), "s", "b").spec for scene in scenes]
    assert ["tools" in spec for spec in specs] == [True, False]
