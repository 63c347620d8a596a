"""A kill at a random time, and at the n-th file of a run: the resumed run has the same bits."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.torture import __main__ as torture
from tests.torture import kills

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="attempts are forked")]

SCRIPT = """
import json, sys
from pathlib import Path
from tests.torture import kills
steps = {"optimize.steps": 8, "checkpoint.every": 1, "densify.every": 2, "densify.start": 1}
kills.SETTINGS = {"smoke": {**steps, "init.count": 60}}
*_, tally = kills.kills(Path(sys.argv[1]), Path(sys.argv[2]), 1)
print(json.dumps(tally))
"""


def test_kill_at_a_random_time(tiny_scene, tmp_path):
    """In a process that has opened no device: one that has cannot be forked."""
    command = [sys.executable, "-c", SCRIPT, tiny_scene, tmp_path / "runs"]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    tally = json.loads(done.stdout.splitlines()[-1])
    assert tally["killed"] >= 1
    assert tally["equal"] == tally["finished"] > 0


def test_leftover_file_counts_once(monkeypatch, tmp_path):
    class Attempt:
        """The first kill meets a write; the second comes before the sweep."""

        ends, code = iter((True, True, False)), 0

        def __init__(self, scene: Path, out: Path, recipe: str) -> None:
            out.mkdir(exist_ok=True)
            self.out = out

        def wait(self) -> None:
            pass

        def killed_after(self, seconds: float) -> bool:
            (self.out / ".status.json.7-0.partial").touch()
            return next(self.ends)

    monkeypatch.setattr(kills, "Attempt", Attempt)
    monkeypatch.setattr(kills, "identity", lambda out: "the same")
    *_, tally = kills.kills(tmp_path, tmp_path, 2)
    assert (tally["killed"], tally["in a write"]) == (2, 1)


def test_row_counts_the_tested_cases(tmp_path):
    """And not the number of examples that was asked for, where there are as many as there are writes."""
    (tmp_path / "test_three.py").write_text(
        "def test_three(record_property):\n    record_property('cases', 3)\ndef test_two(record_property):\n"
        "    record_property('cases', 2)\n"
    )
    (tmp_path / "test_none.py").write_text("def test_none():\n    pass\n")
    assert torture.tested("a", "holds", 1, str(tmp_path / "test_three.py")).cases == 5
    assert torture.tested("a", "holds", 7, str(tmp_path / "test_none.py")).cases == 7


CASES = 10**9 if "CLSPLAT_FUZZ" in os.environ else 1  # of each moment; `make torture` tries every file


def test_kill_during_any_write_loses_nothing(tiny_scene, tmp_path, record_property):
    """In a process that has opened no device: one that has cannot be forked."""
    command = [sys.executable, "-m", "tests.torture.each_file", tiny_scene, tmp_path / "runs", str(CASES)]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    data = json.loads(done.stdout.splitlines()[-1])
    assert len(data) >= 2
    assert [case for case in data if case[2:] != [True, 0, True]] == []
    record_property("cases", len(data))
