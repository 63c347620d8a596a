"""Check a pipeline; verify a run folder from its files alone: checkpoints, settings, records, models, images."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from clsplat import plugins
from clsplat.compare.run_folder import read_metrics, read_settings
from clsplat.errors import ConfigError, DataError, one_line
from clsplat.gaussians.model import load as load_model
from clsplat.names import CHECKPOINTS, CHECKSUMS, METRICS, PIPELINE, RECORDS, STATUS
from clsplat.pipeline.files import shipped
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.pipeline.matrix import load_experiment
from clsplat.reading import read_json, sha256
from clsplat.scene.images import read_image
from clsplat.stages.export import Export
from clsplat.training import archive, checkpoint
from clsplat.training.records import Records
from clsplat.training.status import read_status

MISSING = "is missing"


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run or a matrix."""
    return any((folder / name).is_file() for name in (PIPELINE, STATUS))


def check(pipeline: str) -> dict[str, Any]:
    """Check a pipeline file, or a shipped one by name: its path, its name, its stages or cells; or a run folder.

    Raises ConfigError; DataError for a folder without a run.
    """
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
    state = str(read_status(out).get("state"))
    return {"run": str(out), "state": state, "whole": all(one["whole"] for one in objects), "objects": objects}


def verdict(found: dict[str, Any]) -> str:
    """Return a sentence about what `verify` found."""
    damaged = [one["file"] for one in found["objects"] if not one["whole"]]
    if not damaged:
        return f"{found['run']}: {found['state']}; all {len(found['objects'])} files are whole"
    names = ", ".join(damaged[:3]) + (", …" if len(damaged) > 3 else "")
    return (
        f"{found['run']}: {len(damaged)} of {len(found['objects'])} files are damaged or missing: {names}; "
        "copy them again, or run with --resume or --restart"
    )


def lines(found: dict[str, Any]) -> str:
    """Return what `verify` found, a line for each file."""
    rows = [
        f"{'whole  ' if one['whole'] else 'DAMAGED'}  {one['file']}{', ' if one['detail'] else ''}{one['detail']}"
        for one in found["objects"]
    ]
    return "\n".join(rows)


def _objects(out: Path) -> Iterator[dict[str, Any]]:
    """What is found of each file of a run, or of the cells of a matrix."""
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
        return _settings(path, settings)

    yield one(out / PIPELINE, pipeline)
    yield one(out / STATUS, _status)
    if "matrix" in settings:
        for cell in sorted(folder for folder in out.iterdir() if folder.is_dir() and is_run(folder)):
            yield from ({**found, "file": f"{cell.name}/{found['file']}"} for found in _objects(cell))
        return
    yield from (one(path, _checkpoint) for path in checkpoint.saved(out))
    yield from (one(path, _failed) for path in sorted((out / CHECKPOINTS).glob("failed_*.npz")))
    sums = _sums(out)
    if (out / CHECKSUMS).exists():
        yield one(out / CHECKSUMS, _listed)
    done = read_status(out).get("state") == "done"
    for name in dict.fromkeys([*sums, *_declared(out, settings, done), *_present(out)]):
        yield one(out / name, partial(_output, sums.get(name)))


def _settings(path: Path, settings: dict[str, Any]) -> str:
    if "matrix" in settings:
        load_experiment(str(path))
        return "of a matrix"
    recorded = settings.get("plugins")
    if isinstance(recorded, dict) and (faults := plugins.differences(recorded)):
        return f"not checked further: {faults[0]}"
    load_pipeline(str(path))
    return ""


def _status(path: Path) -> str:
    status = read_json(path)
    return str(status["state"])


def _checkpoint(path: Path) -> str:
    state, tables = checkpoint.load(path)
    return f"step {state.step}, {len(tables['gaussians/means']):,} Gaussians"


def _failed(path: Path) -> str:
    return f"the state of a failure at step {archive.read(path)[0].get('step')}"


def _listed(path: Path) -> str:
    sums = read_json(path)
    if not isinstance(sums, dict) or not all(isinstance(value, str) for value in sums.values()):
        raise DataError("expected the SHA-256 of each file")
    return f"of {len(sums)} files"


def _sums(out: Path) -> dict[str, str]:
    """The checksums that are listed; none where the list is missing or damaged."""
    try:
        sums = read_json(out / CHECKSUMS)
    except DataError:
        return {}
    return {str(name): str(value) for name, value in sums.items()} if isinstance(sums, dict) else {}


def _declared(out: Path, settings: dict[str, Any], done: bool) -> list[str]:
    """Files that a run has when it is done."""
    if not done:
        return []
    try:
        stages = load_pipeline(str(out / PIPELINE)).stages
    except ConfigError:  # told already
        stages = []
    models = [stage.file for stage in stages if isinstance(stage, Export)]
    return [RECORDS, *([METRICS, *models] if (out / METRICS).exists() or models else [])]


def _present(out: Path) -> list[str]:
    """Records and models that are there without a checksum, such as those of a run that is not done."""
    names = [name for name in (METRICS, RECORDS) if (out / name).exists()]
    return [*names, *sorted(path.name for path in out.glob("*.ply"))]


def _output(expected: str | None, path: Path) -> str:
    """Look at one output; return what it is.  Raises the errors of its reader, DataError where its bytes changed."""
    if expected is not None and sha256(path) != expected:
        raise DataError("differs from its checksum")
    if path.name == METRICS:
        return f"{read_metrics(path).gaussians:,} Gaussians"
    if path.name == RECORDS:
        return f"{len(Records(path.parent).read())} lines"
    if path.suffix == ".ply":
        return f"{len(load_model(path)):,} Gaussians"
    if path.suffix == ".png":
        height, width = read_image(path).shape[:2]
        return f"{width} x {height} px"
    path.stat()
    return ""
