"""The cache folder, and its fallback if the user's folder is not writable."""

import logging
import os
import shutil
import sqlite3
import stat
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import platformdirs
import pytest

from clsplat.core.child import ChildResult
from clsplat.core.errors import OutputError
from clsplat.core.machine import cache_folder
from clsplat.opencl import runtimes
from clsplat.opencl.device import Device
from clsplat.opencl.kernel_caches import kernel_cache_advice, kernel_caches, remove_broken_kernels, require_space

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the folders of Linux")


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A temporary home and temporary folder, without cache variables."""
    for name in ("home", "tmp"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for name in ("XDG_CACHE_HOME", "POCL_CACHE_DIR"):
        monkeypatch.setenv(name, "")  # so that what the test sets is taken back
        monkeypatch.delenv(name)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    for once in (cache_folder, remove_broken_kernels):
        once.cache_clear()
    yield tmp_path
    for once in (cache_folder, remove_broken_kernels):
        once.cache_clear()


@pytest.fixture
def user_folder(machine: Path) -> Path:
    """The user's folder below the temporary one."""
    return machine / "tmp" / f"clsplat-{os.getuid()}"


@linux
def test_writable_user_folder_is_used(machine, caplog):
    assert cache_folder() == machine / "home" / ".cache" / "clsplat"
    assert cache_folder().is_dir()
    assert "XDG_CACHE_HOME" not in os.environ
    assert not caplog.records


def put_file(machine: Path, place: str) -> None:
    shutil.rmtree(machine / place, ignore_errors=True)
    (machine / place).parent.mkdir(parents=True, exist_ok=True)
    (machine / place).write_text("a file cannot hold a folder")


@linux
@pytest.mark.parametrize("place", ["home", "home/.cache", "home/.cache/pocl", "home/.cache/pytools"])
def test_caches_move_if_home_or_library_cache_is_read_only(machine, user_folder, place, caplog):
    put_file(machine, place)
    assert cache_folder() == user_folder / "clsplat"
    assert os.environ["XDG_CACHE_HOME"] == str(user_folder)
    assert platformdirs.user_cache_dir("pyopencl", "pyopencl") == str(user_folder / "pyopencl")
    assert stat.S_IMODE(user_folder.stat().st_mode) == 0o700
    cache_folder()
    (record,) = caplog.records  # once
    assert record.levelno == logging.WARNING
    assert str(machine / place) in record.getMessage()
    assert f"using {user_folder} for caches instead" in record.getMessage()


@linux
def test_caches_move_where_built_kernels_do_not_fit(machine, user_folder, monkeypatch, caplog):
    """LLVM aborts the process when the disk is full."""
    full = machine / "kernels"
    monkeypatch.setenv("POCL_CACHE_DIR", str(full))
    free = {full: 2**18}
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free.get(folder, 2**30)))
    assert cache_folder() == user_folder / "clsplat"
    assert (
        f"{full}: has only 256 KiB of free space, too little for built kernels; using {user_folder} for caches"
        in caplog.text
    )
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=2**18))
    with pytest.raises(OutputError, match=r"has only 256 KiB of free space, .* free up space, or set XDG_CACHE_HOME"):
        require_space()


@linux
def test_caches_move_if_the_user_has_no_home(machine, user_folder, monkeypatch, caplog):
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", lambda user: {}[user])
    assert cache_folder() == user_folder / "clsplat"
    assert "there is no home folder" in caplog.text


@linux
def test_caches_move_if_the_pocl_folder_is_read_only(machine, user_folder, monkeypatch):
    put_file(machine, "kernels")
    monkeypatch.setenv("POCL_CACHE_DIR", str(machine / "kernels"))
    cache_folder()
    assert os.environ["POCL_CACHE_DIR"] == str(user_folder / "pocl")


@linux
def test_writable_pocl_folder_stays(machine, monkeypatch):
    monkeypatch.setenv("POCL_CACHE_DIR", str(machine / "kernels"))
    cache_folder()
    assert os.environ["POCL_CACHE_DIR"] == str(machine / "kernels")


