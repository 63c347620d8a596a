"""The records of a run: metrics.jsonl."""

import json
from pathlib import Path
from typing import Any

from clsplat.errors import DataError
from clsplat.files import unwritable, write_text
from clsplat.reading import read_file


class Records:
    """Writes a run folder's records; every line of metrics.jsonl has its step."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.path = out / "metrics.jsonl"
        self.lines = 0  # of metrics.jsonl that belong to the state of the run

    def start(self) -> None:
        """Drop the lines after those of the state, which a resumed run writes again.  Raises DataError."""
        kept = self.read()[: self.lines] if self.lines else []
        self.lines = len(kept)
        write_text(self.path, "".join(json.dumps(line) + "\n" for line in kept))

    def add(self, step: int, kind: str, **values: Any) -> None:
        """Append one line."""
        line = json.dumps({"step": step, "kind": kind, **values})
        try:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write(line + "\n")
        except OSError as error:
            raise unwritable(self.path, error) from error
        self.lines += 1

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
            if "scale" in line:  # its name in older runs
                line["downscale"] = line.pop("scale")
            lines.append(line)
        return [line for line in lines if kind in (None, line["kind"])]
