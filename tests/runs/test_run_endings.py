"""Endings of a run: status.json has the reason, and the command prints one line."""

import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat import cli
from clsplat.core import terminal
from clsplat.core.errors import (
    ConfigError,
    DataError,
    InternalError,
    Interrupted,
    MemoryLimitError,
    OutputError,
    as_clsplat_error,
)
from clsplat.core.signals import stopping_on_signals
from clsplat.runs import opening
from clsplat.sweeps import experiment
from clsplat.sweeps.experiment import Job
from tests.support.commands import clsplat

pytestmark = pytest.mark.slow

HINT = "run with --debug for the traceback, and report it"
ENDINGS = {
    "a defect": (
        ZeroDivisionError("by zero"),
        InternalError,
        f"ZeroDivisionError: by zero; {HINT}",
    ),
    "a defect without words": (AssertionError(), InternalError, f"internal error (a bug): AssertionError; {HINT}"),
    "several lines": (RuntimeError("a\n  b"), InternalError, "RuntimeError: a b; "),
    "no memory": (MemoryError(), MemoryLimitError, "out of memory"),
    "a second Ctrl-C": (KeyboardInterrupt(), Interrupted, "stopped at once; run the same command again to continue"),
    "the end of a file": (EOFError(), InternalError, "EOFError"),
    "a full disk": (OSError(28, "No space left on device", "/x/y"), OutputError, "/x/y: No space left on device"),
    "bad data": (DataError("no photo"), DataError, "no photo"),
}


@pytest.fixture(autouse=True)
def quiet_log():
    yield
    logging.getLogger("clsplat").handlers.clear()


@pytest.mark.parametrize(
    ("name", "function"),
    list(zip(ENDINGS, 3 * ["opening.open_run", "runner.execute", "runner.run_stages"], strict=False)),
)
def test_every_exception_gives_a_message_and_a_status(name, function, tiny_scene, tmp_path, monkeypatch, capsys):
    raised, kind, words = ENDINGS[name]

    def fail(*arguments):
        raise raised

    monkeypatch.setattr(f"clsplat.runs.{function}", fail)
    out = tmp_path / "run"
    out.mkdir()  # a folder that a run makes itself does not outlive its refusal
    monkeypatch.setattr(sys, "argv", ["clsplat", "run", "smoke", "--scene", str(tiny_scene), "--out", str(out)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == kind.exit_code
    errors = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")]
    assert len(errors) == 1
    before = "" if kind is Interrupted else "error: "  # nothing went wrong
    assert errors[0].startswith(before)
    assert words in errors[0]
    status = json.loads((out / "status.json").read_text())
    assert status["state"] == ("interrupted" if kind is Interrupted else "failed")
    assert status["exit_code"] == kind.exit_code
    assert f"{before}{status['message']}" == errors[0]
    assert f"{type(raised).__name__}" in (out / "log.txt").read_text(), "the traceback is in the log"


@pytest.mark.parametrize("place", [["--debug", "run"], ["run", "--debug"]], ids=["before", "after"])
def test_debug_prints_the_traceback_before_the_message(place, tiny_scene, tmp_path, monkeypatch, capsys):
    def fail(*arguments):
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(opening, "open_run", fail)
    more = ["smoke", "--scene", str(tiny_scene), "--out", str(tmp_path / "run")]
    monkeypatch.setattr(sys, "argv", ["clsplat", *place, *more])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert "Traceback (most recent call last):" in lines
    assert lines[-1].startswith("error: internal error (a bug): ZeroDivisionError: by zero")


def test_unwritable_log_is_a_failure_with_a_status(tiny_scene, tmp_path):
    (tmp_path / "run" / "log.txt").mkdir(parents=True)
    done = clsplat("run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "run", expect=7)
    assert "log.txt: cannot be written" in done.stderr
    assert json.loads((tmp_path / "run" / "status.json").read_text())["exit_code"] == 7


def test_signal_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopping_on_signals(pytest.fail):
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_run_continues_when_its_output_is_not_read(tiny_scene, tmp_path):
    command = [sys.executable, "-m", "clsplat", "run", "smoke", "--scene", str(tiny_scene), "--out", str(tmp_path)]
    command += ["--set", "optimize.steps=12"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(60) == 0, process.stderr.read()
    assert [line for line in process.stderr.read().splitlines() if "training views" not in line] == []
    assert json.loads((tmp_path / "status.json").read_text())["state"] == "done"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["devices"], ["--help"]], ids=" ".join)
def test_unwritable_output_is_reported_in_one_line(arguments):
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "clsplat", *arguments]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 7
    assert done.stderr.splitlines() == [
        "error: stdout: cannot be written (No space left on device); redirect it elsewhere, or free up space"
    ]


def test_scene_with_a_non_unicode_name_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="expected a path in UTF-8"):
        Job.open("smoke", tmp_path / "\udcff")


def test_folder_with_another_run_keeps_its_status(tiny_scene, tmp_path):
    (tmp_path / "pipeline.yaml").write_text("name: other\nstages: [init]\n")
    (tmp_path / "status.json").write_text('{"state": "done"}')
    clsplat("run", "smoke", "--scene", tiny_scene, "--out", tmp_path, expect=2)
    assert (tmp_path / "status.json").read_text() == '{"state": "done"}'


def test_terminal_keeps_stdout_for_json(capsys):
    terminal.start_logging(debug=False)
    terminal.keep_stdout_for_json()
    experiment.LOG.info("a remark")
    experiment.LOG.warning("a warning")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == "a remark\nwarning: a warning\n"


def test_command_without_stdout_reports_it():
    done = subprocess.run(
        f'"{sys.executable}" -m clsplat --version >&-', shell=True, stderr=subprocess.PIPE, text=True, timeout=60
    )
    assert done.returncode == 7
    assert done.stderr.startswith("error: stdout: cannot be written")
    assert done.stderr.count("\n") == 1


def test_running_out_of_memory_names_gaussians_and_images():
    assert "use fewer Gaussians, or fewer or smaller images" in str(as_clsplat_error(MemoryError()))