@linux
@pytest.mark.parametrize("trap", ["open to all", "a link", "a file", "dangling"])
def test_world_writable_temporary_folder_is_not_used(machine, user_folder, trap):
    put_file(machine, "home")
    if trap == "open to all":
        user_folder.mkdir()
        user_folder.chmod(0o777)
    elif trap == "a file":
        user_folder.write_text("")
    else:
        target = machine / "elsewhere"
        if trap == "a link":
            target.mkdir(mode=0o700)
        user_folder.symlink_to(target)
    folder = cache_folder()
    assert user_folder not in folder.parents
    assert folder.parents[1] == machine / "tmp"
    assert stat.S_IMODE(folder.parent.stat().st_mode) == 0o700


@linux
def test_error_without_writable_folder_names_the_variable(machine, monkeypatch):
    put_file(machine, "home")
    put_file(machine, "tmp")
    with pytest.raises(OutputError, match=r"no cache folder works .*; set XDG_CACHE_HOME or TMPDIR"):
        cache_folder()


@linux
@pytest.mark.slow
def test_device_works_without_a_home(tmp_path):
    """As in a container: no user name, no home folder, and only /tmp is writable."""
    (tmp_path / "file").write_text("")
    variables = {"HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-m", "clsplat", "devices"]
    done = subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "state     works" in done.stdout
    assert done.stderr.count("\n") == 1
    assert "for caches instead" in done.stderr


@linux
@pytest.mark.parametrize("free", [0, 2**30])
def test_full_folder_is_not_reported_as_damaged(machine, monkeypatch, free):
    cache_folder()
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    text = kernel_cache_advice()
    assert ("has only 0 KiB of free space, too little for built kernels; free up space" in text) == (not free)
    assert ("is damaged: remove" in text) == bool(free)


def library(sections: int) -> bytes:
    """A file as a linker writes it, in short: a header, code, and at its end a table of sections."""
    head = struct.pack(
        "<4s5B7x2HI3QI6H", b"\x7fELF", 2, 1, 1, 0, 0, 3, 62, 1, 0, 64, 500, 0, 64, 56, 1, 64, sections, 1
    )
    return head + bytes(500 - len(head) + 64 * sections)


def kernel(base: str, name: str) -> str:
    """Where PoCL keeps a kernel."""
    return (
        Path(base) / "EJ" / "DJJFLNOJFIADELNGLENLPDIGKEKLICMJHAOIO" / name / "16-1-1-goffs0" / f"{name}.so"
    ).as_posix()


@linux
def test_only_truncated_kernels_are_removed(machine, caplog):
    """Kernels being written by another process, and foreign files, stay."""
    pocl, pytools = (machine / "home" / ".cache" / name for name in ("pocl", "pytools"))
    whole, database = library(3), b"SQLite format 3\0" + bytes(84)
    files = {
        **{kernel("kcache", name): whole[:size] for name, size in (("empty", 0), ("head", 60), ("table", 690))},
        kernel("kcache", "zeros"): bytes(692),
        kernel("kcache", "whole"): whole,
        kernel("kcache", "bare"): library(0),
        kernel("", "empty"): b"",  # without a folder between, as below POCL_CACHE_DIR
        "kcache/AB/C/program.bc": b"",
        "kcache/tempfile_abc.so": b"",
        kernel("", "tempfile").replace("/tempfile.so", "/tempfile_abc.so"): b"",
        "libm.so": b"/* GNU ld script */ GROUP ( /lib/libm.so.6 )",
        "project/AB/lib/1-1-1/lib.so": b"GROUP ( /lib/libm.so.6 )",
        "AB/project/lib/1-1-1/lib.so": b"GROUP ( /lib/libm.so.6 )",
    }
    for name, data in files.items():
        (pocl / name).parent.mkdir(parents=True, exist_ok=True)
        (pocl / name).write_bytes(data)
    pytools.mkdir(parents=True)
    for name, data in {"scan": bytes(50), "invoker": database, "head": database[:50], "new": b""}.items():
        (pytools / f"pdict-v5-pyopencl-{name}-cache.sqlite").write_bytes(data)
    (pytools / "pdict-v5-another.sqlite").write_bytes(b"of others")
    remove_broken_kernels()
    left = {file.relative_to(pocl).as_posix() for file in pocl.rglob("*") if file.is_file()}
    cut = {kernel("kcache", name) for name in ("empty", "head", "table", "zeros")}
    assert files.keys() - left == {*cut, kernel("", "empty")}
    assert {file.name.split("-")[-2] for file in pytools.iterdir()} == {"invoker", "new", "v5"}
    (record,) = caplog.records
    assert record.getMessage().startswith("removed 7 truncated files from the kernel cache (")
    remove_broken_kernels()
    assert len(caplog.records) == 1


