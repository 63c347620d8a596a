"""A process is killed at the n-th file of a run, on either side of the rename: resumed, it ends with the same bits."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="attempts are forked")]
CASES = 10**9 if "CLSPLAT_FUZZ" in os.environ else 4  # of each moment; `make torture` tries every file


def test_whichever_file_is_being_written_nothing_is_lost(tiny_scene, tmp_path, record_property):
    """In a process that has opened no device: one that has cannot be forked."""
    command = [sys.executable, "-m", "tests.torture.each_file", tiny_scene, tmp_path / "runs", str(CASES)]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert len(found) >= 8
    assert [case for case in found if case[2:] != [True, 0, True]] == []
    record_property("cases", len(found))
