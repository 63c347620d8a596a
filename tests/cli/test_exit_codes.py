"""Each exit code from a realistic cause: the code, the message, and status.json."""

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from clsplat import cli
from clsplat.core.errors import ClsplatError, OutputError
from clsplat.core.files import write_text
from clsplat.opencl.device import Device
from clsplat.stages.evaluate import Evaluate
from tests.support.commands import clsplat, process

pytestmark = pytest.mark.slow

BROKEN_PLUGIN = """
from typing import Literal

from clsplat.losses.base import Penalty

class Faulty(Penalty):
    '''Fails.'''
    type: Literal['faulty'] = 'faulty'

    def add(self, inputs):
        raise ZeroDivisionError('by zero')
"""


@pytest.fixture
def tiny_copy(tiny_scene: Path, tmp_path: Path) -> Path:
    """A copy of the tiny scene, to be damaged."""
    return shutil.copytree(tiny_scene, tmp_path / "scene")


def damaged_photograph(scene: Path, folder: Path) -> list[str]:
    photograph = min((scene / "train").rglob("*.png"))
    photograph.write_bytes(photograph.read_bytes()[:200])
    return []


def block_with_folder(scene: Path, folder: Path) -> list[str]:
    (folder / "run" / "metrics.jsonl").mkdir()
    return []


CAUSES: dict[str, tuple[int, str | Callable[[Path, Path], list[str]], str, str | None]] = {
    # name: (code, what is added to the command or done before it, words of the sentence, state; None: no run folder)
    "a run to its end": (0, "--set optimize.steps=5", "", "done"),
    "an unknown key": (2, "--set optimize.stepz=3", "did you mean 'steps'", None),
    "no such option": (2, "--fast", "no option --fast", None),
    "a damaged photograph": (3, damaged_photograph, "", "failed"),
    "no such device": (4, "--device nowhere", "no device matches 'nowhere'", "failed"),
    "values that are not finite": (6, "--set optimize.rates.sh_base=1e38", "not finite", "failed"),
    "an output that cannot be written": (7, block_with_folder, "metrics.jsonl: cannot be written", "failed"),
}


@pytest.mark.parametrize("name", CAUSES)
def test_every_exit_code_has_a_message_and_a_status(name, tiny_copy, tmp_path):
    code, cause, words, state = CAUSES[name]
    if state:
        (tmp_path / "run").mkdir()  # a folder that was there keeps the status, whenever the run ends
    more = cause.split() if isinstance(cause, str) else cause(tiny_copy, tmp_path)
    command = process if name == "a run to its end" else clsplat
    done = command("run", "smoke", "--scene", tiny_copy, "--out", tmp_path / "run", *more, expect=code)
    assert words in done.stderr
    check_status(tmp_path / "run", code, state, done.stderr)


def check_status(out: Path, code: int, state: str | None, errors: str) -> None:
    if state is None:
        assert not out.exists()
        return
    status = json.loads((out / "status.json").read_text())
    assert (status["state"], status["exit_code"]) == (state, code)
    if code == 130:  # nothing went wrong
        assert errors.splitlines()[-1] == status["message"]
        return
    shown = [line.removeprefix("error: ") for line in errors.splitlines() if line.startswith("error: ")]
    assert shown == ([status["message"]] if code else [])


def in_this_process(monkeypatch, capsys, *arguments: str) -> tuple[int, str]:
    """Run the command line here; return the exit code and what it printed to stderr."""
    monkeypatch.setattr(sys, "argv", ["clsplat", *map(str, arguments)])
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        cli.main()
    return end.value.code, capsys.readouterr().err


def test_internal_error_exits_with_code_1(tiny_scene, tmp_path, monkeypatch, capsys):
    def defect(*arguments, **values):
        raise IndexError("list index out of range")

    monkeypatch.setattr("clsplat.stages.evaluate.measure", defect)
    out = tmp_path / "run"
    code, errors = in_this_process(monkeypatch, capsys, "run", "smoke", "--scene", tiny_scene, "--out", out)
    assert code == 1
    assert "internal error (a bug): IndexError" in errors
    check_status(out, 1, "failed", errors)


def test_failing_plugin_exits_with_code_2(tiny_scene, tmp_path, without_plugins):
    plugin, out = tmp_path / "faulty.py", tmp_path / "run"
    out.mkdir()  # one that a run makes does not outlive its refusal
    plugin.write_text(BROKEN_PLUGIN)
    sets = ["--set", "optimize.losses=[l1, faulty]"]
    done = clsplat("--plugin", plugin, "run", "smoke", "--scene", tiny_scene, "--out", out, *sets, expect=2)
    check_status(out, 2, "failed", done.stderr)


STOPPING_PLUGIN = """
from typing import Literal

from clsplat.training.stage import Scheduled

class Stopping(Scheduled):
    '''Fails.'''
    stage: Literal['stopping'] = 'stopping'

    def run(self, run):
        raise ERROR
"""


