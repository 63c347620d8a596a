"""An attempt at a cell: a run folder with a lease, and with a manifest when its run is done."""

import hashlib
import json
import math
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

from clsplat.cluster.copies import copy_files, link_or_copy
from clsplat.errors import ConfigError, DataError, OutputError
from clsplat.files import told_as, write_text
from clsplat.formats.table import CODECS
from clsplat.names import CHECKPOINTS, LOCK, METRICS, NOTE, STATUS
from clsplat.processes import Owner
from clsplat.reading import read_file, read_json, sha256
from clsplat.training import checkpoint
from clsplat.training.status import read_status

LEASE, MANIFEST, PIPELINE_FILE, ERRORS = "lease.json", "manifest.json", "cell.yaml", "errors.txt"
OWN = frozenset({LEASE, MANIFEST, PIPELINE_FILE, ERRORS, STATUS, LOCK, NOTE})  # of one attempt alone; NOTE has a path
MEASURED = ("psnr", "ssim", "views")  # figures of metrics.json that a device's bits decide
BEAT = 10.0  # seconds between two beats of a lease
Rank = tuple[bool, int]  # of a checkpoint: whether it is of a refit, and its step


class LeaseLost(OutputError):
    """The folder of an attempt was removed while its run went on."""


class Attempt:
    """A folder below `attempts`, written by one process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values: dict[str, Any] = {}
        self._last = -math.inf

    def take_lease(self, worker: str, since: float) -> None:
        """Say who works here.  since: when its caller began, by the clock of the store.  Raises OutputError."""
        self._values = {**asdict(Owner.this()), "worker": worker, "since": since, "begun": time.time()}
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

    def go_on_from(self, others: Iterable["Attempt"]) -> None:
        """Take what the attempt with the newest checkpoint that is whole has written: links where that is possible.

        A damaged checkpoint counts as none: the one before it is taken, of whatever attempt.  Raises OutputError.
        """
        for _, path, other in whole(others):
            own = self.path / CHECKPOINTS / path.name
            with told_as(self.path):
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


def whole(attempts: Iterable[Attempt]) -> Iterator[tuple[Rank, Path, Attempt]]:
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
