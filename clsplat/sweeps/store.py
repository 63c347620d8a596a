"""Store the cells of a sweep in a folder that all machines share.

    cells/<key>/spec.json           the values whose hash is the key; written first, never changed
                attempts/<uuid>/    an ordinary run folder, written by a single process, with a lease.json
                result/             the first attempt that finished, renamed, with its manifest.json
                failed.json         the reason if the cell failed
    prepared/                       output of `prepare`
    undistorted/<scene>-<code>/     undistorted photos, computed once per host
    sweeps/<name>-<hash>.json       the keys of the cells of a matrix, by name
    cancel/all  cancel/<key>        requests to stop cells that started before the request
    events/<host>-<process>.jsonl   one file per process, so that no two append to the same file

Engines may start a cell more than once, but each cell has a single result: attempts share no files, the bits do not
depend on the process that runs the cell, and a result is published by a rename.
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
from clsplat.runs.state import try_sha256
from clsplat.sweeps.cell import CellRun, is_key
from clsplat.training import checkpoint
from clsplat.training.status import read_status

# Copies of a run folder, by hard links if possible.

GROWING = frozenset({LOG_FILE, RECORDS, TRIAL})  # a run appends to these files, so they are copied, not linked


def copy_files(source: Path, target: Path, excluded: Collection[str]) -> None:
    """Copy a folder recursively.  Raises OSError.

    excluded: names at the top level that are not copied.  Existing files are replaced.  Partial files, and files that
    disappear during the copy, are skipped.
    """
    for base, folders, files in os.walk(source):
        relative = Path(base).relative_to(source)
        is_root = relative == Path()
        skipped_names = excluded if is_root else ()
        folders[:] = [name for name in folders if name not in skipped_names]
        if not is_root and (target / relative).is_symlink():  # a link may point outside of the target
            (target / relative).unlink()
        (target / relative).mkdir(parents=True, exist_ok=True)
        for name in files:
            if name in skipped_names or PARTIAL.fullmatch(name):
                continue
            (target / relative / name).unlink(missing_ok=True)
            copy = shutil.copyfile if is_root and name in GROWING else link_or_copy
            with suppress(FileNotFoundError):
                copy(Path(base) / name, target / relative / name)


def link_or_copy(source: Path, target: Path) -> None:
    """Hard-link a file, or copy it if links are not possible.  Raises OSError.

    The files may share their data, so neither may be modified in place.
    """
    try:
        os.link(source, target)
    except FileExistsError:
        raise
    except OSError:
        if not source.exists():
            raise
        shutil.copyfile(source, target)


# An attempt at a cell: a run folder with a lease, and a manifest once the run is done.

LEASE, MANIFEST, PIPELINE_FILE, ERRORS = "lease.json", "manifest.json", "cell.yaml", "errors.txt"
# files that are not copied to other attempts; PREPARE_SUMMARY contains a path
ATTEMPT_FILES = frozenset({LEASE, MANIFEST, PIPELINE_FILE, ERRORS, STATUS, LOCK, PREPARE_SUMMARY})
MEASURED = ("psnr", "ssim", "views")  # values of metrics.json that depend only on bits, not on time
BEAT_INTERVAL_S = 10.0  # seconds between two heartbeats of a lease
Rank = tuple[bool, int]  # order of checkpoints: whether it belongs to a refit, and its step


class LeaseLost(OutputError):
    """The folder of an attempt was removed during its run."""


class CellAttempt:
    """An attempt at a cell: a run folder that a single process writes, with a lease."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values: dict[str, Any] = {}
        self._last = -math.inf

    def take_lease(self, worker: str, since: float) -> None:
        """Write the lease.  Raises OutputError.

        since: when the sweep that requested the cell started, by the store's clock.
        """
        self._values = {**asdict(Owner.current()), "worker": worker, "since": since, "begun": time.time()}
        self._write()

    def beat(self) -> None:
        """Renew the lease if it is older than BEAT_INTERVAL_S seconds.  Raises LeaseLost."""
        if time.monotonic() - self._last >= BEAT_INTERVAL_S:
            self.require_lease()
            self._write()

    def require_lease(self) -> None:
        """Raise LeaseLost if the folder of the attempt was removed."""
        if not (self.path / LEASE).is_file():
            raise LeaseLost(f"{self.path}: the folder was removed during its run; run the sweep again")

    def end(self, exit_code: int) -> None:
        """Record the exit code of the run, unless the folder was removed."""
        self._values["exit_code"] = exit_code
        if self.path.is_dir():
            self._write()

    def _write(self) -> None:
        write_text(self.path / LEASE, json.dumps({**self._values, "time": time.time()}) + "\n")
        self._last = time.monotonic()

    @cached_property
    def lease(self) -> dict[str, Any]:
        """The content of the lease; empty if the lease is missing or damaged."""
        with suppress(DataError):
            lease = read_json(self.path / LEASE)
            return lease if isinstance(lease, dict) else {}
        return {}

    @property
    def exit_code(self) -> int | None:
        """The exit code of the run; None if the run has not ended, or if its supervisor was killed."""
        code = self.lease.get("exit_code")
        return code if isinstance(code, int) and abs(code) < 1 << 32 else None

    @property
    def has_failed(self) -> bool:
        return self.exit_code not in (None, 0, 130)

    @property
    def since(self) -> float:
        """When the sweep that requested the cell started, by the store's clock; 0 if unknown."""
        return finite_number(self.lease.get("since")) or 0.0

    @property
    def start_rank(self) -> Rank:
        """The rank of the checkpoint from which the attempt continued."""
        return _parse_rank(str(self.lease.get("from", "")))

    @property
    def last_beat(self) -> float:
        """The time at which the lease was last renewed, by the clock of the store."""
        for path in (self.path / LEASE, self.path):
            with suppress(OSError):
                return path.stat().st_mtime
        return math.inf

    def continue_from(self, others: Iterable["CellAttempt"]) -> None:
        """Copy the newest readable checkpoint and the other files of its attempt, by hard links if possible.

        Damaged checkpoints are skipped.  Raises OutputError.
        """
        for _, path, source in readable_checkpoints(others):
            target = self.path / CHECKPOINTS / path.name
            with raising_output_error(self.path):
                target.parent.mkdir(exist_ok=True)
                try:
                    link_or_copy(path, target)
                except FileNotFoundError:  # the process of that attempt has removed it
                    continue
                copy_files(source.path, self.path, {*ATTEMPT_FILES, CHECKPOINTS})
            self._values["from"] = path.name
            self._write()
            return

    def message(self, exit_code: int) -> str:
        """Return the reason why the run failed: the message in its status, or the last line that it printed."""
        if status_message := read_status(self.path).get("message"):
            return str(status_message)
        lines: list[str] = []
        with suppress(DataError):
            lines = read_file(self.path / ERRORS).decode(errors="replace").strip().splitlines()
        cause = f"signal {-exit_code}" if exit_code < 0 else f"exit code {exit_code}"
        return lines[-1].removeprefix("error: ") if lines else f"its process ended with {cause}"

    def write_manifest(self) -> dict[str, Any]:
        """Write and return the manifest, with hashes of all files and of the bits.  Raises OutputError."""
        names = sorted(path.relative_to(self.path).as_posix() for path in self.path.rglob("*") if path.is_file())
        hashed_names = [name for name in names if name not in (LEASE, MANIFEST, ERRORS, LOCK)]
        files = {name: sha256(self.path / name, error_type=OutputError) for name in hashed_names}
        values = {
            "attempt": self.path.name,
            "from": self._values.get("from"),
            "host": self._values.get("host"),
            "worker": self._values.get("worker"),
            "device": read_status(self.path).get("device"),
            "seconds": round(time.time() - self._values.get("begun", time.time()), 3),
            "bits": hash_bits(self.path, files),
            "files": files,
        }
        write_text(self.path / MANIFEST, json.dumps(values, indent=1) + "\n")
        return values


