"""Features that only some systems have are not needed: these tests take them away."""

import ast
import errno
import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.core import files
from clsplat.core.child import ChildResult
from clsplat.core.errors import OutputError
from clsplat.opencl import runtimes
from tests.support.sources import FILES, ROOT

pytestmark = pytest.mark.slow

POSIX_ONLY = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
WITHOUT_POSIX = '''
"""What Windows lacks is not there, and what it does otherwise fails."""
import builtins, os, signal, sys
import importlib, subprocess, tempfile, threading  # noqa  those of Python itself have what they need

for name in {modules!r}:
    sys.modules[name] = None
for name in ("SIGHUP", "SIGKILL", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGPIPE", "SIGCHLD", "SIGSTOP", "SIGCONT"):
    if hasattr(signal, name):
        delattr(signal, name)
for name in ("fork", "geteuid", "getgid", "getegid", "getpgid", "mkfifo", "sysconf", "sched_getaffinity",
             "statvfs", "chown", "O_DIRECTORY", "killpg", "setsid", "getloadavg", "nice", "pread"):
    if hasattr(os, name):
        delattr(os, name)

def kill(process, number):
    raise OSError(87, "os.kill ends a process of Windows")

end, os.kill = os.kill, kill
subprocess.Popen.kill = subprocess.Popen.terminate = lambda process: process.poll() is None and end(process.pid, 9)
'''
LIKE_MACOS = '''
"""No /proc, no numbers of processors by affinity, and workers that are started anew."""
import builtins, io, multiprocessing, os

for name in ("sched_getaffinity", "memfd_create", "posix_fadvise", "O_DIRECT"):
    if hasattr(os, name):
        delattr(os, name)
multiprocessing.set_start_method("spawn", force=True)

def outside(function):
    def call(path, *more, **named):
        if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith(("/proc", "/sys")):
            raise FileNotFoundError(2, "No such file or directory", os.fspath(path))
        return function(path, *more, **named)
    return call

builtins.open = io.open = outside(open)
os.readlink, os.stat, os.listdir = outside(os.readlink), outside(os.stat), outside(os.listdir)
'''
SEVERAL = """
import json, sys
from clsplat.cli import main

for code, *words in json.loads(sys.argv[1]):
    sys.argv = ["clsplat", *words]
    try:
        main()
    except SystemExit as end:
        assert (end.code or 0) == code, (words, end.code)
    else:
        assert code == 0, words
"""
SYSTEMS = {"without POSIX": WITHOUT_POSIX.format(modules=sorted(POSIX_ONLY - {"posix"})), "like macOS": LIKE_MACOS}


def environment_without(folder: Path, *systems: str) -> dict[str, str]:
    """The environment of processes on such systems; `folder` is for what changes them."""
    (folder / "sitecustomize.py").write_text("".join(systems))
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


@pytest.fixture(scope="module", params=SYSTEMS)
def system(request, tmp_path_factory) -> dict[str, str]:
    return environment_without(tmp_path_factory.mktemp("system"), SYSTEMS[request.param])


def command(environment: dict[str, str], *arguments: str | Path, expect: int = 0, text: bool = True):
    done = subprocess.run(
        [sys.executable, "-m", *map(str, arguments)], capture_output=True, text=text, env=environment, timeout=300
    )
    assert done.returncode == expect, done.stderr
    return done


def commands(environment: dict[str, str], *lines: list[int | str | Path], text: bool = True):
    """Run commands, each with the exit code to expect before its words, in one process: a start costs a second."""
    words = [sys.executable, "-c", SEVERAL, json.dumps(lines, default=str)]
    done = subprocess.run(words, capture_output=True, text=text, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    return done


def test_every_test_module_is_imported(tmp_path):
    (tmp_path / "every_test.py").write_text(
        "import importlib, sys, pytest\n"
        "for name in sys.argv[1:]:\n"
        "    try:\n"
        "        importlib.import_module(name)\n"
        "    except pytest.skip.Exception:\n"
        "        pass\n"
    )
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    modules = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files]
    command(environment_without(tmp_path, *SYSTEMS.values()), "every_test", "tests.conftest", *modules)


def test_synthetic_scene_is_written_trained_and_resumed(system, tmp_path):
    scene, out = tmp_path / "scene", tmp_path / "run"
    made = [0, "data", "synthetic", scene, "--size", "32", "--train", "4", "--test", "1"]
    small = ["--set", "optimize.steps=8", "optimize.log_every=2"]
    trained = [0, "run", "smoke", "--scene", scene, "--out", out, *small]
    assert ": done at step 8" in commands(system, made, trained, [0, "status", out]).stdout
    (out / "point_cloud.ply").unlink()
    command(system, "clsplat", "resume", out)
    assert (out / "point_cloud.ply").is_file()


CONSOLES = {
    "ascii": [[0, "run", "--help"], [0, "pipelines", "splat"], [2, "run", "…×°.yaml"]],
    **{"cp1252": [[0, "devices"]], "cp437": [[2, "run", "…×°.yaml"]]},
}


