"""The folder that a sweep is kept in, shared by all machines that work on it.

    cells/<key>/spec.json           what the key was made of, written first, never changed
                attempts/<uuid>/    an ordinary run folder, written by one process ever, with its lease.json
                result/             the attempt that came first, renamed, with its manifest.json
                failed.json         why it was given up
    prepared/  scenes/              what `prepare` makes; hashes of photographs
    undistorted/<scene>-<code>/     photographs without the distortion of their lenses, made once a host
    sweeps/<name>-<hash>.json       the cells of a matrix by their names
    cancel/all  cancel/<key>        that what began before is to stop
    events/<host>-<process>.jsonl   one file a process: no two append to one

Engines start a cell at least once.  A cell counts once: attempts share no file, its bits do not depend on who runs it,
and publishing is a rename.
"""

import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.cluster.cell import Cell
from clsplat.cluster.folder import CellFolder
from clsplat.errors import ConfigError, DataError
from clsplat.files import make_folder, told_as, write_text
from clsplat.names import PREPARED, UNDISTORTED
from clsplat.processes import Owner
from clsplat.reading import read_file, read_json

CELLS, EVENTS, SWEEPS, CANCEL, SCENES = "cells", "events", "sweeps", "cancel", "scenes"
ALL = "all"


class Store:
    """A store, as one process uses it.  Raises OutputError where it cannot be written."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        owner = Owner.this()
        self._own = f"{owner.host_word}-{owner.process}"

    @classmethod
    def opened(cls, root: Path) -> "Store":
        """Return the store in a folder.  Raises DataError when it holds none."""
        if not (root / CELLS).is_dir():
            raise DataError(f"{root}: has no folder `{CELLS}`; expected the store of a sweep")
        return cls(root)

    @property
    def scenes(self) -> Path:
        """The folder of hashes of photographs."""
        return self.root / SCENES

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
        with told_as(clock):
            make_folder(clock.parent)
            clock.touch()
            return clock.stat().st_mtime

    def tell(self, event: str, **values: Any) -> None:
        """Append an event to the file of this process."""
        path = self.root / EVENTS / f"{self._own}.jsonl"
        with told_as(path):
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

    def add(self, cell: Cell) -> CellFolder:
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
        with told_as(flag):
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
