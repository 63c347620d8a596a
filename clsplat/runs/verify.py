"""Check a pipeline; verify a run folder from its files alone: checkpoints, settings, records, models, images."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clsplat import plugins
from clsplat.compare.run_folder import read_metrics, read_settings
from clsplat.errors import ConfigError, DataError, one_line, shortened
from clsplat.files import is_there
from clsplat.formats.table import endings
from clsplat.gaussians.checkup import examine, is_model
from clsplat.gaussians.model import load as load_model
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
from clsplat.pipeline.files import shipped
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.pipeline.matrix import load_experiment
from clsplat.prepare.cache import noted
from clsplat.reading import read_file, read_json, sha256
from clsplat.runs.outputs import acting
from clsplat.runs.status import state_of
from clsplat.scene.identity import Identity
from clsplat.scene.images import read_image
from clsplat.training import archive, checkpoint
from clsplat.training.records import Records
from clsplat.training.status import Status, read_status

MISSING = "is missing"
NO_SUMS = "is missing, as in runs of earlier versions and of a Trainer; without it the outputs are not verified"


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run or a matrix."""
    return any((folder / name).is_file() for name in (PIPELINE, STATUS))


def check(pipeline: str) -> dict[str, Any]:
    """Check a pipeline file, or a shipped one by name: its path, its name, its stages or cells.

    Of a run folder and of a model file return what `verify` and `examine` say.
    Raises ConfigError; DataError for a folder without a run.
    """
    if not is_run(Path(pipeline)) and pipeline not in shipped() and is_model(Path(pipeline)):
        return examine(Path(pipeline))
    if len(Path(pipeline).parts) > 1 and not is_there(Path(pipeline)):
        raise ConfigError(f"{pipeline}: no such file or folder; expected a pipeline, a model, or the folder of a run")
    if Path(pipeline).is_dir() and (is_run(Path(pipeline)) or pipeline not in shipped()):
        return verify(Path(pipeline))
    if found := load_experiment(pipeline):
        return {"path": str(found.path), "name": found.name, "cells": [cell.name for cell in found.cells]}
    checked = load_pipeline(pipeline)
    return {"path": str(checked.path), "name": checked.settings.name, "stages": checked.names}


def verify(out: Path) -> dict[str, Any]:
    """Return `whole`, the `state` of the run, and for each file in `objects` whether it is whole, and a detail.

    Files that a run declares and does not have yet are no fault while it is not done.  Raises DataError where the
    folder holds no run.
    """
    if not is_run(out):
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

    def one(path: Path, look: Callable[[Path], str]) -> dict[str, Any]:
        name = path.relative_to(out).as_posix()
        try:
            return {"file": name, "whole": True, "detail": look(path)}
        except Exception as error:  # whatever is wrong with a file, the others are looked at too
            reason = one_line(error).removeprefix(f"{path}: ") or type(error).__name__
            return {"file": name, "whole": False, "detail": reason if path.exists() else MISSING}

    def pipeline(path: Path) -> str:
        settings.update(read_settings(out))
        return _settings(path, settings, sums.get(PIPELINE))

    status, sums = read_status(out), _sums(out)
    done = whole or status.get("state") == "done"
    yield one(out / PIPELINE, pipeline)
    yield one(out / STATUS, _status)
    if "matrix" in settings:
        for cell in _cells(out, done):
            yield from ({**found, "file": f"{cell}/{found['file']}"} for found in _objects(out / cell, done))
        if done or (out / COMPARISON).exists():
            yield one(out / COMPARISON, _page)
        return
    named = status.get("checkpoint")
    last = [out / CHECKPOINTS / named] if isinstance(named, str) and is_inside(named) else []
    yield from (one(path, _checkpoint) for path in dict.fromkeys([*checkpoint.saved(out), *last]))
    yield from (one(path, _failed) for path in sorted((out / CHECKPOINTS).glob("failed_*.npz")))
    declared = _declared(out, sums) if done else []
    if done and not (out / CHECKSUMS).exists():
        yield {"file": CHECKSUMS, "whole": False, "detail": NO_SUMS}
    elif (out / CHECKSUMS).exists():
        yield one(out / CHECKSUMS, partial(_listed, [PIPELINE, *declared]))
    if done or (out / INPUTS).exists():
        yield one(out / INPUTS, _inputs)
    if (done and settings.get("prepare")) or (out / NOTE).exists():
        yield one(out / NOTE, _note)
    for name in dict.fromkeys([*sums, *declared, *_present(out)]):
        if name != PIPELINE:
            yield one(out / name, partial(_output, sums.get(name)))


