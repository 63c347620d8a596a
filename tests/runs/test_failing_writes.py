"""The n-th write of a run fails, as on a full or bad disk: one sentence, exit code 7, and nothing is lost."""

import builtins
import errno
import gc
import io
import itertools
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clsplat import cli
from clsplat.training import checkpoint
from tests.support.runs import digest, records

pytestmark = pytest.mark.slow
TINY = ("optimize.steps=4", "init.count=20", "checkpoint.every=2", "optimize.log_every=2", "optimize.evaluate.every=3")
CASES = 10**9 if "CLSPLAT_FUZZ" in os.environ else 2  # of each kind and error; `make torture` tries every write


class Faults:
    """Counts the calls that write to a run folder, by kind, and lets one of a kind fail."""

    def __init__(self, patch: pytest.MonkeyPatch, folder: Path, kind: str = "", at: int = 0, number: int = 0) -> None:
        self.counts = {"write": 0, "sync or rename": 0}
        self.kind, self.at, self.number, self.folder = kind, at, number, str(folder)
        for name in ("fsync", "replace"):
            patch.setattr(os, name, self._failing(getattr(os, name)))
        patch.setattr(io, "open", self._opening(io.open))
        patch.setattr(builtins, "open", io.open)

    def fails(self, kind: str) -> bool:
        self.counts[kind] += 1
        return (kind, self.counts[kind]) == (self.kind, self.at)

    @property
    def error(self) -> OSError:
        return OSError(self.number, os.strerror(self.number))

    def _failing(self, function: Callable) -> Callable:
        def call(*arguments, **values):
            if self.fails("sync or rename"):
                raise self.error
            return function(*arguments, **values)

        return call

    def _opening(self, function: Callable) -> Callable:
        def call(path, mode="r", *arguments, **values):
            file = function(path, mode, *arguments, **values)
            inside = not isinstance(path, int) and os.path.abspath(path).startswith(self.folder)
            return File(file, self) if inside and set(mode) & set("wxa+") else file

        return call


class File:
    """An open file; of the write that fails, the first half arrives."""

    def __init__(self, file: Any, faults: Faults) -> None:
        self._file, self._faults = file, faults

    def write(self, data: Any) -> int:
        if self._faults.fails("write"):
            self._file.write(data[: len(data) // 2])
            raise self._faults.error
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> "File":
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()


@pytest.fixture
def run(tiny_scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., int]:
    """Run the tiny pipeline by the command line; the exit code, after a look at what it prints."""

    def run(out: Path, *more: str) -> int:
        arguments = ["run", "smoke", "--scene", str(tiny_scene), "--out", str(out), *more, "--set", *TINY]
        monkeypatch.setattr(sys, "argv", ["clsplat", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
        code = int(end.value.code or 0)
        lines = capsys.readouterr().err.splitlines()
        assert [line for line in lines if not line.startswith("warning: ")] == lines[-1:] * (code != 0)
        assert code == 0 or lines[-1].startswith("error: "), lines
        assert code in (0, 7), lines
        return code

    return run


def test_any_failing_write_loses_nothing(run, tmp_path, record_property):
    whole = tmp_path / "whole"
    with pytest.MonkeyPatch.context() as patch:
        counts = Faults(patch, whole).counts
        assert run(whole) == 0
    failed = cases = 0
    for (kind, total), number in itertools.product(counts.items(), (errno.ENOSPC, errno.EIO)):
        assert total > 30
        stride = max(1, total // CASES)
        for at in range(1 + stride // 2 * (number == errno.EIO), total + 1, stride):
            case = f"{errno.errorcode[number]}, {kind} {at} of {total}"
            out = tmp_path / case
            with pytest.MonkeyPatch.context() as patch:
                Faults(patch, out, kind, at, number)
                failed += run(out) == 7  # some are not of the run: it goes on without a log, or a status
            for file in (out / "checkpoints").glob("*.npz") if out.exists() else ():
                checkpoint.load(file)
            assert not list(out.rglob("*.partial")), case
            assert run(out, "--resume") == 0, case
            assert digest(out) == digest(whole), case
            assert records(out) == records(whole), case
            assert json.loads((out / "status.json").read_text())["state"] == "done", case
            cases += 1
            gc.collect()  # programs and their context are in cycles; the long form has no log, whose errors hold frames
    assert failed > 1
    record_property("cases", cases)
