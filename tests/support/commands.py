"""A command in the process of the tests: a start costs a second, and few tests are about one.

`process` starts one: for what a runtime prints, for signals, locks, and what a start imports.
"""

import contextlib
import io
import logging
import subprocess
import sys
from pathlib import Path
from unittest import mock

from clsplat import cli

LOG = logging.getLogger("clsplat")


def ran(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command.  What a plug-in registers stays for later tests: use `without_plugins`, or `process`."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    words, handlers, level = ["clsplat", *map(str, arguments)], list(LOG.handlers), LOG.level
    with mock.patch.object(sys, "argv", words), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
        finally:
            LOG.handlers[:] = handlers
            LOG.setLevel(level)
    texts = [stream.buffer.getvalue().decode() for stream in (out, err)]
    return subprocess.CompletedProcess(words, code, *texts)


def clsplat(*arguments: str | Path, expect: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command; check its exit code and that an error is one line without a traceback."""
    return checked(ran(*arguments), expect)


def process(*arguments: str | Path, expect: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own; check what `clsplat` checks."""
    command = [sys.executable, "-m", "clsplat", *map(str, arguments)]
    return checked(subprocess.run(command, capture_output=True, text=True, timeout=120, check=False), expect)


def checked(done: subprocess.CompletedProcess[str], expect: int) -> subprocess.CompletedProcess[str]:
    """Return what ended with this code, without a traceback, and with one line for an error."""
    assert done.returncode == expect, done.stderr
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == (1 if expect else 0), done.stderr
    return done
