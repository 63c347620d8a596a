"""The folder that a sweep is kept in, shared by all machines that work on it.

    cells/<key>/spec.json           what the key was made of, written first, never changed
                attempts/<uuid>/    an ordinary run folder, written by one process ever, with its lease.json
                result/             the attempt that came first, renamed, with its manifest.json
                failed.json         why it was given up
    prepared/                       what `prepare` makes
    undistorted/<scene>-<code>/     photographs without the distortion of their lenses, made once a host
    sweeps/<name>-<hash>.json       the cells of a matrix by their names
    cancel/all  cancel/<key>        that what began before is to stop
    events/<host>-<process>.jsonl   one file a process: no two append to one

Engines start a cell at least once.  A cell counts once: attempts share no file, its bits do not depend on who runs it,
and publishing is a rename.
"""

import hashlib
import json
import logging
import math
import os
import re
import shutil
import time
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError, DataError, OutputError
from clsplat.core.files import (
    CHECKPOINTS,
    LOCK,
    LOG_FILE,
    METRICS,
    PARTIAL,
    PREPARE_SUMMARY,
    PREPARED,
    RECORDS,
    STATUS,
    TRIAL,
    UNDISTORTED,
    make_folder,
    raising_output_error,
    sync_below,
    sync_folder,
    write_text,
)
from clsplat.core.machine import Owner
from clsplat.core.reading import read_file, read_json, sha256
from clsplat.formats.table import CODECS
from clsplat.runs.state import sum_of
from clsplat.sweeps.cell import CellRun
from clsplat.training import checkpoint
from clsplat.training.status import read_status

# Files of a run folder in another one: links where that is possible.

GROWING = frozenset({LOG_FILE, RECORDS, TRIAL})  # files that a run appends to: links of them would be one file


def copy_files(source: Path, target: Path, left_out: Collection[str]) -> None:
    """Let a folder hold the files of another, also those below it, but for these names at its top.

    Files in the way are replaced; half-written ones, and those that a process removes meanwhile, are left out.
    Raises OSError.
    """
    for base, folders, files in os.walk(source):
        here = Path(base).relative_to(source)
        is_top = here == Path()
        skipped = left_out if is_top else ()
        folders[:] = [name for name in folders if name not in skipped]
        (target / here).mkdir(parents=True, exist_ok=True)
        for name in files:
            if name in skipped or PARTIAL.fullmatch(name):
                continue
            (target / here / name).unlink(missing_ok=True)
            copy = shutil.copyfile if is_top and name in GROWING else link_or_copy
            with suppress(FileNotFoundError):
                copy(Path(base) / name, target / here / name)


def link_or_copy(source: Path, target: Path) -> None:
    """Let a file that is never changed in place have a second name, or copy it.  Raises OSError."""
    try:
        os.link(source, target)
    except FileExistsError:
        raise
    except OSError:
        if not source.exists():
            raise
        shutil.copyfile(source, target)


# An attempt at a cell: a run folder with a lease, and with a manifest when its run is done.

LEASE, MANIFEST, PIPELINE_FILE, ERRORS = "lease.json", "manifest.json", "cell.yaml", "errors.txt"
OWN = frozenset(
    {LEASE, MANIFEST, PIPELINE_FILE, ERRORS, STATUS, LOCK, PREPARE_SUMMARY}
)  # of one attempt alone; NOTE has a path
MEASURED = ("psnr", "ssim", "views")  # figures of metrics.json that a device's bits decide
BEAT = 10.0  # seconds between two beats of a lease
Rank = tuple[bool, int]  # of a checkpoint: whether it is of a refit, and its step


class LeaseLost(OutputError):
    """The folder of an attempt was removed while its run went on."""


