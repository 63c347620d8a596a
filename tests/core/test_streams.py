"""stdout, stderr, and log.txt may be closed, full, or missing: output may fail, but the work continues."""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from clsplat import cli
from clsplat.core import signals, terminal
from clsplat.core.errors import OutputError
from clsplat.runs import opening
from tests.support.runs import write_status

full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "clsplat", *map(str, arguments)]


def status(out: Path) -> tuple[str, int]:
    data = json.loads((out / "status.json").read_text())
    return data["state"], data["exit_code"]


@full
@pytest.mark.slow
def test_run_continues_with_its_log_if_stderr_is_full(tiny_scene, tmp_path):
    with Path("/dev/full").open("w") as nowhere:
        run = command("run", "smoke", "--scene", tiny_scene, "--out", tmp_path, "--set", "optimize.steps=20")
        done = subprocess.run(run, stdout=nowhere, stderr=nowhere, timeout=120)
    assert done.returncode == 0
    assert status(tmp_path) == ("done", 0)
    log = (tmp_path / "log.txt").read_text()
    assert "step 20/20" in log
    assert "stdout could not be written: [Errno 28] No space left on device" in log


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs terminals of POSIX")
@pytest.mark.parametrize("nohup", [True, False])
def test_run_outlives_its_terminal_with_nohup_or_saves_its_state(nohup, tiny_scene, tmp_path):
    ours, theirs = os.openpty()
    steps = 100 if nohup else 1_000_000
    process = subprocess.Popen(
        command("run", "smoke", "--scene", tiny_scene, "--out", tmp_path, "--set", f"optimize.steps={steps}"),
        **dict.fromkeys(("stdin", "stdout", "stderr"), theirs),
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL),
    )
    os.close(theirs)
    while not (tmp_path / "metrics.jsonl").exists() or not (tmp_path / "metrics.jsonl").read_text():
        assert process.poll() is None
        time.sleep(0.05)
    os.close(ours)  # from here on writing there is an error
    if not nohup:
        process.send_signal(signal.SIGHUP)
    assert process.wait(120) == (0 if nohup else 130)
    assert status(tmp_path) == (("done", 0) if nohup else ("interrupted", 130))
    assert list((tmp_path / "checkpoints").iterdir())