@pytest.mark.parametrize("error", ["StopIteration", "SystemExit(0)", "GeneratorExit"])
def test_failing_plugin_stage_exits_with_2_and_keeps_steps(error, tiny_scene, tmp_path, without_plugins):
    plugin, out = tmp_path / "stopping.py", tmp_path / "run"
    plugin.write_text(STOPPING_PLUGIN.replace("ERROR", error))
    sets = ["--set", "optimize.during=[{stage: stopping, every: 3}]", "optimize.steps=5"]
    done = clsplat("--plugin", plugin, "run", "smoke", "--scene", tiny_scene, "--out", out, *sets, expect=2)
    assert f"stopping.py:11: {error.split('(')[0]}" in done.stderr
    check_status(out, 2, "failed", done.stderr)
    assert (out / "checkpoints" / "step_000003.npz").exists()


def test_out_of_memory_exits_with_code_5(tiny_scene, tmp_path, monkeypatch, capsys):
    """A device with 2 MiB, for a scene that needs 10."""
    small = Device.__init__

    def with_little_memory(device, *words, **named):
        small(device, *words, **named)
        device.info = dataclasses.replace(device.info, memory=2 << 20, allocation=2 << 20)

    monkeypatch.setattr(Device, "__init__", with_little_memory)
    out = tmp_path / "run"
    out.mkdir()
    code, errors = in_this_process(monkeypatch, capsys, "run", "smoke", "--scene", tiny_scene, "--out", out)
    assert code == 5, errors
    check_status(out, 5, "failed", errors)


def test_signal_exits_with_code_130(tiny_scene, tmp_path):
    out = tmp_path / "run"
    command = [sys.executable, "-m", "clsplat", "run", "smoke", "--scene", str(tiny_scene), "--out", str(out)]
    command += ["--set", "optimize.steps=1000000"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while not (out / "metrics.jsonl").exists() or not (out / "metrics.jsonl").read_text():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    check_interrupted(out, process.returncode, errors)


def test_sigterm_within_a_step_exits_with_code_130(tiny_scene, tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"

    def stop(*arguments):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Evaluate, "run", stop)
    words = ["--set", "optimize.steps=20", "optimize.evaluate.every=2"]
    code, errors = in_this_process(monkeypatch, capsys, "run", "smoke", "--scene", tiny_scene, "--out", out, *words)
    check_interrupted(out, code, errors)


def check_interrupted(out: Path, code: int, errors: str) -> None:
    assert code == 130
    assert "error" not in errors
    assert "stopped at step" in errors
    assert list((out / "checkpoints").glob("*.npz"))
    check_status(out, 130, "interrupted", errors)


def test_every_error_code_is_tested_here():
    codes, kinds = {0}, [ClsplatError]
    while kinds:
        kind = kinds.pop()
        codes.add(kind.exit_code)
        kinds += kind.__subclasses__()
    others = {
        1: test_internal_error_exits_with_code_1,
        5: test_out_of_memory_exits_with_code_5,
        130: test_signal_exits_with_code_130,
    }
    assert all(test.__name__.endswith(f"_{code}") for code, test in others.items())
    assert codes == {code for code, *_ in CAUSES.values()} | others.keys()


LONG = "x" * 300  # longer than a name of any file system


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["run", "smoke", "--scene", LONG], 3),
        (["run", LONG, "--scene", "scene"], 2),
        (["resume", LONG], 3),
        (["check", LONG], 3),
        (["inspect", LONG], 3),
        (["evaluate", f"{LONG}.ply", "--scene", "scene"], 3),
        (["compare", LONG], 3),
        (["--plugin", f"{LONG}.py", "devices"], 3),
        (["run", "smoke", "--scene", "scene", "--out", LONG], 7),
        (["pipelines", "smoke", "--copy", LONG], 7),
        (["data", "synthetic", LONG], 7),
    ],
    ids=lambda value: " ".join(value).replace(LONG, "LONG") if isinstance(value, list) else value,
)
@pytest.mark.skipif(sys.platform == "win32", reason="Windows says that there is no such file")
def test_too_long_input_name_is_reported_like_a_missing_file(arguments, code, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    actual, errors = in_this_process(monkeypatch, capsys, *arguments)
    assert actual == code, errors
    assert len(errors.splitlines()) == 1
    assert "File name too long" in errors or code == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Windows says that there is no such file")
def test_too_long_output_name_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match=r"xxx\.ply: cannot be written \(File name too long\)"):
        write_text(tmp_path / f"{LONG}.ply", "")


def test_too_little_address_space_is_refused_at_the_start(monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda number: (500 << 20, 500 << 20))
    message = "limits clsplat to 500 MiB of address space; libraries crash with less than 1024 MiB: raise the limit"
    assert message in clsplat("pipelines", expect=5).stderr
