"""Untrusted stores and matrix folders: nothing outside is written, and damage is one sentence."""

import json
from pathlib import Path

import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.pipeline.loading import load
from clsplat.runs.opening import undistorted_folder
from clsplat.runs.state import RunState
from clsplat.sweeps.batch import copy_result
from clsplat.sweeps.experiment import check_matrix_folder
from clsplat.sweeps.status import format_store_status, store_status
from clsplat.sweeps.task import run_cell
from tests.support.cells import CELL, WRITES, command
from tests.support.commands import clsplat
from tests.support.pipelines import STAGES

HUGE = 10**400
ODD = (HUGE, -HUGE, "x", None, [1], {"a": 1}, True)


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    folder = tmp_path / "outside"
    folder.mkdir()
    return folder


@pytest.mark.parametrize("key", ["../../outside/flag", "/outside/flag", "A" * 20, "a" * 300, 3, ["a"]])
def test_folder_that_is_not_a_key_is_no_cell(store, outside, key):
    (store.root / "cells").mkdir(parents=True)
    (store.root / "sweeps").mkdir()
    (store.root / "sweeps" / "x.json").write_text(json.dumps({"name": "s", "cells": {"c": key}}))
    clsplat("cancel", store.root, "c", expect=2)
    assert not any(outside.iterdir())
    assert not (store.root / "cancel").exists()


@pytest.mark.parametrize(
    "name", ["cells", "cells/KEY", "cells/KEY/attempts", "cells/KEY/result", "sweeps", "cancel", "events", "cancel/all"]
)
def test_links_in_a_store_are_refused(store, options, outside, name):
    (store.root / "cells" / CELL.key).mkdir(parents=True)
    link = store.root / name.replace("KEY", CELL.key)
    if link.is_dir():
        (outside / CELL.key).mkdir()
        link.rename(store.root / "moved")
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(outside / "new" if name == "cancel/all" else outside, target_is_directory=True)
    before = sorted(outside.rglob("*"))

    def use() -> None:
        store.note_sweep("s", {"c": CELL.key}, "")
        store.folders()
        store.cancel()

    with pytest.raises(DataError, match=rf"{link}: is a symbolic link, .*; remove it"):
        use()
    assert sorted(outside.rglob("*")) == before


def test_attempt_that_is_a_link_is_no_attempt(store, options, outside):
    folder = store.add(CELL)
    (folder.path / "attempts").mkdir()
    (folder.path / "attempts" / ("a" * 32)).symlink_to(outside, target_is_directory=True)
    assert folder.attempts() == []


def test_undistorted_photos_are_not_written_through_a_link(store, options, outside):
    attempts = store.add(CELL).path / "attempts"
    attempts.mkdir()
    (attempts / "undistorted").symlink_to(outside, target_is_directory=True)
    assert undistorted_folder(attempts / "a") == attempts / "a" / "undistorted"
    outcome = run_cell(CELL, store, command(WRITES), options)
    assert outcome.exit_code == DataError.exit_code
    assert "undistorted: is a symbolic link that does not point to" in outcome.message


def test_result_is_not_copied_through_a_link(tmp_path, outside):
    result, target = tmp_path / "result", tmp_path / "out"
    (result / "renders").mkdir(parents=True)
    (result / "renders" / "a.png").write_bytes(b"image")
    (result / "manifest.json").write_text("{}")
    target.mkdir()
    (target / "renders").symlink_to(outside, target_is_directory=True)
    copy_result(result, target)
    assert (target / "renders" / "a.png").read_bytes() == b"image"
    assert not any(outside.iterdir())


@pytest.mark.parametrize("name", ["store", "prepared", "undistorted"])
def test_matrix_folder_with_a_link_to_outside_is_refused(tmp_path, outside, name):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).symlink_to(outside, target_is_directory=True)
    with pytest.raises(ConfigError, match=f"{name}: links to a target outside of the run folder"):
        check_matrix_folder(RunState.read(out))


def test_no_stage_writes_into_the_store_of_its_folder(tmp_path):
    (tmp_path / "x.yaml").write_text(f"name: a\n{STAGES}".replace("- export", "- export: {file: store/a.ply}"))
    with pytest.raises(ConfigError, match="'store' is written by the run itself"):
        load(str(tmp_path / "x.yaml"))


def test_damaged_values_of_a_store_count_as_absent(store, options):
    assert run_cell(CELL, store, command(WRITES), options).state == "published"
    folder, other = store.folder(CELL.key), store.add(type(CELL)("b", {**CELL.spec, "seed": 1}, ""))
    manifest = json.loads((folder.result / "manifest.json").read_text())
    attempt = other.begin("w", options.since)
    (store.root / "cells" / ("é" * 100)).mkdir()
    for value in ODD:
        for key in ("seconds", "host", "device", "worker"):
            (folder.result / "manifest.json").write_text(json.dumps({**manifest, key: value}))
            format_store_status(store_status(store.root))
        for key in ("since", "exit_code", "from", "time", "host"):
            (attempt.path / "lease.json").write_text(json.dumps({"exit_code": 6, key: value}))
            other.failures(0.0)
            format_store_status(store_status(store.root))
        (attempt.path / "lease.json").write_text(json.dumps({"from": f"step_{'9' * 5000}.npz", "exit_code": 6}))
        other.failures(0.0)
        for steps in ({"optimize": {"steps": value}}, value, {"optimize": value}):
            spec = {"pipeline": {"name": value, "seed": value, "stages": [steps]}, "bits": value}
            (other.path / "spec.json").write_text(json.dumps(spec))
            format_store_status(store_status(store.root))