def _cells(out: Path, done: bool) -> list[str]:
    """The folders of a matrix's cells: those that are there, and of one that is done all of them."""
    cells = {one.name for one in out.iterdir() if one.is_dir() and not one.is_symlink() and is_run(one)}
    with suppress(ConfigError):  # told already
        found = load_experiment(str(out / PIPELINE)) if done else None
        cells |= {cell.name for cell in found.cells} if found else set()
    return sorted(cells)


def _settings(path: Path, settings: dict[str, Any], expected: str | None) -> str:
    _require(expected, path)
    if "matrix" in settings:
        load_experiment(str(path))
        return "of a matrix"
    recorded = settings.get("plugins")
    if isinstance(recorded, dict) and (faults := plugins.differences(recorded)):
        return f"not checked further: {faults[0]}"
    load_pipeline(str(path))
    return ""


def _status(path: Path) -> str:
    try:
        return Status.model_validate(read_json(path)).state
    except ValidationError as error:
        first = error.errors()[0]
        raise DataError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _checkpoint(path: Path) -> str:
    state, tables = checkpoint.load(path)
    return f"step {state.step}, {len(tables['gaussians/means']):,} Gaussians"


def _failed(path: Path) -> str:
    return f"the state of a failure at step {archive.read(path)[0].get('step')}"


def _inputs(path: Path) -> str:
    Identity.from_data(read_json(path))
    return ""


def _note(path: Path) -> str:
    if noted(path.parent) is None:
        raise DataError("expected the hash and the folder of prepared photographs")
    return ""


def _page(path: Path) -> str:
    if not read_file(path).rstrip().endswith(b"</html>"):
        raise DataError("ends before its end")
    return ""


def _listed(expected: list[str], path: Path) -> str:
    sums = read_json(path)
    if not isinstance(sums, dict) or not all(isinstance(value, str) for value in sums.values()):
        raise DataError("expected the SHA-256 of each file")
    if outside := [name for name in sums if not is_inside(name)]:
        raise DataError(f"'{shortened(outside[0])}' is no file of the run")
    if absent := [name for name in expected if name not in sums]:
        raise DataError(f"'{absent[0]}' is not in it")
    return f"of {len(sums)} files"


def _sums(out: Path) -> dict[str, str]:
    """The checksums that are listed; none where the list is missing or damaged."""
    try:
        sums = read_json(out / CHECKSUMS)
    except DataError:
        return {}
    return {name: str(value) for name, value in sums.items() if is_inside(name)} if isinstance(sums, dict) else {}


def _declared(out: Path, sums: dict[str, str]) -> list[str]:
    """Files that a run has when it is done; a folder stands for its files where no checksum tells them."""
    try:
        stages = [stage for stage in acting(load_pipeline(str(out / PIPELINE))) if stage.named_outputs()]
    except ConfigError:  # told already
        stages = []
    paths = [(path, stage) for stage in stages for path in stage.outputs(out)]
    found = {path.relative_to(out).as_posix(): stage for path, stage in paths}
    folders = [name for name, stage in found.items() if not any(stage.named_outputs().values())]
    files = [name for name in found if name not in folders]
    optional = [name for name in files if name not in sums and Path(name).stem.endswith("_raw")]  # of a world filter
    return [RECORDS, METRICS, *(name for name in files if name not in optional), *([] if sums else folders)]


def _present(out: Path) -> list[str]:
    """Records and models that are there without a checksum, such as those of a run that is not done."""
    names = [name for name in (METRICS, RECORDS) if (out / name).exists()]
    return [*names, *sorted(path.name for path in out.glob("*.ply"))]


def _require(expected: str | None, path: Path) -> None:
    if expected is not None and sha256(path) != expected:
        raise DataError("differs from its checksum")


def _output(expected: str | None, path: Path) -> str:
    """Look at one output; return what it is.  Raises the errors of its reader, DataError where its bytes changed."""
    _require(expected, path)
    if path.name == METRICS:
        return f"{read_metrics(path).gaussians:,} Gaussians"
    if path.name == RECORDS:
        return f"{len(Records(path.parent).read())} lines"
    if path.name.lower().endswith(tuple(endings(reads=True))):
        return f"{len(load_model(path)):,} Gaussians"
    if path.suffix == ".png":
        height, width = read_image(path).shape[:2]
        return f"{width} x {height} px"
    path.stat()
    return ""
