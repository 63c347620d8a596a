"""Files of a run folder in another one: links where that is possible."""

import os
import shutil
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from clsplat.files import PARTIAL
from clsplat.names import LOG_FILE, RECORDS, TRIAL

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