class CellAttempt:
    """A folder below `attempts`, written by one process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values: dict[str, Any] = {}
        self._last = -math.inf

    def take_lease(self, worker: str, since: float) -> None:
        """Say who works here.  since: when its caller began, by the clock of the store.  Raises OutputError."""
        self._values = {**asdict(Owner.current()), "worker": worker, "since": since, "begun": time.time()}
        self._write()

    def beat(self) -> None:
        """Renew the lease where that is due.  Raises LeaseLost."""
        if time.monotonic() - self._last >= BEAT:
            self.require_lease()
            self._write()

    def require_lease(self) -> None:
        """Raise LeaseLost where its folder was removed."""
        if not (self.path / LEASE).is_file():
            raise LeaseLost(f"{self.path}: was removed while its run went on; run the sweep again")

    def end(self, exit_code: int) -> None:
        """Note how the run ended; a lost folder stays lost."""
        self._values["exit_code"] = exit_code
        if self.path.is_dir():
            self._write()

    def _write(self) -> None:
        write_text(self.path / LEASE, json.dumps({**self._values, "time": time.time()}) + "\n")
        self._last = time.monotonic()

    @cached_property
    def lease(self) -> dict[str, Any]:
        """What the lease says; nothing where it is missing or damaged."""
        with suppress(DataError):
            found = read_json(self.path / LEASE)
            return found if isinstance(found, dict) else {}
        return {}

    @property
    def exit_code(self) -> int | None:
        """How its run ended; None where it goes on, or its process was killed."""
        code = self.lease.get("exit_code")
        return code if isinstance(code, int) else None

    @property
    def has_failed(self) -> bool:
        return self.exit_code not in (None, 0, 130)

    @property
    def since(self) -> float:
        """When its caller began, by the clock of the store."""
        return float(self.lease.get("since", 0))

    @property
    def begun_at(self) -> Rank:
        """The checkpoint that it went on from."""
        return _rank_of(str(self.lease.get("from", "")))

    @property
    def beaten(self) -> float:
        """When its lease was renewed last, by the clock of the store."""
        for path in (self.path / LEASE, self.path):
            with suppress(OSError):
                return path.stat().st_mtime
        return math.inf

    def go_on_from(self, others: Iterable["CellAttempt"]) -> None:
        """Take what the attempt with the newest checkpoint that is whole has written: links where that is possible.

        A damaged checkpoint counts as none: the one before it is taken, of whatever attempt.  Raises OutputError.
        """
        for _, path, other in whole(others):
            own = self.path / CHECKPOINTS / path.name
            with raising_output_error(self.path):
                own.parent.mkdir(exist_ok=True)
                try:
                    link_or_copy(path, own)
                except FileNotFoundError:  # its process has removed it since
                    continue
                copy_files(other.path, self.path, {*OWN, CHECKPOINTS})
            self._values["from"] = path.name
            self._write()
            return

    def message(self, exit_code: int) -> str:
        """Return why its run failed: the line of its status, or the last that it printed."""
        if text := read_status(self.path).get("message"):
            return str(text)
        lines: list[str] = []
        with suppress(DataError):
            lines = read_file(self.path / ERRORS).decode(errors="replace").strip().splitlines()
        how = f"signal {-exit_code}" if exit_code < 0 else f"exit code {exit_code}"
        return lines[-1].removeprefix("error: ") if lines else f"its process ended with {how}"

    def manifest(self) -> dict[str, Any]:
        """Write the manifest: hashes of all files, and of the bits.  Return it.  Raises OutputError."""
        names = sorted(path.relative_to(self.path).as_posix() for path in self.path.rglob("*") if path.is_file())
        kept = [name for name in names if name not in (LEASE, MANIFEST, ERRORS, LOCK)]
        files = {name: sha256(self.path / name, kind=OutputError) for name in kept}
        values = {
            "attempt": self.path.name,
            "from": self._values.get("from"),
            "host": self._values.get("host"),
            "worker": self._values.get("worker"),
            "device": read_status(self.path).get("device"),
            "seconds": round(time.time() - self._values.get("begun", time.time()), 3),
            "bits": bits_of(self.path, files),
            "files": files,
        }
        write_text(self.path / MANIFEST, json.dumps(values, indent=1) + "\n")
        return values


def whole(attempts: Iterable[CellAttempt]) -> Iterator[tuple[Rank, Path, CellAttempt]]:
    """Yield the checkpoints of attempts that can be read, from the newest on: rank, file, and whose it is."""
    found = [(_rank_of(path.name), path, one) for one in attempts for path in checkpoint.saved(one.path)]
    for rank, path, one in sorted(found, key=lambda entry: entry[0], reverse=True):
        try:
            checkpoint.load(path)
        except (DataError, ConfigError):
            continue
        yield rank, path, one


def _rank_of(name: str) -> Rank:
    found = re.fullmatch(r"(step|refit)_(\d+)\.npz", name)
    return (found[1] == "refit", int(found[2])) if found else (False, 0)


def bits_of(folder: Path, files: dict[str, str]) -> str:
    """Return a hash of what a device computed: model files, and metrics without times.

    files: the hashes of the run's files, by name.
    """
    suffixes = tuple(suffix for codec in CODECS for suffix in codec.endings)
    models = {name: digest for name, digest in files.items() if name.lower().endswith(suffixes)}
    figures: dict[str, Any] = {}
    with suppress(DataError, AttributeError):
        metrics = read_json(folder / METRICS)
        figures = {key: metrics.get(key) for key in ("gaussians", "steps", "seed")}
        for split in ("test", "train", "validation"):
            for size, values in metrics.get(split, {}).items():
                figures[f"{split} {size}"] = [values.get(key) for key in MEASURED]
    return hashlib.sha256(json.dumps([models, figures], sort_keys=True).encode()).hexdigest()


# The folder of one cell: its attempts, and its result.

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

    def attempts(self) -> list[CellAttempt]:
        """Return the attempts that are there."""
        found = (self.path / ATTEMPTS).glob("*")
        return [CellAttempt(path) for path in found if NAME.fullmatch(path.name) and path.is_dir()]

    def begin(self, worker: str, since: float) -> CellAttempt:
        """Make a new attempt, which goes on from the newest checkpoint of all that is whole.  Raises OutputError."""
        attempt = CellAttempt(self.path / ATTEMPTS / uuid.uuid4().hex)
        with raising_output_error(attempt.path):
            make_folder(attempt.path)
            (self.path / FAILED).unlink(missing_ok=True)  # it is tried again
        attempt.take_lease(worker, since)
        attempt.go_on_from(other for other in self.attempts() if other.path != attempt.path)
        return attempt

    def failures(self, since: float) -> list[CellAttempt]:
        """Return the attempts of callers since a time that have failed and left no newer checkpoint that is whole."""
        attempts = self.attempts()
        newest = next((rank for rank, *_ in whole(attempts)), (False, 0))
        return [one for one in attempts if one.has_failed and one.since >= since and one.begun_at >= newest]

    def publish(self, attempt: CellAttempt) -> dict[str, Any]:
        """Rename an attempt with its manifest to the result; return the manifest of the result.

        Where another attempt came first, their bits are compared.

        Raises Different when they differ, LeaseLost where the attempt was removed, for its process slept too long.
        """
        attempt.require_lease()
        ours = attempt.manifest()
        with raising_output_error(attempt.path):
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


CELLS, EVENTS, SWEEPS, CANCEL = "cells", "events", "sweeps", "cancel"
ALL = "all"


class Store:
    """A store, as one process uses it.  Raises OutputError where it cannot be written."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        owner = Owner.current()
        self._own = f"{owner.host_slug}-{owner.process}"

    @classmethod
    def opened(cls, root: Path) -> "Store":
        """Return the store in a folder.  Raises DataError when it holds none."""
        if not (root / CELLS).is_dir():
            raise DataError(f"{root}: has no folder `{CELLS}`; expected the store of a sweep")
        return cls(root)

    @property
    def prepared(self) -> Path:
        """The folder of what `prepare` makes."""
        return self.root / PREPARED

    def undistorted(self, scene: str, code: str) -> Path:
        """Return the folder of the undistorted photographs of a scene.  Both are fingerprints, as in a cell's key."""
        return self.root / UNDISTORTED / f"{scene[:16]}-{code}"

    def folder(self, key: str) -> CellFolder:
        """Return the folder of a cell, which need not exist."""
        return CellFolder(self.root / CELLS / key)

    def folders(self) -> list[CellFolder]:
        """Return the folders of all cells."""
        return [CellFolder(path) for path in sorted((self.root / CELLS).glob("*")) if path.is_dir()]

    def now(self) -> float:
        """Return the time by the clock of the store's file system, in seconds, which all machines share."""
        clock = self.root / EVENTS / f".{self._own}.clock"
        with raising_output_error(clock):
            make_folder(clock.parent)
            clock.touch()
            return clock.stat().st_mtime

    def tell(self, event: str, **values: Any) -> None:
        """Append an event to the file of this process."""
        path = self.root / EVENTS / f"{self._own}.jsonl"
        with raising_output_error(path):
            make_folder(path.parent)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"time": round(time.time(), 3), "event": event, **values}) + "\n")

    def events(self) -> list[dict[str, Any]]:
        """Return what all processes have told, in order of time; a line that a crash has cut is left out."""
        found: list[dict[str, Any]] = []
        for path in (self.root / EVENTS).glob("*.jsonl"):
            for line in read_file(path).decode(errors="replace").splitlines() if path.is_file() else ():
                with suppress(ValueError):
                    event = json.loads(line)
                    found += [event] if isinstance(event, dict) and isinstance(event.get("time"), float | int) else []
        return sorted(found, key=lambda event: float(event["time"]))

    def note_sweep(self, name: str, keys: Mapping[str, str], text: str) -> None:
        """Write the cells of a matrix, by name, for those who look at the store.

        text: what tells this matrix from others of its name, such as its file.
        """
        file = f"{name[:50]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}.json"
        write_text(self.root / SWEEPS / file, json.dumps({"name": name, "cells": keys}, indent=1) + "\n")

    def sweeps(self) -> list[tuple[str, dict[str, str]]]:
        """Return the name of each matrix, and its cells: keys by the cells' names."""
        found = []
        for path in sorted((self.root / SWEEPS).glob("*.json")):
            with suppress(DataError, KeyError, TypeError, AttributeError):
                values = read_json(path)
                cells = {str(name): str(key) for name, key in values["cells"].items()}
                found.append((str(values["name"]), cells))
        return found

    def add(self, cell: CellRun) -> CellFolder:
        """Return the folder of a cell, with its spec.json.  Raises OutputError where that is another one's."""
        folder = self.folder(cell.key)
        folder.write_spec(cell.spec)
        return folder

    def cancel(self, cell: str | None = None) -> str:
        """Ask that all cells that have begun stop, or one of them, by its name or key; return what was asked for.

        Raises ConfigError when there is no such cell.
        """
        name = ALL if cell is None else self.key_of(cell)
        self.stop(name)
        self.tell("cancel", cell=name)
        return name

    def stop(self, name: str) -> None:
        """Let what began under a name, or all, stop."""
        flag = self.root / CANCEL / name
        with raising_output_error(flag):
            make_folder(flag.parent)
            flag.touch()
            os.utime(flag)

    def is_cancelled(self, names: Sequence[str], since: float) -> bool:
        """Return whether something that began at a time of `now`, with keys or names, is to stop."""
        for name in (ALL, *filter(None, names)):
            with suppress(OSError):
                if (self.root / CANCEL / name).stat().st_mtime >= since:
                    return True
        return False

    def key_of(self, cell: str) -> str:
        """Return the key of a cell by its name in a sweep, or by its key or the beginning of that.

        Of several cells of a name it is the one that is not published.
        """
        named = {key for _, cells in self.sweeps() for name, key in cells.items() if name == cell}
        named = {key for key in named if not self.folder(key).result.is_dir()} or named
        named = named or {folder.key for folder in self.folders() if folder.key.startswith(cell)}
        if len(named) != 1:
            fault = f"{len(named)} cells are named so; give a key" if named else "`clsplat status` lists the cells"
            raise ConfigError(f"{self.root}: no cell '{cell}'; {fault}")
        return named.pop()
