"""Run each step of `prepare:` once and keep its result in a folder named by the hash of everything it depends on."""

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clsplat.core import lock
from clsplat.core.errors import DataError
from clsplat.core.files import (
    LOCK,
    PREPARE_SUMMARY,
    make_folder,
    raising_output_error,
    remove_partial_files,
    sync_below,
    sync_folder,
    write_error,
    write_text,
)
from clsplat.core.progress import ItemCounter, logging_counts_as_debug
from clsplat.core.reading import read_json, sha256
from clsplat.prepare.database import IMAGES, MODEL
from clsplat.prepare.features import CameraModel
from clsplat.prepare.gather import link, require_folder
from clsplat.prepare.mapping import Mapper
from clsplat.prepare.matching import Matching
from clsplat.prepare.steps import FindFeatures, MapCameras, MatchFeatures, Step

LOG = logging.getLogger("clsplat")
RECORD = "record.json"
NO_RESULT = "no result yet"


@dataclass(frozen=True)
class PlannedStep:
    """A step, the folder of its result, and the reason to run it."""

    step: Step
    origin: str  # folder of the photographs, which is the input of the first step
    inputs: str  # hash of its inputs
    folder: Path
    reason: str  # why the step must run; "" if its result exists

    @property
    def key(self) -> str:
        """The hash of everything that the result depends on."""
        return _digest([self.step.stage, self.step.version, self.step.model_dump(mode="json"), self.inputs])


def plan(steps: Sequence[Step], source: Path, root: Path) -> list[PlannedStep]:
    """Return the steps for the photographs in `source`: each with its folder below `root`, and why it must run, if so.

    Raises DataError when the photographs cannot be read.
    """
    planned: list[PlannedStep] = []
    inputs = fingerprint(source, root.parent)
    for step in steps:
        key = PlannedStep(step, str(source.resolve()), inputs, Path(), "").key
        folder = root / f"{step.stage}-{key[:12]}"
        planned.append(
            PlannedStep(step, str(source.resolve()), inputs, folder, _find_reason(step, inputs, folder, source))
        )
        inputs = key
    # A step whose result is missing need not run when the result of a later step exists.
    last_result = max((i for i, step in enumerate(planned) if not step.reason), default=-1)
    return [replace(step, reason="") if i < last_result else step for i, step in enumerate(planned)]


def prepare(
    steps: Sequence[PlannedStep],
    source: Path,
    root: Path,
    stage: Callable[[str], AbstractContextManager[Any]] = nullcontext,
) -> Path:
    """Run the steps that have a reason to run, each inside `stage(name)`, and return the folder of the last result.

    Raises OutputError when another process is computing one of the results, and the errors of the steps.
    """
    counter = ItemCounter("steps of the preparation", len(steps), is_uniform=False)
    if reused_names := [planned_step.step.stage for planned_step in steps if not planned_step.reason]:
        LOG.info("reusing the results of %s in %s", ", ".join(reused_names), root)
    for i, planned_step in enumerate(steps):
        with logging_counts_as_debug():  # each step logs its own progress
            counter.reach(i)
        with _lock_result(planned_step) if planned_step.reason else nullcontext():
            if planned_step.reason and _find_fault(planned_step.folder):  # unless another process made the result
                with stage(planned_step.step.stage):
                    _run_step(planned_step, source, root)
            else:
                for warning in planned_step.step.warnings(read_record(planned_step.folder)):
                    LOG.warning("%s", warning)
        source = planned_step.folder
    return source


@contextmanager
def _lock_result(planned_step: PlannedStep) -> Iterator[None]:
    """Lock the result of a step during the block, so that only one process computes it."""
    with raising_output_error(planned_step.folder.parent):
        make_folder(planned_step.folder.parent)
    with lock.lock_folder(planned_step.folder, planned_step.folder.with_name(f".{planned_step.folder.name}.lock")):
        yield


