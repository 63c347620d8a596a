"""Verify a run folder from its files alone: which it must have, and whether each is whole."""

import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError, DataError, in_shell, one_line, shortened, size_text
from clsplat.core.files import (
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
    is_there,
)
from clsplat.core.page import require_end
from clsplat.core.reading import KINDS, read_json, sha256
from clsplat.formats.table import endings
from clsplat.gaussians.model import load as load_model
from clsplat.gaussians.validate import examine, is_model
from clsplat.nerf.files import is_field, load_field
from clsplat.pipeline import plugins
from clsplat.pipeline.files import shipped
from clsplat.pipeline.loading import load
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.pipeline.matrix import load_experiment
from clsplat.prepare.cache import noted
from clsplat.runs.outputs import acting
from clsplat.runs.recovery import beyond_repair
from clsplat.runs.results import read_metrics, read_settings
from clsplat.runs.state import has_state, read_sums, restart
from clsplat.runs.status import state_of
from clsplat.scene.identity import Identity
from clsplat.scene.images import read_image
from clsplat.training import archive, checkpoint
from clsplat.training.records import Records
from clsplat.training.status import read_status, status_of

# How each file of a run is looked at: what it is, or the DataError of what is wrong with it.


def require(path: Path, kind: int = stat.S_IFREG) -> None:
    """Raise DataError, with what is there instead, where there is no file, or nothing of another `kind`."""
    try:
        found = stat.S_IFMT(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataError("is a link that leads to nothing" if path.is_symlink() else "is missing") from error
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror})") from error
    if found != kind:
        raise DataError(f"is {KINDS.get(found, 'a file')}; expected {KINDS.get(kind, 'a file')}")


def require_sum(expected: str | None, path: Path) -> None:
    if expected is not None and sha256(path) != expected:
        raise DataError("differs from its checksum")


def settings_file(path: Path, settings: dict[str, Any], expected: str | None) -> str:
    require_sum(expected, path)
    if "matrix" in settings:
        load_experiment(str(path))
        return "of a matrix"
    recorded = settings.get("plugins")
    if isinstance(recorded, dict) and (faults := plugins.differences(recorded)):
        return f"not checked further: {faults[0]}"
    load_pipeline(str(path))
    return ""


def status_file(path: Path) -> str:
    content = read_json(path)
    status = status_of(content)
    return status.state if status else f"not checked further: format {content['format']}, of a newer clsplat"


def checkpoint_file(written: dict[str, str], path: Path) -> str:
    """Also note in `written` the checksums of models, where no training follows that may write them anew."""
    state, tables = checkpoint.load(path)
    if not any("optimize" in stage for stage in state.pipeline["stages"][state.cursor :]):
        written.update(state.written)
    gaussians = None if state.field else len(tables["gaussians/means"])
    return f"step {state.step}, {size_text(gaussians, state.field['parameters'] if state.field else None)}"


def failed_state(path: Path) -> str:
    return f"the state of a failure at step {archive.read(path)[0].get('step')}"


def inputs_file(path: Path) -> str:
    Identity.from_data(read_json(path))
    return ""


def note_file(path: Path) -> str:
    if noted(path.parent) is None:
        raise DataError("expected the hash and the folder of prepared photographs")
    return ""


def page(path: Path) -> str:
    require_end(path)
    return ""


def sums_file(expected: list[str], path: Path) -> str:
    sums = read_json(path)
    if not isinstance(sums, dict) or not all(isinstance(value, str) for value in sums.values()):
        raise DataError("expected the SHA-256 of each file")
    faults = [f"'{shortened(name)}' is no file of the run" for name in sums if not is_inside(name)]
    if absent := [f"'{name}'" for name in expected if name not in sums]:
        faults.append(f"lacks {', '.join(absent)}")
    if faults:
        raise DataError("; ".join(faults))
    return f"of {len(sums)} files"


def output(expected: str | None, path: Path) -> str:
    """Look at one output; return what it is.  Raises the errors of its reader, DataError where its bytes changed."""
    require_sum(expected, path)
    if path.name == METRICS:
        metrics = read_metrics(path)
        return size_text(metrics.gaussians, metrics.parameters)
    if path.name == RECORDS:
        return f"{len(Records(path.parent).read())} lines"
    if path.name.lower().endswith(tuple(endings(reads=True))):
        return f"{len(load_model(path)):,} Gaussians"
    if path.suffix == ".png":
        height, width = read_image(path).shape[:2]
        return f"{width} x {height} px"
    return ""


