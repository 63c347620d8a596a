"""Verify that a run folder has all required files, and that every file is intact."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError, DataError, one_line, shell_quote, shorten, size_text
from clsplat.core.files import (
    CHECKPOINTS,
    CHECKSUMS,
    COMPARISON,
    INPUTS,
    METRICS,
    PIPELINE,
    PREPARE_SUMMARY,
    RECORDS,
    STATUS,
    is_inside,
    path_exists,
)
from clsplat.core.page import require_complete
from clsplat.core.reading import read_json, sha256
from clsplat.formats.table import endings
from clsplat.gaussians.model import load as load_model
from clsplat.gaussians.validate import examine, is_model
from clsplat.nerf.files import is_field, load_field
from clsplat.pipeline import plugins
from clsplat.pipeline.files import origin, shipped_pipelines
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import load_experiment
from clsplat.prepare.cache import read_summary
from clsplat.runs.outputs import declared_outputs
from clsplat.runs.results import read_metrics, read_settings
from clsplat.runs.state import Phase, RunState
from clsplat.scene.identity import Identity
from clsplat.scene.images import read_image
from clsplat.training import archive, checkpoint
from clsplat.training.records import Records
from clsplat.training.status import parse_status

# One check per kind of file.  Each returns a description of the file, and raises an error if the file is damaged.


def require_sum(expected: str | None, path: Path) -> None:
    if expected is not None and sha256(path) != expected:
        raise DataError("does not match its checksum")


def check_settings(state: RunState, settings: dict[str, Any], path: Path) -> str:
    settings.update(read_settings(state.out))
    require_sum((state.sums or {}).get(PIPELINE), path)
    if "matrix" in settings:
        load_experiment(str(path))
        return "of a matrix"
    recorded_plugins = settings.get("plugins")
    if isinstance(recorded_plugins, dict) and (faults := plugins.differences(recorded_plugins)):
        return f"not checked further: {faults[0]}"
    load(str(path))
    return ""


def check_status(path: Path) -> str:
    content = read_json(path)
    status = parse_status(content)
    return status.state if status else f"not checked further: format {content['format']} of a newer version"


def check_checkpoint(path: Path) -> str:
    if path.name.startswith("failed"):
        return f"the state of a failure at step {archive.read(path)[0].get('step')}"
    state, tables = checkpoint.load(path)
    gaussians = None if state.field else len(tables["gaussians/means"])
    return f"step {state.step}, {size_text(gaussians, state.field['parameters'] if state.field else None)}"


def check_prepare_summary(path: Path) -> None:
    if read_summary(path.parent) is None:
        raise DataError("expected the hash and the folder of the prepared photos")


def check_sums(expected: list[str], path: Path) -> str:
    sums = read_json(path)
    if not isinstance(sums, dict) or not all(isinstance(value, str) for value in sums.values()):
        raise DataError("expected the SHA-256 of each file")
    faults = [f"'{shorten(name)}' is not a file of the run" for name in sums if not is_inside(name)]
    if missing_names := [f"'{name}'" for name in expected if name not in sums]:
        faults.append(f"lacks {', '.join(missing_names)}")
    if faults:
        raise DataError("; ".join(faults))
    return f"of {len(sums)} files"


def check_output(expected: str | None, path: Path) -> str:
    """Check an output file, and return its description.

    expected: the checksum of the file.  Raises DataError if the file has a different checksum, and the errors of the
    file's reader.
    """
    require_sum(expected, path)
    if path.name == METRICS:
        metrics = read_metrics(path)
        return size_text(metrics.gaussians, metrics.parameters, metrics.sky_gaussians)
    if path.name == RECORDS:
        return f"{len(Records(path.parent).read())} lines"
    if path.name.lower().endswith(tuple(endings(reads=True))):
        return f"{len(load_model(path)):,} Gaussians"
    if path.suffix == ".png":
        height, width = read_image(path).shape[:2]
        return f"{width} x {height} px"
    return ""


NO_SUMS = "is missing, as in every run of a Trainer; without it, outputs cannot be verified"


def verify(state: RunState) -> dict[str, Any]:
    """Verify all files of a run or a matrix.  Raises DataError if the folder has no run.

    Returns a dictionary with these keys:
    run, state: the folder, and the state of the run
    whole: whether all files are intact
    objects: for each file its name (`file`), whether it is intact (`whole`), and a description or error (`detail`)
    remedy: how to restore the files, if any is damaged
    Files of later stages may be missing in an unfinished run.
    """
    out = state.out
    if state.phase is Phase.EMPTY:
        raise DataError(f"{out}: has neither pipeline.yaml nor status.json; expected a run folder")
    cells: dict[str, RunState] = {}
    objects = list(_check_files(state, cells))
    bad_files = [entry["file"] for entry in objects if not entry["whole"]]
    result = {"run": str(out), "state": state.state_name, "whole": not bad_files, "objects": objects}
    if bad_files:
        cell = cells.get(bad_files[0].partition("/")[0])
        result["remedy"] = _remedy(cell if cell and cell.phase else state, result)
    return result


def _check_files(state: RunState, cells: dict[str, RunState], expect_all: bool = False) -> Iterator[dict[str, Any]]:
    """Yield the result for each file of a run, or of all cells of a matrix.

    cells: a dictionary to which the states of the cells' folders are added, by name.  expect_all: whether all files of
    a finished run must exist.
    """
    out, names, status, sums = state.out, state.names, state.status, state.sums or {}
    settings: dict[str, Any] = {}
    # while a run continues, checksums.json does not list pipeline.yaml
    has_ended = CHECKSUMS in names and (PIPELINE in sums or not sums)
    is_done = expect_all or state.phase is Phase.DONE or (not status and has_ended)
    check_one = partial(check_file, out)
    yield check_one(PIPELINE, partial(check_settings, state, settings))
    yield check_one(STATUS, check_status)
    if "matrix" in settings or "cells" in status:
        cells |= _find_cells(out, is_done)
        for name, cell in sorted(cells.items()):
            yield from ({**entry, "file": f"{name}/{entry['file']}"} for entry in _check_files(cell, {}, is_done))
        if is_done or COMPARISON in names:
            yield check_one(COMPARISON, require_complete)
        return
    checkpoints = [*(path.name for path in state.checkpoints), str(status.get("checkpoint") or "")]
    checkpoints += sorted(path.name for path in (out / CHECKPOINTS).glob("failed_*.npz"))
    for name in filter(is_inside, dict.fromkeys(checkpoints)):
        yield check_one(f"{CHECKPOINTS}/{name}", check_checkpoint)
    files = [RECORDS, METRICS] if is_done else []
    with suppress(ConfigError):  # reported for its own file
        files += declared_outputs(state.pipeline) if is_done else []
    if CHECKSUMS in names:
        yield check_one(CHECKSUMS, partial(check_sums, [PIPELINE, *files] if is_done else []))
    elif is_done:
        yield {"file": CHECKSUMS, "whole": False, "detail": NO_SUMS}
    if is_done or INPUTS in names:
        yield check_one(INPUTS, lambda path: Identity.from_data(read_json(path)))
    if (is_done and settings.get("prepare")) or PREPARE_SUMMARY in names:
        yield check_one(PREPARE_SUMMARY, check_prepare_summary)
    for name in dict.fromkeys([*sums, *files, *sorted({METRICS, RECORDS} & names)]):
        if name != PIPELINE:
            yield check_one(name, partial(check_output, sums.get(name)))


def check_file(out: Path, name: str, check: Callable[[Path], Any]) -> dict[str, Any]:
    """Check one file, and return its entry for `objects` in the result of `verify`."""
    path = out / name
    try:
        if not path.exists():
            raise DataError("is a broken link" if path.is_symlink() else "is missing")
        detail = check(path)
        return {"file": name, "whole": True, "detail": detail if isinstance(detail, str) else ""}
    except Exception as error:  # whatever is wrong with one file, check the others too
        reason = one_line(error).removeprefix(f"{path}: ") or type(error).__name__
        return {"file": name, "whole": False, "detail": reason}


def _find_cells(out: Path, is_done: bool) -> dict[str, RunState]:
    """Return the states of the existing cell folders by name, or of all cells if the matrix is done."""
    folders = [path for path in out.iterdir() if path.is_dir() and not path.is_symlink()]
    cells = {path.name: state for path in folders if (state := RunState.read(path)).phase}
    with suppress(ConfigError):  # reported for the file of the pipeline
        experiment = load_experiment(str(out / PIPELINE)) if is_done else None
        for cell in experiment.cells if experiment else ():
            cells.setdefault(cell.name, RunState.read(out / cell.name))
    return cells


# The verdict of `clsplat check RUN`.


def verdict(result: dict[str, Any]) -> str:
    """Format the result of `verify` as one sentence."""
    files = [entry["file"] for entry in result["objects"] if not entry["whole"]]
    if not files:
        return f"{result['run']}: {result['state']}; all {len(result['objects'])} files are intact"
    if all(entry["whole"] or entry["detail"] == NO_SUMS for entry in result["objects"]):
        return f"{result['run']}: {result['state']}; {files[0]} {NO_SUMS}"
    names = ", ".join(files[:3]) + (", …" if len(files) > 3 else "")
    return (
        f"{result['run']}: {result['state']}; {len(files)} of {len(result['objects'])} files are damaged or missing: "
        f"{names}; copy them again, or {result['remedy']}"
    )


def _remedy(state: RunState, verified: dict[str, Any]) -> str:
    """Return advice on how to restore the files of a run: from an intact checkpoint, or by a new start of the run."""
    if state.phase is Phase.DONE and "cells" not in state.status and not state.bad_files and PIPELINE in state.names:
        return "ignore them: all outputs are intact, and only longer training needs these files"
    intact_files = {Path(verified["run"], entry["file"]) for entry in verified["objects"] if entry["whole"]}
    can_continue = "cells" in state.status or any(path in intact_files for path in state.checkpoints)
    can_continue |= state.phase < Phase.LOST_STATE and not (state.checkpoints or state.status.get("checkpoint"))
    if state.out / PIPELINE not in intact_files:
        option = "--resume" if can_continue else "--restart"
        return f"run its `clsplat run … --out {shell_quote(state.out)}` again, with {option}"
    if can_continue:
        return f"`clsplat resume {shell_quote(state.out)}` repeats the stages after its newest checkpoint"
    return f"start over: {state.restart_command}"


def format_files(result: dict[str, Any]) -> str:
    """Format the result of `verify` as text, one line per file."""
    rows = (
        (f"{'ok     ' if entry['whole'] else 'DAMAGED'}  {entry['file']}", entry["detail"])
        for entry in result["objects"]
    )
    return "\n".join(", ".join(filter(None, row)) for row in rows)


# `clsplat check` of a pipeline, a matrix, a run folder, or a model.


def check(pipeline: str) -> dict[str, Any]:
    """Check the pipeline, matrix, run folder, model, or field at a path, or the shipped pipeline with this name.

    Returns a dictionary that depends on what was checked:
    pipeline: its `path`, `name`, and `stages`, and the keys whose values `adapt` will choose (`adapts`)
    matrix: its `path`, `name`, and `cells`
    run folder, model: the result of `verify` or `examine`
    field: its `path` and `name`, and its number of `parameters`
    Raises ConfigError, and DataError for a folder without a run.
    """
    if is_field(Path(pipeline)) and path_exists(Path(pipeline)):
        return {"path": pipeline, "name": Path(pipeline).name, "parameters": load_field(pipeline).shape.parameter_count}
    state = RunState.read(Path(pipeline))
    if not state.phase and pipeline not in shipped_pipelines() and is_model(Path(pipeline)):
        return examine(Path(pipeline))
    if len(Path(pipeline).parts) > 1 and not path_exists(origin(Path(pipeline))):
        raise ConfigError(f"{pipeline}: no such file or folder; expected a pipeline, a model, or a run folder")
    if Path(pipeline).is_dir() and (state.phase or pipeline not in shipped_pipelines()):
        return verify(state)
    if experiment := load_experiment(pipeline):
        return {
            "path": str(experiment.path),
            "name": experiment.name,
            "cells": [cell.name for cell in experiment.cells],
        }
    loaded_pipeline = load(pipeline)
    stages = {"stages": loaded_pipeline.names, "adapts": loaded_pipeline.undecided}
    return {"path": str(origin(loaded_pipeline.path)), "name": loaded_pipeline.settings.name, **stages}