def fingerprint(folder: Path, excluded_folder: Path) -> str:
    """Return a hash of the names and contents of the files below a folder.

    Hidden files and folders, and files in `excluded_folder`, do not affect the hash.
    Raises DataError when the folder does not exist, or when a file in it cannot be read.
    """
    require_folder(folder)
    entries = []
    for base, folders, files in os.walk(folder):
        subfolders = {name: (Path(base) / name).resolve() for name in folders if name[0] != "."}
        folders[:] = sorted(name for name, path in subfolders.items() if path != excluded_folder.resolve())
        for name in sorted(files):
            path = Path(base) / name
            if name[0] != "." and path.is_file():
                entries.append([path.relative_to(folder).as_posix(), sha256(path)])
    return _digest(entries)


def make_summary(steps: Sequence[PlannedStep]) -> dict[str, str]:
    """Return the summary of the preparation for a run folder: the hash and the folder of the prepared photographs."""
    return {"inputs": steps[-1].key, "folder": str(steps[-1].folder)}


def read_summary(out: Path) -> dict[str, str] | None:
    """Return the summary of the preparation in a run folder.  None if it is missing or damaged."""
    try:
        summary = read_json(out / PREPARE_SUMMARY)
        return {"inputs": str(summary["inputs"]), "folder": str(summary["folder"])}
    except (DataError, KeyError, TypeError):
        return None