def readable_checkpoints(attempts: Iterable[CellAttempt]) -> Iterator[tuple[Rank, Path, CellAttempt]]:
    """Yield the rank, file, and attempt of each readable checkpoint, newest first."""
    entries = [
        (_parse_rank(path.name), path, attempt) for attempt in attempts for path in checkpoint.list_files(attempt.path)
    ]
    for rank, path, attempt in sorted(entries, key=lambda entry: entry[0], reverse=True):
        try:
            checkpoint.load(path)
        except (DataError, ConfigError):
            continue
        yield rank, path, attempt


def _parse_rank(name: str) -> Rank:
    match = re.fullmatch(r"(step|refit)_(\d{1,18})\.npz", name)
    return (match[1] == "refit", int(match[2])) if match else (False, 0)


def hash_bits(folder: Path, files: dict[str, str]) -> str:
    """Return a hash of everything that a device computed: the model files, and all metrics except times.

    files: hashes of the run's files, by name.
    """
    suffixes = tuple(suffix for codec in CODECS for suffix in codec.endings)
    models = {name: digest for name, digest in files.items() if name.lower().endswith(suffixes)}
    metric_values: dict[str, Any] = {}
    with suppress(DataError, AttributeError):
        metrics = read_json(folder / METRICS)
        metric_values = {key: metrics.get(key) for key in ("gaussians", "steps", "seed")}
        for split in ("test", "train", "validation"):
            for size, values in metrics.get(split, {}).items():
                metric_values[f"{split} {size}"] = [values.get(key) for key in MEASURED]
    return hashlib.sha256(json.dumps([models, metric_values], sort_keys=True).encode()).hexdigest()