@linux
def test_kernels_are_examined_once_after_each_boot(machine, monkeypatch):
    """Also after a change of the folder."""
    first, second = (machine / folder / kernel("", "empty") for folder in ("first", "second"))
    start = {"now": "1"}
    monkeypatch.setattr("clsplat.core.machine._boot_id", lambda: start["now"])

    def cut(file: Path) -> bool:
        """Return whether a new process finds a truncated kernel."""
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
        remove_broken_kernels.cache_clear()
        remove_broken_kernels()
        return not file.exists()

    monkeypatch.setenv("POCL_CACHE_DIR", str(machine / "first"))
    assert [cut(first), cut(first)] == [True, False]
    monkeypatch.setenv("POCL_CACHE_DIR", str(machine / "second"))
    assert [cut(second), cut(second)] == [True, False]
    start["now"] = "2"
    assert cut(second)
    start["now"] = ""
    assert [cut(second), cut(second)] == [True, True], "a system that does not tell its starts apart"


@linux
@pytest.mark.parametrize("page", [512, 65536])
def test_truncated_database_is_removed_unless_being_written(page, machine):
    pytools = machine / "home" / ".cache" / "pytools"
    pytools.mkdir(parents=True)
    whole = pytools / "pdict-v5-pyopencl-whole.sqlite"
    with closing(sqlite3.connect(whole)) as database:
        database.execute(f"PRAGMA page_size = {page}")
        database.execute("CREATE TABLE dict (keyhash BLOB)")
        database.execute("INSERT INTO dict VALUES (zeroblob(99999))")
        database.commit()
    data = whole.read_bytes()
    for name, size in (("cut", len(data) // 2), ("last", len(data) - 1), ("journal", page), ("wal", page)):
        (pytools / f"pdict-v5-pyopencl-{name}.sqlite").write_bytes(data[:size])
    for name in ("journal", "wal"):
        (pytools / f"pdict-v5-pyopencl-{name}.sqlite-{name}").write_bytes(b"of a writer")
    old = data[:92] + bytes(8) + data[100:page]  # by a writer that keeps no count
    (pytools / "pdict-v5-pyopencl-old.sqlite").write_bytes(old)
    remove_broken_kernels()
    left = {file.stem.split("-")[-1] for file in pytools.glob("*.sqlite")}
    assert left == {"whole", "journal", "wal", "old"}


@pytest.fixture
def broken(machine: Path) -> Path:
    """A damaged table of pyopencl's."""
    file = machine / "home" / ".cache" / "pytools" / "pdict-v5-pyopencl-invoker-cache.sqlite"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"fifty bytes")
    return file


@linux
def test_device_is_tested_without_its_truncated_kernels(broken, monkeypatch):
    def probe(*arguments, **values):
        assert not broken.exists()
        return ChildResult(0, "")

    monkeypatch.setattr(runtimes, "run_module", probe)
    assert runtimes.probe_fault("key", 0, 0) is None
    assert not broken.exists()


@linux
@pytest.mark.slow
def test_known_device_opens_without_its_truncated_kernels(broken, info):
    Device(info)
    assert not broken.exists()


@linux
def test_remedy_names_every_kernel_folder(machine):
    caches = machine / "home" / ".cache"
    assert kernel_caches() == f"{caches}/pyopencl, {caches}/pytools and {caches}/pocl"
