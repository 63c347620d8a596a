"""Uses of a device in progress: after one that ended without a word, as with a signal, the device is checked again.

A file of built kernels that is cut off ends a process so, and the record of an earlier check says nothing about it.
"""

import atexit
import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from clsplat.errors import DataError, OutputError
from clsplat.files import write_text
from clsplat.processes import Owner
from clsplat.reading import read_json

FOLDER = "in_use"
_own: set[Path] = set()  # marks of this process


def begin(records: Sequence[Path]) -> None:
    """Mark the records of a device as in use by this process, until it ends in an orderly way."""
    folder, owner = records[0].parent.parent / FOLDER, Owner.this()
    place = hashlib.sha256(repr(owner).encode()).hexdigest()[:8]  # containers with one cache have equal numbers
    mark = folder / f"{owner.process}-{place}-{records[0].name}.json"
    if mark not in _own:
        with suppress(OutputError):
            write_text(mark, json.dumps({**asdict(owner), "records": [record.name for record in records]}))
            _own.add(mark)
            atexit.register(_end, mark)


def forget_after_sudden_ends(cache: Path) -> None:
    """Remove the records in a folder of caches that a process used which has ended and left its mark."""
    for mark in {*(cache / FOLDER).glob("*.json")} - _own:
        try:
            values = read_json(mark)
        except DataError:
            continue
        owner = Owner.named_by(values) if isinstance(values, dict) else None
        # the first process of every container has the same number
        if owner is not None and (owner.process == os.getpid() or owner.has_ended):
            with suppress(OSError):
                names = values.get("records")
                for name in names if isinstance(names, list) else ():
                    with suppress(ValueError):  # no name of a file
                        (cache / "conformance" / Path(str(name)).name).unlink(missing_ok=True)
                mark.unlink(missing_ok=True)


def _end(mark: Path) -> None:
    with suppress(OSError):
        mark.unlink(missing_ok=True)