@pytest.mark.parametrize("encoding", CONSOLES)
def test_limited_console_encoding_shows_every_text(encoding):
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0", "LC_ALL": "C"}
    done = commands(environment, *CONSOLES[encoding], text=False)
    assert b"Traceback" not in done.stderr
    assert (done.stdout + done.stderr).decode(encoding)


def test_run_finishes_with_a_limited_console_encoding(tiny_scene, tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C.UTF-8"}
    sets = ["--set", "optimize.steps=3"]
    done = command(environment, "clsplat", "run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "ü…", *sets)
    assert "\\u2026" in done.stdout
    assert "Traceback" not in done.stderr


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def calls(path: Path) -> list[ast.Call]:
    return [node for node in ast.walk(tree(path)) if isinstance(node, ast.Call)]


def has_implicit_encoding(call: ast.Call) -> bool:
    """Whether a call reads or writes text in the encoding that the system happens to have."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    owner = ast.unparse(call.func.value) if isinstance(call.func, ast.Attribute) else ""
    named = {keyword.arg: keyword.value for keyword in call.keywords}
    if "encoding" in named:
        return False
    if name == "read_text" and owner:
        return not call.args
    if name == "write_text" and owner:
        return len(call.args) < 2
    if name in ("run", "Popen", "check_output") and owner == "subprocess":
        return "text" in named
    modes = [ast.unparse(value) for value in [*call.args[0 if owner else 1 :][:1], *call.keywords]]
    if name == "open" and not owner:
        return not any("b" in mode for mode in modes)
    return name == "open" and modes[:1] in (["'r'"], ["'w'"], ["'a'"], ["'x'"])  # of a path; others take a name first


def test_implicit_text_encoding_is_detected():
    actual = "a.read_text()|a.write_text(b)|open(a)|open(a, 'w')|p.open('a')|subprocess.run(a, text=True)"
    fine = "a.read_text('utf-8')|write_text(a, b)|open(a, 'rb')|p.open('ab')|Job.open(a, b)|open(a, encoding='utf-8')"
    for code in actual.split("|"):
        assert has_implicit_encoding(ast.parse(code).body[0].value), code
    for code in fine.split("|"):
        assert not has_implicit_encoding(ast.parse(code).body[0].value), code


def test_text_files_name_their_encoding():
    actual = [(path, call.lineno) for path in FILES for call in calls(path) if has_implicit_encoding(call)]
    assert not actual, "\n".join(
        f"{path}:{line}: takes the encoding of the system; name utf-8" for path, line in actual
    )


def test_modules_of_some_systems_are_imported_where_used():
    faults = []
    for path in FILES:
        for node in tree(path).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if set(names) & (POSIX_ONLY | {"msvcrt", "winreg", "_winapi"}):
                faults.append(f"{path}:{node.lineno}: import it where it is used")
    tree.cache_clear()
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(("system_name", "tries", "done"), [("nt", 2, True), ("nt", 99, False), ("posix", 1, False)])
def test_file_open_elsewhere_is_replaced_after_a_retry(system_name, tries, done, tmp_path, monkeypatch):
    """On Windows alone: elsewhere a refusal has another reason."""
    path, refused, replace = tmp_path / "status.json", [], os.replace
    path.write_text("old")

    def refuse(source, target):
        if len(refused) < tries:
            refused.append(source)
            raise PermissionError(errno.EACCES, "Access is denied")
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", refuse)
    monkeypatch.setattr(files.time, "sleep", lambda seconds: None)
    with monkeypatch.context() as patch:
        patch.setattr(files, "SYSTEM", system_name)
        if done:
            files.write_text(path, "new")
        else:
            with pytest.raises(OutputError, match=r"status\.json: cannot be written"):
                files.write_text(path, "new")
    assert path.read_text() == ("new" if done else "old")
    assert list(tmp_path.iterdir()) == [path]


def test_intel_runtime_on_windows_is_passed_to_the_loader(tmp_path, monkeypatch):
    library = tmp_path / "Library" / "bin" / "intelocl64.dll"
    library.parent.mkdir(parents=True)
    library.touch()
    monkeypatch.setattr(runtimes.sysconfig, "get_path", lambda name: str(tmp_path))
    monkeypatch.delenv("OCL_ICD_FILENAMES", raising=False)
    runtimes._add_intel_runtime()
    assert os.environ["OCL_ICD_FILENAMES"] == str(library)
    monkeypatch.setenv("OCL_ICD_FILENAMES", "own.dll")
    runtimes._add_intel_runtime()
    assert os.environ["OCL_ICD_FILENAMES"] == "own.dll"


def test_noexec_cache_is_named(monkeypatch, tmp_path):
    """What PoCL says in a container whose cache is a tmpfs with noexec, as docker mounts it by default."""
    said = "dlopen(\"/cache/pocl/a.so\") failed with '/cache/pocl/a.so: failed to map segment from shared object'."
    monkeypatch.setattr(runtimes, "run_module", lambda *words, **values: ChildResult(-6, said))
    monkeypatch.setattr(runtimes, "cache_folder", lambda: tmp_path)
    assert "mount it with `exec`, or set POCL_CACHE_DIR" in runtimes.probe_fault("key", 0, 0)