def _run_step(planned_step: PlannedStep, source: Path, root: Path) -> None:
    """Make a result in a hidden folder, and rename the folder when it is complete and synced to the disk.

    A resumable step continues from the files that an interrupted call with the same inputs and settings left there.
    """
    temporary = planned_step.folder.with_name(f".{planned_step.folder.name}")
    if planned_step.reason != NO_RESULT:
        LOG.info("%s runs again: %s", planned_step.step.stage, planned_step.reason)
    start = time.perf_counter()
    try:
        if planned_step.step.resumes:
            remove_partial_files(temporary, marker=RECORD)
        else:
            shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True, exist_ok=True)
        result = planned_step.step.make(source.resolve(), temporary, root.parent)
        seconds = round(time.perf_counter() - start, 1)
        settings = planned_step.step.model_dump(mode="json")
        record = {
            "origin": planned_step.origin,
            "inputs": planned_step.inputs,
            "settings": settings,
            "seconds": seconds,
            **result,
        }
        sync_below(temporary)
        write_text(temporary / RECORD, json.dumps({**record, "files": _file_sizes(temporary)}, indent=1) + "\n")
        if planned_step.folder.exists():  # a damaged result
            shutil.rmtree(planned_step.folder)
        os.replace(temporary, planned_step.folder)
        sync_folder(planned_step.folder.parent)
    except BaseException as error:
        if isinstance(error, DataError) or not planned_step.step.resumes:  # the same data would fail again
            shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            raise write_error(planned_step.folder, error) from error
        if (
            isinstance(error, DataError) and str(source.resolve()) != planned_step.origin
        ):  # name the user's folder instead of the folder of a result
            raise DataError(str(error).replace(str(source.resolve() / IMAGES), planned_step.origin)) from error
        raise
    LOG.info("%s (%.0f s)", planned_step.step.summary(result), seconds)


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record in the folder of a result.  Empty if it is missing or damaged."""
    try:
        record = read_json(folder / RECORD)
    except DataError:
        return {}
    is_record = isinstance(record, dict) and isinstance(record.get("settings"), dict)
    return record if is_record and isinstance(record.get("files", {}), dict) else {}


def _file_sizes(folder: Path) -> dict[str, int]:
    """Return the sizes in bytes, by relative path, of all files below a folder except the record.

    Links, such as links to photographs, are followed.
    """
    files = (Path(base, name) for base, _, names in os.walk(folder, followlinks=True) for name in names)
    sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in sorted(files) if path.is_file()}
    return {name: size for name, size in sizes.items() if name != RECORD}


def _find_fault(folder: Path) -> str:
    """Return the fault of a result, or "" if its record exists and every listed file has the recorded size."""
    record = read_record(folder)
    if not record:
        return f"{RECORD} is missing or damaged"
    files = record.get("files", {})
    for name in files:
        path = folder / str(name)
        if not os.path.isfile(path):
            return f"{name} is missing"
        if path.stat().st_size != files[name]:
            return f"{name} was changed"
    return ""


def _find_reason(step: Step, inputs: str, folder: Path, source: Path) -> str:
    """Return why a step must run: a damaged result, or what changed since the newest result.  "" if it need not run."""
    if folder.exists():
        fault = _find_fault(folder)
        return fault and f"{fault}; the result is recomputed"
    results = []
    for path in folder.parent.glob(f"{step.stage}-*"):
        record = read_record(path)
        if record.get("origin") == str(source.resolve()):
            results.append((path.stat().st_mtime, record))
    if not results:
        return NO_RESULT
    newest = max(results, key=lambda pair: pair[0])[1]
    for name, value in step.model_dump(mode="json").items():
        if newest["settings"].get(name) != value:
            return f"{name} changed from {newest['settings'].get(name)} to {value}"
    return "its input has changed" if newest.get("inputs") != inputs else "the step itself has changed"


def _digest(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


INTERNAL = ("origin", "inputs", "settings", "files")  # keys of a record that are not statistics of the step


def read_statistics(planned: Sequence[PlannedStep]) -> dict[str, dict[str, Any]]:
    """Return the statistics of each step, by the name of the step.  Steps whose results were removed are omitted."""
    records = {planned_step.step.stage: read_record(planned_step.folder) for planned_step in planned}
    return {
        stage: {key: value for key, value in record.items() if key not in INTERNAL}
        for stage, record in records.items()
        if record
    }


# Make a COLMAP folder from photographs without a pipeline, as `clsplat data photos` does.

STEPS = ".steps"  # folder in the scene for results, from which an interrupted call continues


def place_photographs(
    source: Path,
    out: Path,
    long_side: int = 1600,
    camera_model: CameraModel = "SIMPLE_RADIAL",
    matching: Matching = "auto",
    mapper: Mapper = "incremental",
) -> int:
    """Find the cameras of the photographs in `source`, and write a COLMAP folder `out`.

    Returns the number of registered images.

    Raises DataError when `out` contains other images or a model, OutputError when another process uses it, and the
    errors of the steps.
    """
    _require_free(out)
    steps: list[Step] = [
        FindFeatures(long_side=long_side, camera_model=camera_model),
        MatchFeatures(matching=matching),
        MapCameras(mapper=mapper),
    ]
    with raising_output_error(out):
        make_folder(out / STEPS)
    with lock.lock_folder(out, out / STEPS / LOCK):
        _require_free(out)  # again, since another call may have finished meanwhile
        result = prepare(plan(steps, source, out / STEPS), source, out / STEPS)
        _publish(result, out)
    return int(read_json(result / RECORD)["registered"])


def _require_free(out: Path) -> None:
    """Raise DataError when the folder already contains other images or a model."""
    images = out / IMAGES
    if (out / MODEL).exists():
        raise DataError(f"{out}: already contains a model, `{MODEL}`; remove it or choose another folder")
    if images.exists() and not images.is_symlink():
        raise DataError(f"{out}: already contains `{IMAGES}`; choose another folder")


def _publish(result: Path, out: Path) -> None:
    """Link the images of the last step into `out`, and copy its model.  Raises OutputError."""
    with raising_output_error(out):
        (out / IMAGES).unlink(missing_ok=True)
        link(result / IMAGES, out / IMAGES)
        temporary = out / STEPS / f".{MODEL}"
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.copytree(result / MODEL, temporary)
        sync_below(temporary)
        temporary.rename(out / MODEL)
        sync_folder(out)
