"""The folder in which models are trained: it belongs to one question, and what was interrupted in it goes on."""

import json
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError, DataError
from clsplat.files import is_there, make_folder, unwritable, write_text
from clsplat.reading import read_json


def claim(out: Path, question: dict[str, Any], record: str, what: str, remedy: str) -> None:
    """Make the folder, with the question in its record.  Raises ConfigError where it holds something else.

    what: the question in a word, such as "a search"; remedy: what to give in the place of this folder.
    """
    if is_there(out) and (not out.is_dir() or any(out.iterdir())):
        try:
            before = read_json(out / record)
        except DataError:
            before = None
        if not isinstance(before, dict):
            raise ConfigError(f"{out}: holds something else than {what}; give {remedy}")
        if differing := [key for key, value in question.items() if before.get(key) != value]:
            raise ConfigError(f"{out}: holds {what} with another {differing[0]}; give {remedy}")
        return
    try:
        make_folder(out)
    except OSError as error:
        raise unwritable(out, error) from error
    write_text(out / record, json.dumps(question, indent=1) + "\n")