# The folder of a cell: its attempts, and its result.

LOG = logging.getLogger("clsplat")
SPEC, ATTEMPTS, RESULT, FAILED = "spec.json", "attempts", "result", "failed.json"
NAME = re.compile("[0-9a-f]{32}")  # of an attempt
STALE_AFTER_S = 600.0  # seconds without a heartbeat after which an attempt may be removed


class BitsMismatch(OutputError):
    """Two runs of a cell, on devices of the same bits class, gave different bits."""


class CellFolder:
    """The folder of a cell in a store, with its attempts and its result."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.result = path / RESULT

    @property
    def key(self) -> str:
        return self.path.name

    def write_spec(self, spec: Mapping[str, Any]) -> None:
        """Write spec.json, whose hash is the cell's key, if it is missing or damaged.

        Raises OutputError if the file has other values.
        """
        file = self.path / SPEC
        try:
            existing_spec = read_json(file) if file.exists() else None
        except DataError as error:
            LOG.warning("%s; writing it again", error)
            existing_spec = None
        if existing_spec is None:
            write_text(file, json.dumps(spec, indent=1, sort_keys=True) + "\n")
        elif existing_spec != spec:
            raise OutputError(f"{file}: belongs to another cell, or was changed; remove {self.path} to run it again")

    def manifest(self) -> dict[str, Any] | None:
        """Return the manifest of the result without verifying hashes; None if nothing was published."""
        with suppress(DataError):
            values = read_json(self.result / MANIFEST)
            if isinstance(values, dict) and isinstance(values.get("files"), dict) and values.get("bits"):
                return values
        return None

    def verified_manifest(self) -> dict[str, Any] | None:
        """Verify the hashes of the result's files, and return its manifest; None without an intact result.

        A damaged result is moved back to the attempts, so that the cell continues from its checkpoint.
        """
        if not self.result.is_dir():
            return None
        manifest = self.manifest()
        if manifest and all(try_sha256(self.result / name) == digest for name, digest in manifest["files"].items()):
            return manifest
        with suppress(OSError):  # another process may have moved it
            make_folder(self.path / ATTEMPTS)
            os.rename(self.result, self.path / ATTEMPTS / uuid.uuid4().hex)
        return None

    def attempts(self) -> list[CellAttempt]:
        """Return the attempts in the folder of the cell, in no particular order."""
        paths = (self.path / ATTEMPTS).glob("*")
        attempt_paths = [path for path in paths if NAME.fullmatch(path.name)]
        return [CellAttempt(path) for path in attempt_paths if path.is_dir() and not path.is_symlink()]

    def begin(self, worker: str, since: float) -> CellAttempt:
        """Start a new attempt, which continues from the newest readable checkpoint.  Raises OutputError.

        since: when the sweep that requested the cell started, by the store's clock.
        """
        attempt = CellAttempt(self.path / ATTEMPTS / uuid.uuid4().hex)
        with raising_output_error(attempt.path):
            make_folder(attempt.path)
            (self.path / FAILED).unlink(missing_ok=True)
        attempt.take_lease(worker, since)
        attempt.continue_from(candidate for candidate in self.attempts() if candidate.path != attempt.path)
        return attempt

    def failures(self, since: float) -> list[CellAttempt]:
        """Return the failed attempts after the newest readable checkpoint.

        since: attempts for sweeps that started before this time, by the store's clock, are ignored.
        """
        attempts = self.attempts()
        newest = next((rank for rank, *_ in readable_checkpoints(attempts)), (False, 0))
        return [item for item in attempts if item.has_failed and item.since >= since and item.start_rank >= newest]

    def publish(self, attempt: CellAttempt) -> dict[str, Any]:
        """Write the manifest of an attempt, rename the attempt to the result, and return the result's manifest.

        If another attempt was published first, the bits of both are compared.  Raises BitsMismatch if these differ, and
        LeaseLost if the attempt was removed because its process was frozen for too long.
        """
        attempt.require_lease()
        manifest = attempt.write_manifest()
        with raising_output_error(attempt.path):
            sync_below(attempt.path)
        with suppress(OSError):
            os.rename(attempt.path, self.result)
            sync_folder(self.path)
            with suppress(OSError):
                (self.result / LEASE).unlink()
                (self.path / FAILED).unlink(missing_ok=True)
            return manifest
        os.listdir(self.path)  # refreshes the NFS cache of the folder
        result = self.manifest()
        if result is None:
            raise OutputError(f"{self.result}: cannot be written; check the permissions and the free space")
        if result["bits"] != manifest["bits"]:
            raise BitsMismatch(
                f"{self.path}: the same cell gave different bits on two devices of one bits class: {self.result} on "
                f"{result.get('device')}, {attempt.path} on {manifest.get('device')}; one of them computes wrong "
                "results: `clsplat doctor` shows which"
            )
        return result

    def give_up(self, exit_code: int, message: str) -> None:
        """Write failed.json: the exit code and the message of the last failure."""
        codes = [attempt.exit_code for attempt in self.attempts() if attempt.exit_code is not None]
        content = json.dumps({"exit_code": exit_code, "message": message, "exit_codes": codes}, indent=1)
        write_text(self.path / FAILED, content + "\n")

    def failure(self) -> dict[str, Any] | None:
        """Return the content of failed.json; None if it is missing or damaged."""
        with suppress(DataError):
            values = read_json(self.path / FAILED)
            return values if isinstance(values, dict) else None
        return None

    def clean_up(self, now: float) -> None:
        """Remove the attempts of a published cell that had no heartbeat for STALE_AFTER_S seconds.

        now: the current time by the clock of the store.  Other attempts remain, because their processes may be running.
        """
        if self.manifest() is None:
            return
        for attempt in self.attempts():
            if now - attempt.last_beat > STALE_AFTER_S:
                shutil.rmtree(attempt.path, ignore_errors=True)


# A store may be untrusted.  Links, which may point outside of it, are rejected, and damaged values are ignored.


def join_without_symlinks(root: Path, *names: str) -> Path:
    """Join names to the path of a folder.  Raises DataError if a path up to one of the names is a symbolic link."""
    path = root
    for name in names:
        path /= name
        if path.is_symlink():
            raise DataError(f"{path}: is a symbolic link, which may point outside of the store; remove it")
    return path


def finite_number(value: Any) -> float | None:
    """Return a value from a record as a float; None if it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e18:
        return None
    return float(value)


