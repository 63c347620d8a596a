"""The folder in which models are trained: it belongs to one question, and what was interrupted in it goes on."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from clsplat import lock
from clsplat.errors import ConfigError, DataError
from clsplat.files import is_there, make_folder, sweep, told_as, write_text
from clsplat.names import LOCK, PIPELINE
from clsplat.reading import read_json

WORDS = {"sha256": "the model's bytes"}  # for keys of a question, where they are no words


@contextmanager
def claimed(out: Path, question: dict[str, Any], record: str, what: str, remedy: str) -> Iterator[None]:
    """Make the folder, with the question in its record, sweep it of what killed processes left, and hold it.

    what: the question in a word, such as "a search"; remedy: what to give in the place of this folder.
    Raises ConfigError where it holds something else, OutputError where another process uses it.
    """
    _require_own(out, question, record, what, remedy)
    with told_as(out):
        make_folder(out)
    with lock.held(out):
        _require_own(out, question, record, what, remedy)  # again: another may have begun since
        sweep(out, border=PIPELINE)
        if not (out / record).exists():
            write_text(out / record, json.dumps(question, indent=1) + "\n")
        yield


def _require_own(out: Path, question: dict[str, Any], record: str, what: str, remedy: str) -> None:
    """Raise ConfigError where a folder holds another question, or something else."""
    if not is_there(out / record):
        if is_there(out) and not (out.is_dir() and all(_is_nobodys(path.name) for path in out.iterdir())):
            raise ConfigError(f"{out}: holds something else than {what}; give {remedy}")
        return
    try:
        before = read_json(out / record)
    except DataError:
        before = None
    if not isinstance(before, dict):
        raise ConfigError(f"{out / record}: is not the record of {what}; remove {out}, or give {remedy}")
    differing = [WORDS.get(key, key) for key, value in question.items() if before.get(key) != value]
    if differing:
        raise ConfigError(f"{out}: holds {what} that differs in {', '.join(differing)}; remove it, or give {remedy}")


def _is_nobodys(name: str) -> bool:
    """Whether a file may be what a process leaves that was killed before its record: its lock, or a hidden file."""
    return name == LOCK or name[0] == "."
