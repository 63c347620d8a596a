"""The records of a run: metrics.jsonl."""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from clsplat.errors import DataError
from clsplat.files import append, told_as, write_text
from clsplat.names import RECORDS, TRIAL
from clsplat.reading import read_file

LOG = logging.getLogger("clsplat")


class Records:
    """Writes a run folder's records; every line of metrics.jsonl has its step.

    Lines wait until what they tell of is done, for a stage that fails is repeated when the run goes on.
    """

    def __init__(self, out: Path, require_held: Callable[[], None] = lambda: None) -> None:
        """`require_held` raises OutputError when the folder is no longer held."""
        self.out = out
        self._require_held = require_held
        self.path, self.trial = out / RECORDS, out / TRIAL
        self.lines = 0  # of metrics.jsonl that belong to the state of the run, with those that wait
        self._waiting: list[str] = []

    def set_aside(self) -> None:
        """Begin anew, for a refit; the lines so far are in trial.jsonl then.  Raises OutputError."""
        self.write()
        self._require_held()
        with told_as(self.trial):
            self.path.replace(self.trial)
        self.lines = 0

    def start(self, is_refit: bool = False) -> None:
        """Drop the lines after those of the state, which a resumed run writes again.

        Where that is before a refit, lines that were set aside for one come back.
        Those of the state that cannot be read are lost, with all behind them, and a warning says so.
        """
        if not is_refit and self.trial.exists():
            with told_as(self.trial):
                self.trial.replace(self.path)
        kept: list[dict[str, Any]] = []
        fault = "it ends before"
        try:
            for line in islice(self._each(self.path), self.lines):
                kept.append(line)
        except DataError as error:
            fault = str(error)
        if len(kept) < self.lines:
            LOG.warning("%s: %d of %d lines can be read; %s; the run goes on", self.path, len(kept), self.lines, fault)
        self.lines = len(kept)
        write_text(self.path, "".join(json.dumps(line) + "\n" for line in kept))

    def add(self, step: int, kind: str, **values: Any) -> None:
        """Add one line; `write` writes it, or the end of the stage."""
        self._waiting.append(json.dumps({"step": step, "kind": kind, **values}) + "\n")
        self.lines += 1

    def write(self) -> None:
        """Append the lines that wait, and sync them: a checkpoint counts them.

        Raises OutputError; then they wait on, and the file is as it was.
        """
        if not self._waiting:
            return
        self._require_held()
        append(self.path, "".join(self._waiting).encode())
        self._waiting.clear()

    @contextmanager
    def of_a_stage(self) -> Iterator[None]:
        """Write the lines that the block adds at its end; where it fails they do not count."""
        lines, waiting = self.lines, len(self._waiting)
        try:
            yield
            self.write()
        except BaseException:
            del self._waiting[waiting:]
            self.lines = lines
            raise

    def read(self, kind: str | None = None, trial: bool = False) -> list[dict[str, Any]]:
        """Return the lines, of one kind or all; a line cut short by a crash is left out.

        trial: those before a refit, none where there was none.

        Raises DataError with file and line when the file is damaged in another way.
        """
        lines = self._each(self.trial if trial else self.path)
        return [line for line in lines if kind in (None, line["kind"])]

    def _each(self, path: Path) -> Iterator[dict[str, Any]]:
        if not path.exists():
            return
        texts = read_file(path).decode(errors="replace").split("\n")
        for number, text in enumerate(texts, 1):
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):
                if number == len(texts):  # nothing, or what a crash has left
                    break
                line = None
            if not isinstance(line, dict) or type(line.get("step")) is not int or not isinstance(line.get("kind"), str):
                raise DataError(
                    f"{path}:{number}: damaged; expected keys and values with 'step' and 'kind'; remove this line"
                )
            yield line
