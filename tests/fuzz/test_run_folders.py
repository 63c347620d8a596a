"""Damaged files of a run folder: checkpoints, status, checksums, the identity of its photographs."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.names import INPUTS
from clsplat.pipeline.files import shipped
from clsplat.runs.verify import verify
from clsplat.training import archive
from clsplat.training.status import read_status
from tests.fuzz.mutation import damaged, fuzzed
from tests.fuzz.outcome import outcome

NOTES: dict[str, Any] = {"format": 4, "step": 7, "device": "a", "updates": {"means": 7}}
ARRAYS = {"means": np.arange(9, dtype=np.float32).reshape(3, 3), "opacity": np.ones((3, 1), np.float32)}
WORDS = ["NUMPY", "descr", "fortran_order", "(9999999999,)", "'|O'", "means.npy", "meta.npy", "sha256"]
SMALL = {
    "status.json": {"format": 1, "state": "running", "host": "a", "process": 7, "started": 1.5, "changed": 2.5},
    "checksums.json": {"metrics.json": "0" * 64, "renders/a.png": "1" * 64},
    INPUTS: {"photographs": {"a.png": "0" * 64}, "points": "1" * 64},
}


def checkpoint() -> bytes:
    """A small archive, as a run writes it."""
    file = io.BytesIO()
    archive.write(file, NOTES, ARRAYS.items())
    return file.getvalue()


def test_a_damaged_archive_is_equal_or_refused(folder: Path):
    """What is read is what was written, whatever was changed."""
    path = folder / "step_7.npz"

    @fuzzed(data=damaged([checkpoint()], WORDS))
    def reads(data):
        path.write_bytes(data)
        found = outcome(archive.read, path)
        if found is not None:
            notes, arrays = found
            assert notes == NOTES
            assert arrays.keys() == ARRAYS.keys()
            assert all(np.array_equal(arrays[name], ARRAYS[name]) for name in ARRAYS)

    reads()


@pytest.mark.parametrize("name", SMALL)
def test_a_run_folder_with_a_damaged_file_is_judged(name, folder: Path):
    run = folder / name.replace(".", "_")
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "step_7.npz").write_bytes(checkpoint())
    (run / "pipeline.yaml").write_bytes(shipped()["quickstart"].read_bytes())
    for other, content in SMALL.items():
        (run / other).write_text(json.dumps(content))

    @fuzzed(20, data=damaged([(run / name).read_bytes()]))
    def reads(data):
        (run / name).write_bytes(data)
        assert isinstance(outcome(read_status, run), dict)
        found = outcome(verify, run)
        assert found is not None
        assert not found["whole"]

    reads()