CELLS, EVENTS, SWEEPS, CANCEL = "cells", "events", "sweeps", "cancel"
ALL = "all"


class Store:
    """A store of cells in a folder.  Methods raise OutputError if it cannot be written."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        owner = Owner.current()
        self._process_name = f"{owner.host_slug}-{owner.process}"

    @classmethod
    def open(cls, root: Path) -> "Store":
        """Return the store in a folder.  Raises DataError if there is none."""
        if not (root / CELLS).is_dir():
            raise DataError(f"{root}: is not the store of a sweep, because it has no folder `{CELLS}`; check the path")
        return cls(root)

    @property
    def prepared(self) -> Path:
        """The folder of the output of `prepare`."""
        return join_without_symlinks(self.root, PREPARED)

    def undistorted_folder(self, scene: str, code: str) -> Path:
        """Return the folder of a scene's undistorted photos.  scene, code: fingerprints in the spec of a cell."""
        return join_without_symlinks(self.root, UNDISTORTED, f"{scene[:16]}-{code}", Owner.current().host_slug).parent

    def folder(self, key: str) -> CellFolder:
        """Return the folder of a cell, which need not exist.  Raises DataError if it is or contains a symbolic link."""
        for name in (ATTEMPTS, RESULT):
            join_without_symlinks(self.root, CELLS, key, name)
        return CellFolder(self.root / CELLS / key)

    def folders(self) -> list[CellFolder]:
        """Return the folders of all cells.  Raises DataError as `folder` does."""
        names = sorted(path.name for path in (self.root / CELLS).glob("*") if path.is_dir())
        return [self.folder(name) for name in names if is_key(name)]

    def now(self) -> float:
        """Return the current time of the store's file system in seconds, which is the same for all machines."""
        clock = join_without_symlinks(self.root, EVENTS, f".{self._process_name}.clock")
        with raising_output_error(clock):
            make_folder(clock.parent)
            clock.touch()
            return clock.stat().st_mtime

    def log_event(self, event: str, **values: Any) -> None:
        """Append an event with the current time to the event file of this process."""
        path = join_without_symlinks(self.root, EVENTS, f"{self._process_name}.jsonl")
        with raising_output_error(path):
            make_folder(path.parent)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"time": round(time.time(), 3), "event": event, **values}) + "\n")

    def events(self) -> list[dict[str, Any]]:
        """Return the events of all processes in chronological order; incomplete lines are skipped."""
        events: list[dict[str, Any]] = []
        for path in (self.root / EVENTS).glob("*.jsonl"):
            for line in read_file(path).decode(errors="replace").splitlines() if path.is_file() else ():
                with suppress(ValueError):
                    event = json.loads(line)
                    events += (
                        [event] if isinstance(event, dict) and finite_number(event.get("time")) is not None else []
                    )
        return sorted(events, key=lambda event: float(event["time"]))

    def note_sweep(self, name: str, keys: Mapping[str, str], text: str) -> None:
        """Record the keys of the cells of a matrix, by cell name, for `clsplat status`.

        text: distinguishes matrices with the same name, for example the text of the pipeline file.  Cells that were
        recorded earlier remain.
        """
        folder = join_without_symlinks(self.root, SWEEPS)
        file = folder / f"{name[:50]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}.json"
        cells = {**dict(self.sweeps([file])).get(name, {}), **keys}
        write_text(file, json.dumps({"name": name, "cells": cells}, indent=1) + "\n")

    def sweeps(self, files: Sequence[Path] | None = None) -> list[tuple[str, dict[str, str]]]:
        """Return the name of each matrix, and the keys of its cells by cell name; invalid keys are omitted."""
        sweeps = []
        for path in sorted((self.root / SWEEPS).glob("*.json")) if files is None else files:
            with suppress(DataError, KeyError, TypeError, AttributeError):
                values = read_json(path)
                cells = {str(name): key for name, key in values["cells"].items() if is_key(key)}
                sweeps.append((str(values["name"]), cells))
        return sweeps

    def add(self, cell: CellRun) -> CellFolder:
        """Create and return the folder of a cell, with its spec.json.

        Raises OutputError if the existing spec.json belongs to another cell.
        """
        folder = self.folder(cell.key)
        folder.write_spec(cell.spec)
        return folder

    def cancel(self, cell: str | None = None) -> str:
        """Request that one running cell stop, or all running cells by default.  Return "all" or the key of the cell.

        cell: the name or key of the cell; None: all cells.  Raises ConfigError if there is no such cell.
        """
        name = ALL if cell is None else self.find_key(cell)
        self.stop(name)
        self.log_event("cancel", cell=name)
        return name

    def stop(self, name: str) -> None:
        """Request that running cells stop: those with this key or sweep name, or all cells if the name is "all"."""
        cancel_file = join_without_symlinks(self.root, CANCEL, name)
        with raising_output_error(cancel_file):
            make_folder(cancel_file.parent)
            cancel_file.touch()
            os.utime(cancel_file)

    def is_cancelled(self, names: Sequence[str], since: float) -> bool:
        """Return whether cells with one of these names were requested to stop at or after the time `since`.

        since: when the sweep that requested the cells started, by the store's clock.
        """
        for name in (ALL, *filter(None, names)):
            with suppress(OSError):
                if (self.root / CANCEL / name).stat().st_mtime >= since:
                    return True
        return False

    def find_key(self, cell: str) -> str:
        """Return the key of a cell, given its name in a sweep, its key, or the first digits of its key.

        If several cells have the name, unpublished cells take precedence.  Raises ConfigError unless one cell matches.
        """
        keys = {key for _, cells in self.sweeps() for name, key in cells.items() if name == cell}
        keys = {key for key in keys if not self.folder(key).result.is_dir()} or keys
        keys = keys or {folder.key for folder in self.folders() if folder.key.startswith(cell)}
        if len(keys) != 1:
            several = f"'{cell}' matches {len(keys)} cells; give a key"
            reason = several if keys else f"no cell '{cell}'; `clsplat status` lists the cells"
            raise ConfigError(f"{self.root}: {reason}")
        return keys.pop()
