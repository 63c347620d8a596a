"""The result of a cell in the folder of its matrix."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.cluster.attempt import ERRORS, LEASE, MANIFEST
from clsplat.cluster.copies import copy_files, link_or_copy
from clsplat.errors import ConfigError, DataError
from clsplat.files import told_as
from clsplat.names import PIPELINE
from clsplat.reading import read_json
from clsplat.runs.found import sum_of
from clsplat.training import checkpoint


def place_copy(source: Path, target: Path) -> None:
    """Let a folder hold the files of a result, linked where nothing changes them in place; the manifest comes last.

    Raises OutputError.
    """
    with told_as(target):
        for old in (target / MANIFEST, *checkpoint.saved(target)):  # later checkpoints are of another run
            old.unlink(missing_ok=True)
        copy_files(source, target, {LEASE, ERRORS, MANIFEST})
        link_or_copy(source / MANIFEST, target / MANIFEST)


def is_placed(source: Path, target: Path) -> bool:
    """Whether a folder holds the files of a result, as `place_copy` leaves them.

    Raises ConfigError where a run has gone on in it, with settings of its own.
    """
    own, files = _hashes(target), _hashes(source)
    settings = sum_of(target / PIPELINE)
    if own and settings not in (None, own.get(PIPELINE)):
        raise ConfigError(
            f"{target}: was trained on with other settings since the sweep had put its result there; move that folder, "
            "and run the sweep again with --resume"
        )
    return bool(files) and all(_is_same(source / name, target / name, digest) for name, digest in files.items())


def _hashes(folder: Path) -> dict[str, Any]:
    """The hashes of files by the manifest of a folder; none where it has no manifest that can be read."""
    with suppress(DataError, KeyError, TypeError):
        return dict(read_json(folder / MANIFEST)["files"])
    return {}


def _is_same(source: Path, target: Path, digest: str) -> bool:
    """Whether a file is a link of another, whose hash is known, or has that hash."""
    with suppress(OSError):
        return os.path.samefile(source, target) or sum_of(target) == digest
    return False
