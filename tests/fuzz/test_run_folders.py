"""Damaged files of a run folder: checkpoints, status, checksums, and hashes of the input."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clsplat
from clsplat.core.files import INPUTS
from clsplat.core.reading import sha256
from clsplat.gaussians.model import Rendering
from clsplat.gaussians.sky import Sky, read_sky_file
from clsplat.nerf.files import FieldModel, load_field
from clsplat.nerf.shape import FieldShape
from clsplat.runs.state import RunState
from clsplat.runs.verify import verify
from clsplat.training import archive
from clsplat.training.status import read_status
from tests.fuzz.mutation import damaged, fuzzed
from tests.fuzz.outcome import outcome

NOTES: dict[str, Any] = {"format": 4, "step": 7, "device": "a", "updates": {"means": 7}}
ARRAYS = {"means": np.arange(9, dtype=np.float32).reshape(3, 3), "opacity": np.ones((3, 1), np.float32)}
WORDS = ["NUMPY", "descr", "fortran_order", "(9999999999,)", "'|O'", "means.npy", "meta.npy", "sha256"]
TINY = """
name: tiny
stages:
  - init: {count: 20}
  - optimize: {steps: 2, losses: [l1], during: [{checkpoint: {every: 2}}]}
  - evaluate
  - export
"""


def checkpoint() -> bytes:
    """A small checkpoint, as a run writes it."""
    file = io.BytesIO()
    archive.write(file, NOTES, ARRAYS.items())
    return file.getvalue()


def test_damaged_archive_is_equal_or_refused(folder: Path):
    """What is read is what was written, whatever was changed."""
    path = folder / "step_7.npz"

    @fuzzed(data=damaged([checkpoint()], WORDS))
    def reads(data):
        path.write_bytes(data)
        actual = outcome(archive.read, path)
        if actual is not None:
            notes, arrays = actual
            assert notes == NOTES
            assert arrays.keys() == ARRAYS.keys()
            assert all(np.array_equal(arrays[name], ARRAYS[name]) for name in ARRAYS)

    reads()


def test_damaged_field_is_equal_or_refused(folder: Path):
    shape = FieldShape(unit=1.0, depth=1, skip=None, width=4, color_width=4, degrees=1)
    field = FieldModel(shape, shape.initial_parameters(0), Rendering(background="white"))
    field.save(folder / "whole.npz")
    path = folder / "field.npz"

    @fuzzed(data=damaged([(folder / "whole.npz").read_bytes()], [*WORDS, "width", "white", "format"]))
    def reads(data):
        path.write_bytes(data)
        actual = outcome(load_field, path)
        if actual is not None:
            assert (actual.shape, actual.rendering) == (field.shape, field.rendering)
            assert np.array_equal(actual.parameters, field.parameters)

    reads()


@pytest.fixture(scope="module")
def run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with few, small files."""
    file = tmp_path_factory.mktemp("pipeline") / "tiny.yaml"
    file.write_text(TINY)
    return clsplat.run(file, tiny_scene, tmp_path_factory.mktemp("runs") / "run")


@pytest.mark.parametrize("name", ["status.json", "checksums.json", INPUTS])
def test_damaged_run_file_is_read_equal_or_reported(name, run: Path):
    before = (run / name).read_bytes()
    whole = verify(RunState.read(run))
    assert whole["whole"], whole

    @fuzzed(20, data=damaged([before]))
    def reads(data):
        (run / name).write_bytes(data)
        assert isinstance(outcome(read_status, run), dict)
        actual = outcome(lambda: verify(RunState.read(run)))
        assert actual is not None
        if actual["whole"]:
            assert checked_part(name, json.loads(data), actual) == checked_part(name, json.loads(before), whole)

    try:
        reads()
    finally:
        (run / name).write_bytes(before)


def checked_part(name: str, content: Any, actual: dict[str, Any]) -> Any:
    """What a check holds a file to: all of it, but of status.json, which has no checksum, the state and the files."""
    return [content["state"], [item["file"] for item in actual["objects"]]] if name == "status.json" else content


def test_damaged_sky_is_a_map_or_refused(folder: Path):
    path, model = folder / "model_sky.json", folder / "model.ply"
    model.write_bytes(b"a model")
    Sky(np.linspace(0, 1, 192, dtype=np.float32).reshape(64, 3)).write(path, {model.name: sha256(model)})

    @fuzzed(data=damaged([path.read_bytes()], ["side", "texels", "models", "NaN", "1e999", "null", "[[0, 0, 0]]"]))
    def reads(data):
        path.write_bytes(data)
        actual = outcome(read_sky_file, model)
        if actual is not None:
            assert actual.texels.shape == (actual.side**2, 3)
            assert np.isfinite(actual.texels).all()

    reads()
