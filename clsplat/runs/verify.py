"""Verify a run folder from its files alone: which it must have, and whether each is whole."""

import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from clsplat.compare.run_folder import read_settings
from clsplat.errors import ConfigError, DataError, one_line
from clsplat.files import is_there
from clsplat.names import (
    CHECKPOINTS,
    CHECKSUMS,
    COMPARISON,
    INPUTS,
    METRICS,
    NOTE,
    PIPELINE,
    RECORDS,
    STATUS,
    is_inside,
)
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import load_experiment
from clsplat.runs import file_checks
from clsplat.runs.found import has_state, read_sums
from clsplat.runs.outputs import acting
from clsplat.runs.status import state_of
from clsplat.training import checkpoint
from clsplat.training.status import read_status

NO_SUMS = "is missing, as in runs of a Trainer; without it the outputs are not verified"


def verify(out: Path) -> dict[str, Any]:
    """Return `whole`, the `state` of the run, and for each file in `objects` whether it is whole, and a detail.

    Files that a run declares and does not have yet are no fault while it is not done.  Raises DataError where the
    folder holds no run.
    """
    if not has_state(out):
        raise DataError(f"{out}: holds neither pipeline.yaml nor status.json; expected the folder of a run")
    objects = list(_objects(out))
    return {
        "run": str(out),
        "state": state_of(read_status(out)),
        "whole": all(one["whole"] for one in objects),
        "objects": objects,
    }


def _objects(out: Path, whole: bool = False) -> Iterator[dict[str, Any]]:
    """What is found of each file of a run, or of the cells of a matrix; `whole` expects those of one that is done."""
    settings: dict[str, Any] = {}

    def pipeline(path: Path) -> str:
        settings.update(read_settings(out))
        return file_checks.settings_file(path, settings, sums.get(PIPELINE))

    status, sums = read_status(out), read_sums(out) or {}
    ended = is_there(out / CHECKSUMS) and (PIPELINE in sums or not sums)  # while a run goes on it lists other files
    done = whole or status.get("state") == "done" or (not status and ended)
    one = partial(look_at, out)
    yield one(PIPELINE, pipeline)
    yield one(STATUS, file_checks.status_file)
    if "matrix" in settings or "cells" in status:
        for cell in _cells(out, done):
            yield from ({**found, "file": f"{cell}/{found['file']}"} for found in _objects(out / cell, done))
        if done or (out / COMPARISON).exists():
            yield one(COMPARISON, file_checks.page)
        return
    written: dict[str, str] = {}  # models of a run that is not done
    yield from (one(name, partial(file_checks.checkpoint_file, written)) for name in _checkpoints(out, status))
    expected = {**{name: value for name, value in written.items() if is_inside(name)}, **sums}
    for path in sorted((out / CHECKPOINTS).glob("failed_*.npz")):
        yield one(f"{CHECKPOINTS}/{path.name}", file_checks.failed_state)
    files, folders = _declared(out, sums) if done else ([], [])
    if done and not is_there(out / CHECKSUMS):
        yield {"file": CHECKSUMS, "whole": False, "detail": NO_SUMS}
    elif is_there(out / CHECKSUMS):
        yield one(CHECKSUMS, partial(file_checks.sums_file, [PIPELINE, *files] if done else []))
    if done or is_there(out / INPUTS):
        yield one(INPUTS, file_checks.inputs_file)
    if (done and settings.get("prepare")) or is_there(out / NOTE):
        yield one(NOTE, file_checks.note_file)
    for name in dict.fromkeys([*expected, *files, *_present(out)]):
        if name != PIPELINE:
            yield one(name, partial(file_checks.output, expected.get(name)))
    yield from (one(name, file_checks.folder, stat.S_IFDIR) for name in folders)


def look_at(out: Path, name: str, look: Callable[[Path], str], kind: int = stat.S_IFREG) -> dict[str, Any]:
    """Return what is found of one file of a folder, or of a folder in it."""
    path = out / name
    try:
        file_checks.require(path, kind)
        return {"file": name, "whole": True, "detail": look(path)}
    except Exception as error:  # whatever is wrong with a file, the others are looked at too
        reason = one_line(error).removeprefix(f"{path}: ") or type(error).__name__
        return {"file": name, "whole": False, "detail": reason}


def _checkpoints(out: Path, status: dict[str, Any]) -> list[str]:
    """The checkpoints that are there, and the newest that the status names."""
    names = [path.name for path in checkpoint.saved(out)]
    named = status.get("checkpoint")
    if isinstance(named, str) and is_inside(named) and named not in names:
        names.append(named)
    return [f"{CHECKPOINTS}/{name}" for name in names]


def _cells(out: Path, done: bool) -> list[str]:
    """The folders of a matrix's cells: those that are there, and of one that is done all of them."""
    cells = {one.name for one in out.iterdir() if one.is_dir() and not one.is_symlink() and has_state(one)}
    with suppress(ConfigError):  # told already
        found = load_experiment(str(out / PIPELINE)) if done else None
        cells |= {cell.name for cell in found.cells} if found else set()
    return sorted(cells)


def _declared(out: Path, sums: dict[str, str]) -> tuple[list[str], list[str]]:
    """Files that a run has when it is done, and folders, which stand for their files where no checksum tells them."""
    try:
        stages = [stage for stage in acting(load(str(out / PIPELINE))) if stage.named_outputs()]
    except ConfigError:  # told already
        stages = []
    paths = [(path, stage) for stage in stages for path in stage.outputs(out)]
    found = {path.relative_to(out).as_posix(): stage for path, stage in paths}
    folders = [name for name, stage in found.items() if not any(stage.named_outputs().values())]
    files = [name for name in found if name not in folders]
    optional = [name for name in files if name not in sums and Path(name).stem.endswith(("_raw", "_sky"))]
    return [RECORDS, METRICS, *(name for name in files if name not in optional)], [] if sums else folders


def _present(out: Path) -> list[str]:
    """Records and models that are there without a checksum, such as those of a run that is not done."""
    names = [name for name in (METRICS, RECORDS) if (out / name).exists()]
    return [*names, *sorted(path.name for path in out.glob("*.ply"))]