def folder(path: Path) -> str:
    """Look at a folder that stands for its files."""
    return f"{sum(one.is_file() for one in path.rglob('*'))} files"


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
        return settings_file(path, settings, sums.get(PIPELINE))

    status, sums = read_status(out), read_sums(out) or {}
    ended = is_there(out / CHECKSUMS) and (PIPELINE in sums or not sums)  # while a run goes on it lists other files
    done = whole or status.get("state") == "done" or (not status and ended)
    one = partial(look_at, out)
    yield one(PIPELINE, pipeline)
    yield one(STATUS, status_file)
    if "matrix" in settings or "cells" in status:
        for cell in _cells(out, done):
            yield from ({**found, "file": f"{cell}/{found['file']}"} for found in _objects(out / cell, done))
        if done or (out / COMPARISON).exists():
            yield one(COMPARISON, page)
        return
    written: dict[str, str] = {}  # models of a run that is not done
    yield from (one(name, partial(checkpoint_file, written)) for name in _checkpoints(out, status))
    expected = {**{name: value for name, value in written.items() if is_inside(name)}, **sums}
    for path in sorted((out / CHECKPOINTS).glob("failed_*.npz")):
        yield one(f"{CHECKPOINTS}/{path.name}", failed_state)
    files, folders = _declared(out, sums) if done else ([], [])
    if done and not is_there(out / CHECKSUMS):
        yield {"file": CHECKSUMS, "whole": False, "detail": NO_SUMS}
    elif is_there(out / CHECKSUMS):
        yield one(CHECKSUMS, partial(sums_file, [PIPELINE, *files] if done else []))
    if done or is_there(out / INPUTS):
        yield one(INPUTS, inputs_file)
    if (done and settings.get("prepare")) or is_there(out / NOTE):
        yield one(NOTE, note_file)
    for name in dict.fromkeys([*expected, *files, *_present(out)]):
        if name != PIPELINE:
            yield one(name, partial(output, expected.get(name)))
    yield from (one(name, folder, stat.S_IFDIR) for name in folders)


def look_at(out: Path, name: str, look: Callable[[Path], str], kind: int = stat.S_IFREG) -> dict[str, Any]:
    """Return what is found of one file of a folder, or of a folder in it."""
    path = out / name
    try:
        require(path, kind)
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


# What `clsplat check RUN` says of a run folder.


def verdict(found: dict[str, Any]) -> str:
    """Return a sentence about what `verify` found."""
    damaged = [one["file"] for one in found["objects"] if not one["whole"]]
    if not damaged:
        return f"{found['run']}: {found['state']}; all {len(found['objects'])} files are whole"
    if all(one["whole"] or one["detail"] == NO_SUMS for one in found["objects"]):
        return f"{found['run']}: {found['state']}; {damaged[0]} {NO_SUMS}"
    names = ", ".join(damaged[:3]) + (", …" if len(damaged) > 3 else "")
    return (
        f"{found['run']}: {found['state']}; {len(damaged)} of {len(found['objects'])} files are damaged or missing: "
        f"{names}; copy them again, or {found.get('remedy') or _remedy(found, damaged[0])}"
    )


def _remedy(found: dict[str, Any], file: str) -> str:
    """How the run of a damaged file is mended by running it again."""
    out = Path(found["run"])
    cell = next((one for one in (out / file).parents if one != out and out in one.parents and has_state(one)), out)
    prefix = "" if cell == out else f"{cell.relative_to(out).as_posix()}/"
    whole = {
        one["file"].removeprefix(prefix): one["whole"] for one in found["objects"] if one["file"].startswith(prefix)
    }
    damaged = [cell / name for name, good in whole.items() if not good]
    left = beyond_repair(cell, damaged)
    if not whole.get(PIPELINE):
        return f"give its `clsplat run … --out {in_shell(cell)}` again, with {'--restart' if left else '--resume'}"
    resume = f"`clsplat resume {in_shell(cell)}` makes them again"
    if not left:
        return resume
    others = "" if len(left) == len(damaged) else f"; {resume} but for {', '.join(map(str, left))}"
    return f"begin again: {restart(cell)}{others}"


def lines(found: dict[str, Any]) -> str:
    """Return what `verify` found, a line for each file."""
    rows = [
        f"{'whole  ' if one['whole'] else 'DAMAGED'}  {one['file']}{', ' if one['detail'] else ''}{one['detail']}"
        for one in found["objects"]
    ]
    return "\n".join(rows)


# What `clsplat check` was given: a pipeline, a matrix, the folder of a run, or a model.


def check(pipeline: str) -> dict[str, Any]:
    """Check a pipeline file, or a shipped one by name: its path, its name, its stages or cells, and the keys
    that its photographs will decide.

    Of a run folder and of a model file return what `verify` and `examine` say, of the file of a field its parameters.
    Raises ConfigError; DataError for a folder without a run.
    """
    if is_field(Path(pipeline)) and is_there(Path(pipeline)):
        return {"path": pipeline, "name": Path(pipeline).name, "parameters": load_field(pipeline).shape.learned}
    if not has_state(Path(pipeline)) and pipeline not in shipped() and is_model(Path(pipeline)):
        return examine(Path(pipeline))
    if len(Path(pipeline).parts) > 1 and not is_there(Path(pipeline)):
        raise ConfigError(f"{pipeline}: no such file or folder; expected a pipeline, a model, or the folder of a run")
    if Path(pipeline).is_dir() and (has_state(Path(pipeline)) or pipeline not in shipped()):
        return verify(Path(pipeline))
    if found := load_experiment(pipeline):
        return {"path": str(found.path), "name": found.name, "cells": [cell.name for cell in found.cells]}
    checked = load(pipeline)
    stages = {"stages": checked.names, "adapts": checked.undecided}
    return {"path": str(checked.path), "name": checked.settings.name, **stages}
