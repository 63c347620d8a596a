"""Who holds a folder: what the file of its lock says, and what is told of it."""

import io
import json
import logging
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clsplat.errors import DataError, OutputError, shortened
from clsplat.names import END_STATES, SILENT, STATUS
from clsplat.processes import Owner
from clsplat.reading import read_json

LOG = logging.getLogger("clsplat")
BEHIND_THE_TEXT = 1 << 20  # bytes: Windows locks a byte for readers too, and this one is not read


def own_text() -> str:
    """What the file says of this process."""
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return json.dumps({**asdict(Owner.this()), "time": time.time(), "command": command})


def read(file: io.FileIO) -> dict[str, Any]:
    """Who the file names; nobody where it is empty or damaged."""
    try:
        file.seek(0)
        owner = json.loads(file.read(BEHIND_THE_TEXT))
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def require_silent(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Who the file names, where that is a process of another machine, whose locks may not reach this one; else {}.

    Machines may have the same name: where the systems say which start they are of, that counts.
    Raises OutputError where the run's status beside the file shows that it goes on.
    """
    owner = read(file)
    named, this = Owner.named_by(owner), Owner.this()
    if named is None or (named.boot == this.boot if owner.get("boot") and this.boot else named.host == this.host):
        return {}
    beat = _heartbeat(path)
    if beat is not None and (silent := time.time() - beat) < SILENT:
        raise OutputError(
            f"{in_use(folder, owner)}; its heartbeat is {max(0, silent):.0f} s old, though the lock is free here: "
            f"if that process has ended, wait for a minute, or remove {path}"
        )
    return owner


def until_silent(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Do as `require_silent`, but wait for the next heartbeat: where none comes in time, the process has ended.

    That it comes counts, not its time: the clocks of two machines may differ.
    """
    beat, end, told = _heartbeat(path), time.monotonic() + SILENT, False
    while True:
        try:
            return require_silent(file, path, folder)
        except OutputError:
            if _heartbeat(path) != beat:
                raise
            if time.monotonic() >= end:
                return read(file)
            if not told:
                told = True
                LOG.info("%s: was in use elsewhere just now; waiting for its heartbeat, a minute at most", folder)
        time.sleep(1)


def _heartbeat(path: Path) -> float | None:
    """When the status beside a lock was written, in seconds since 1970; None where there is none, or the run ended."""
    with suppress(DataError, AttributeError, KeyError, TypeError, ValueError):
        status = read_json(path.with_name(STATUS), limit=BEHIND_THE_TEXT)
        return None if status.get("state") in END_STATES else float(status["time"])
    return None


def lost(path: Path, folder: Path) -> str:
    """What to tell of a lock whose file is no longer at its path."""
    try:
        owner = read_json(path, limit=BEHIND_THE_TEXT)
        by = f", and process {owner['process']} on {owner['host']} holds it now"
    except (DataError, KeyError, TypeError):
        by = ""
    return (
        f"{folder}: {path.name} was removed or replaced while this process held it{by}; nothing more was written; "
        "to go on, resume the run when no other process uses it"
    )


def in_use(folder: Path, owner: dict[str, Any]) -> str:
    if not owner:
        return f"{folder}: is in use by another process"
    try:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(owner.get("time", 0))))
    except (TypeError, ValueError, OverflowError, OSError):
        since = "an unknown time"
    return (
        f"{folder}: is in use by process {owner.get('process')} on {owner.get('host')} since {since} "
        f"({shortened(str(owner.get('command')))}); wait for it, or give another folder"
    )
