"""The records of a run: metrics.jsonl and status.json."""

import json
import os
import time
from pathlib import Path
from typing import Any

from clsplat.errors import DataError
from clsplat.files import unwritable, write_text
from clsplat.scene.images import read_file


class Records:
    """Writes a run folder's records; every line of metrics.jsonl has its step."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.path = out / "metrics.jsonl"

    def start(self, step: int, edit_due: bool = False) -> None:
        """Keep the lines up to `step` and drop later ones, which a resumed run writes again.

        With `edit_due`, the checkpoint was saved before the edit of its step, and the line of that edit is dropped too.
        """
        before = [line for line in self.read() if line["step"] <= step] if step > 0 else []
        kept = [line for line in before if not (edit_due and line["kind"] == "densify" and line["step"] == step)]
        write_text(self.path, "".join(json.dumps(line) + "\n" for line in kept))

    def add(self, step: int, kind: str, **values: Any) -> None:
        """Append one line."""
        line = json.dumps({"step": step, "kind": kind, **values})
        try:
            with self.path.open("a") as file:
                file.write(line + "\n")
        except OSError as error:
            raise unwritable(self.path, error) from error

    def read(self, kind: str | None = None) -> list[dict[str, Any]]:
        """Return the lines, of one kind or all; a line cut short by a crash is left out.

        Raises DataError with file and line when the file is damaged in another way.
        """
        if not self.path.exists():
            return []
        lines = []
        for number, text in enumerate(read_file(self.path).decode(errors="replace").splitlines(), 1):
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):
                continue
            if not isinstance(line, dict) or type(line.get("step")) is not int or not isinstance(line.get("kind"), str):
                raise DataError(
                    f"{self.path}:{number}: damaged; expected keys and values with 'step' and 'kind'; remove this line"
                )
            lines.append(line)
        return [line for line in lines if kind in (None, line["kind"])]

    def status(self, state: str, step: int, **values: Any) -> None:
        """Write the state of the run to status.json: starting, running, done, interrupted or failed."""
        text = {"state": state, "step": step, "process": os.getpid(), "time": time.time(), **values}
        write_text(self.out / "status.json", json.dumps(text, indent=1) + "\n")
