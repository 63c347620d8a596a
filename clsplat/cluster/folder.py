"""The folder of one cell: its attempts, and its result."""

import json
import logging
import os
import re
import shutil
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.cluster.attempt import LEASE, MANIFEST, Attempt, whole
from clsplat.errors import DataError, OutputError
from clsplat.files import make_folder, sync_below, sync_folder, told_as, write_text
from clsplat.reading import read_json
from clsplat.runs.found import sum_of

LOG = logging.getLogger("clsplat")
SPEC, ATTEMPTS, RESULT, FAILED = "spec.json", "attempts", "result", "failed.json"
NAME = re.compile("[0-9a-f]{32}")  # of an attempt
SILENT = 600.0  # seconds without a beat of its lease after which an attempt may be removed


class Different(OutputError):
    """Two runs of one cell, on devices of one bits class, have come to other bits."""


class CellFolder:
    """The folder of a cell in a store."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.result = path / RESULT

    @property
    def key(self) -> str:
        return self.path.name

    def write_spec(self, spec: Mapping[str, Any]) -> None:
        """Write what the key was made of, once, or again where it is damaged: the key is the hash of it.

        Raises OutputError where another one stands there.
        """
        file = self.path / SPEC
        try:
            before = read_json(file) if file.exists() else None
        except DataError as error:
            LOG.warning("%s; it is written again", error)
            before = None
        if before is None:
            write_text(file, json.dumps(spec, indent=1, sort_keys=True) + "\n")
        elif before != spec:
            raise OutputError(f"{file}: is of another cell, or was changed; remove {self.path}: its cell runs again")

    def manifest(self) -> dict[str, Any] | None:
        """Return what the manifest of the result says, unchecked; None where nothing was published."""
        with suppress(DataError):
            found = read_json(self.result / MANIFEST)
            if isinstance(found, dict) and isinstance(found.get("files"), dict) and found.get("bits"):
                return found
        return None

    def published(self) -> dict[str, Any] | None:
        """Return the manifest of the result, whose files were compared with their hashes; None where there is none.

        A damaged result becomes an attempt again, so that the cell goes on from its checkpoint.
        """
        if not self.result.is_dir():
            return None
        found = self.manifest()
        if found and all(sum_of(self.result / name) == digest for name, digest in found["files"].items()):
            return found
        with suppress(OSError):  # or another process has done so
            make_folder(self.path / ATTEMPTS)
            os.rename(self.result, self.path / ATTEMPTS / uuid.uuid4().hex)
        return None

    def attempts(self) -> list[Attempt]:
        """Return the attempts that are there."""
        found = (self.path / ATTEMPTS).glob("*")
        return [Attempt(path) for path in found if NAME.fullmatch(path.name) and path.is_dir()]

    def begin(self, worker: str, since: float) -> Attempt:
        """Make a new attempt, which goes on from the newest checkpoint of all that is whole.  Raises OutputError."""
        attempt = Attempt(self.path / ATTEMPTS / uuid.uuid4().hex)
        with told_as(attempt.path):
            make_folder(attempt.path)
            (self.path / FAILED).unlink(missing_ok=True)  # it is tried again
        attempt.take_lease(worker, since)
        attempt.go_on_from(other for other in self.attempts() if other.path != attempt.path)
        return attempt

    def failures(self, since: float) -> list[Attempt]:
        """Return the attempts of callers since a time that have failed and left no newer checkpoint that is whole."""
        attempts = self.attempts()
        newest = next((rank for rank, *_ in whole(attempts)), (False, 0))
        return [one for one in attempts if one.has_failed and one.since >= since and one.begun_at >= newest]

    def publish(self, attempt: Attempt) -> dict[str, Any]:
        """Rename an attempt with its manifest to the result; return the manifest of the result.

        Where another attempt came first, their bits are compared.

        Raises Different when they differ, LeaseLost where the attempt was removed, for its process slept too long.
        """
        attempt.require_lease()
        ours = attempt.manifest()
        with told_as(attempt.path):
            sync_below(attempt.path)
        with suppress(OSError):
            os.rename(attempt.path, self.result)
            sync_folder(self.path)
            with suppress(OSError):
                (self.result / LEASE).unlink()
                (self.path / FAILED).unlink(missing_ok=True)
            return ours
        os.listdir(self.path)  # NFS: what was read of the folder before may be old
        theirs = self.manifest()
        if theirs is None:
            raise OutputError(f"{self.result}: cannot be written, and holds no result; check the folder and its space")
        if theirs["bits"] != ours["bits"]:
            raise Different(
                f"{self.path}: the same cell on devices of one bits class gave other bits: those of {self.result} on "
                f"{theirs.get('device')}, of {attempt.path} on {ours.get('device')}; one of them computes wrongly: "
                "`clsplat doctor` tells which"
            )
        return theirs

    def give_up(self, exit_code: int, message: str) -> None:
        """Write why the cell was given up."""
        codes = [attempt.exit_code for attempt in self.attempts() if attempt.exit_code is not None]
        text = json.dumps({"exit_code": exit_code, "message": message, "exit_codes": codes}, indent=1)
        write_text(self.path / FAILED, text + "\n")

    def failed(self) -> dict[str, Any] | None:
        """Return why the cell was given up; None where it was not."""
        with suppress(DataError):
            found = read_json(self.path / FAILED)
            return found if isinstance(found, dict) else None
        return None

    def collect(self, now: float) -> None:
        """Remove the attempts of a published cell whose lease had no beat for `SILENT` seconds.

        now: by the clock of the store.  No other attempt is touched: its process may be at work.
        """
        if self.manifest() is None:
            return
        for attempt in self.attempts():
            if now - attempt.beaten > SILENT:
                shutil.rmtree(attempt.path, ignore_errors=True)