@pytest.mark.slow
def test_closed_pipe_is_no_error():
    process = subprocess.Popen(command("devices"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    assert (process.wait(60), process.stderr.read()) == (0, "")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="descriptors of POSIX")
def test_files_do_not_reuse_closed_standard_descriptors(tmp_path):
    code = f"""if True:
        import os
        for number in (0, 1, 2):
            os.close(number)
        from clsplat.core import signals
        signals.install()
        with open({str(tmp_path / "x")!r}, "w") as file:
            os.write(1, b"by a library")
            os.write(2, b"by a library")
            print("by Python")
            file.write(str(file.fileno()))
        """
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    assert int((tmp_path / "x").read_text()) > 2


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX")
@pytest.mark.parametrize("arguments", [["devices"], ["devices", "--json"]])
def test_output_to_a_closed_stdout_is_an_error(arguments):
    shell = ["sh", "-c", 'exec "$@" >&-', "sh", *command(*arguments)]
    done = subprocess.run(shell, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 7
    assert "stdout: cannot be written" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX")
def test_run_continues_if_stdout_is_closed(tiny_scene, tmp_path):
    run = command("run", "smoke", "--scene", tiny_scene, "--out", tmp_path, "--set", "optimize.steps=4")
    done = subprocess.run(["sh", "-c", 'exec "$@" >&-', "sh", *run], timeout=120)
    assert (done.returncode, status(tmp_path)) == (0, ("done", 0))


class Broken:
    """A stream that fails."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def write(self, text: str) -> int:
        raise self.error

    def flush(self) -> None: ...


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), BrokenPipeError(32, "x"), ValueError("closed")])
def test_only_command_output_fails_on_a_broken_stdout(error, monkeypatch):
    monkeypatch.setattr(sys, "stdout", Broken(error))
    monkeypatch.setattr(signals.STDOUT, "fault", None)
    signals.STDOUT.install()
    print("by a plug-in")
    terminal.print_message("by a command")
    if isinstance(error, BrokenPipeError):
        terminal.show("the product")
    else:
        with pytest.raises(OutputError, match="stdout: cannot be written"):
            terminal.show("the product")
        with pytest.raises(OutputError, match="stdout: cannot be written"):
            terminal.show_json({})


PRODUCTS = ["pipelines", "pipelines smoke", "check smoke", "check smoke --json", "status RUN --json"]


@pytest.mark.parametrize("arguments", PRODUCTS)
def test_command_fails_if_its_output_cannot_be_written(arguments, tmp_path, monkeypatch, capsys):
    write_status(tmp_path, state="done", step=7)
    monkeypatch.setattr(sys, "stdout", Broken(OSError(5, "Input/output error")))
    monkeypatch.setattr(sys, "argv", ["clsplat", *arguments.replace("RUN", str(tmp_path)).split()])
    monkeypatch.setattr(signals.STDOUT, "fault", None)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 7
    assert "stdout: cannot be written" in capsys.readouterr().err


def test_signal_within_a_write_loses_only_that_line(monkeypatch):
    monkeypatch.setattr(sys, "stdout", Broken(RuntimeError("reentrant call inside <_io.BufferedWriter>")))
    monkeypatch.setattr(signals.STDOUT, "fault", None)
    terminal.print_message("finishing the step")
    assert signals.STDOUT.fault is None


ENDS = {
    "KeyboardInterrupt": (KeyboardInterrupt(), 130, "stopped\n"),
    "text of a plug-in": (SystemExit("no weights"), 1, "SystemExit: no weights"),
    "code of a plug-in": (SystemExit(5), 1, "SystemExit: 5"),
}


@pytest.mark.parametrize("name", ENDS)
def test_end_of_a_command_without_a_run_is_one_line(name, monkeypatch, capsys):
    raised, code, line = ENDS[name]

    def fail(*arguments):
        raise raised

    monkeypatch.setattr("clsplat.api.commands.check", fail)
    monkeypatch.setattr(sys, "argv", ["clsplat", "check", "smoke"])
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == code
    told = capsys.readouterr().err
    assert line in told
    assert told.startswith("error: ") == (code != 130)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.slow
def test_sigterm_is_an_interrupt_for_every_command(tmp_path):
    """The command waits for a file that never appears."""
    code = "import time, clsplat.api.commands as c, clsplat.cli as m; c.check = lambda p: print('x') or time.sleep(60)"
    code += "; import sys; sys.argv[1:] = ['check', 'smoke']; m.main()"
    process = subprocess.Popen([sys.executable, "-uc", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "x\n"
    process.terminate()
    assert process.wait(60) == 130
    assert process.stderr.read() == "stopped\n"


def fill(handler: logging.FileHandler) -> None:
    """Let the file of a log be on a disk that is full."""
    handler.stream.close()
    handler.stream = Path("/dev/full").open("w")  # noqa: SIM115


@full
def test_full_log_disk_is_reported_once_and_stops_nothing(tmp_path, capsys):
    terminal.start_logging(debug=False)
    try:
        with terminal.logging_to(tmp_path / "log.txt"):
            fill(terminal.LOG.handlers[-1])
            terminal.LOG.info("one")
            terminal.LOG.info("two")
    finally:
        terminal.LOG.handlers.clear()
    captured = capsys.readouterr()
    assert captured.out == "one\ntwo\n"
    assert captured.err == (
        f"warning: {tmp_path / 'log.txt'}: cannot be written (No space left on device); continuing without this log\n"
    )


def test_log_that_is_not_a_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "log.txt") if hasattr(os, "mkfifo") else (tmp_path / "log.txt").mkdir()
    with (
        pytest.raises(OutputError, match=r"log.txt: cannot be written \(not a regular file\)"),
        terminal.logging_to(tmp_path / "log.txt"),
    ):
        pass


@full
def test_log_on_a_disk_full_from_the_start_is_refused(tmp_path, monkeypatch):
    (tmp_path / "log.txt").symlink_to("/dev/full")
    monkeypatch.setattr(Path, "is_file", lambda path: True)
    with (
        pytest.raises(OutputError, match=r"log.txt: cannot be written \(No space"),
        terminal.logging_to(tmp_path / "log.txt"),
    ):
        pass


def test_run_with_an_unwritable_log_has_a_status(tiny_scene, tmp_path, monkeypatch):
    def unused(*arguments):
        raise AssertionError

    monkeypatch.setattr(opening, "open_run", unused)
    (tmp_path / "log.txt").mkdir()
    monkeypatch.setattr(sys, "argv", command("run", "smoke", "--scene", tiny_scene, "--out", tmp_path)[2:])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 7
    assert status(tmp_path) == ("failed", 7)
