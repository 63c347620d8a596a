"""Run each step of `prepare:` once: its result lies in a folder whose name is the hash of everything it depends on."""

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
from clsplat.core.progress import Count
from clsplat.core.reading import read_json, sha256
from clsplat.prepare.database import IMAGES, MODEL
from clsplat.prepare.features import CameraModel
from clsplat.prepare.gather import link, require_folder
from clsplat.prepare.mapping import Mapper
from clsplat.prepare.matching import Matching
from clsplat.prepare.steps import FindFeatures, MapCameras, MatchFeatures, Step

LOG = logging.getLogger("clsplat")
RECORD = "record.json"


@dataclass(frozen=True)
class PlannedStep:
    """A step and the folder of its result."""

    step: Step
    origin: str  # folder of the photographs, which the first step reads
    inputs: str  # hash of its inputs
    folder: Path
    why: str  # reason to run the step; "" when its result exists

    @property
    def key(self) -> str:
        """Hash of everything that the result depends on."""
        return _digest([self.step.stage, self.step.version, self.step.model_dump(mode="json"), self.inputs])


def plan(steps: Sequence[Step], source: Path, root: Path) -> list[PlannedStep]:
    """Return the steps for the photographs in `source`, with the reasons to run them; results lie below `root`.

    Raises DataError when the photographs cannot be read.
    """
    planned: list[PlannedStep] = []
    inputs = fingerprint(source, root.parent)
    for step in steps:
        key = PlannedStep(step, str(source.resolve()), inputs, Path(), "").key
        folder = root / f"{step.stage}-{key[:12]}"
        planned.append(PlannedStep(step, str(source.resolve()), inputs, folder, _why(step, inputs, folder, source)))
        inputs = key
    done = max((i for i, one in enumerate(planned) if not one.why), default=-1)
    return [
        replace(one, why="") if i < done else one for i, one in enumerate(planned)
    ]  # not needed: a later result exists


def prepare(
    planned: Sequence[PlannedStep],
    source: Path,
    root: Path,
    begun: Callable[[str], AbstractContextManager[Any]] = nullcontext,
) -> Path:
    """Run the steps that have a reason, each inside of `begun(name)`, and return the last result.

    Raises OutputError where another process makes one of the results, and the errors of the steps.
    """
    count = Count("steps of the preparation", len(planned), is_even=False)
    for number, one in enumerate(planned):
        count.reach(number)
        with _only_one_making(one) if one.why else nullcontext():
            if one.why and _fault(one.folder):  # or made by another process since
                with begun(one.step.stage):
                    _do(one, source, root)
            else:
                LOG.info("%s: exists in %s", one.step.stage, one.folder)
                for text in one.step.warnings(record_of(one.folder)):
                    LOG.warning("%s", text)
        source = one.folder
    return source


@contextmanager
def _only_one_making(one: PlannedStep) -> Iterator[None]:
    """Hold a result: what an interrupted call left is gone on with by one process alone."""
    with raising_output_error(one.folder.parent):
        make_folder(one.folder.parent)
    with lock.lock_folder(one.folder, one.folder.with_name(f".{one.folder.name}.lock")):
        yield


def fingerprint(folder: Path, without: Path) -> str:
    """Return a hash of names and contents of all files below a folder, without hidden ones and those below `without`.

    Raises DataError when there is no such folder, or a file in it cannot be read.
    """
    require_folder(folder)
    parts = []
    for base, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if name[0] != "." and not _same(Path(base) / name, without))
        for name in sorted(files):
            path = Path(base) / name
            if name[0] != "." and path.is_file():
                parts.append([path.relative_to(folder).as_posix(), sha256(path)])
    return _digest(parts)


def make_note(planned: Sequence[PlannedStep]) -> dict[str, str]:
    """Return the note for a run folder: the hash of the prepared photographs, and their folder."""
    return {"inputs": planned[-1].key, "folder": str(planned[-1].folder)}


def read_note(out: Path) -> dict[str, str] | None:
    """Return the note of a run folder, or None."""
    try:
        text = read_json(out / PREPARE_SUMMARY)
        return {"inputs": str(text["inputs"]), "folder": str(text["folder"])}
    except (DataError, KeyError, TypeError):
        return None


def _same(path: Path, other: Path) -> bool:
    return path.resolve() == other.resolve()


def _do(one: PlannedStep, source: Path, root: Path) -> None:
    """Make a result in a hidden folder beside its own, and rename it when it is complete and on the disk.

    A step that resumes finds there what an interrupted call has made of the same inputs with the same settings.
    """
    temporary = one.folder.with_name(f".{one.folder.name}")
    LOG.info("%s: %s", one.step.stage, one.why)
    start = time.perf_counter()
    try:
        if one.step.resumes:
            remove_partial_files(temporary, border=RECORD)
        else:
            shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True, exist_ok=True)
        summary = one.step.make(source.resolve(), temporary, root.parent)
        seconds = round(time.perf_counter() - start, 1)
        settings = one.step.model_dump(mode="json")
        made = {"origin": one.origin, "inputs": one.inputs, "settings": settings, "seconds": seconds, **summary}
        sync_below(temporary)
        write_text(temporary / RECORD, json.dumps({**made, "files": _sizes(temporary)}, indent=1) + "\n")
        if one.folder.exists():  # a damaged result
            shutil.rmtree(one.folder)
        os.replace(temporary, one.folder)
        sync_folder(one.folder.parent)
    except BaseException as error:
        if isinstance(error, DataError) or not one.step.resumes:  # the same data would be refused again
            shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            raise write_error(one.folder, error) from error
        if isinstance(error, DataError) and str(source.resolve()) != one.origin:  # it is the result of a step before
            raise DataError(str(error).replace(str(source.resolve() / IMAGES), one.origin)) from error
        raise
    LOG.info("%s: %s  %.0f s", one.step.stage, one.step.told(summary), seconds)


def record_of(folder: Path) -> dict[str, Any]:
    """The record of a result; empty where there is none, or a damaged one."""
    try:
        record = read_json(folder / RECORD)
    except DataError:
        return {}
    is_one = isinstance(record, dict) and isinstance(record.get("settings"), dict)
    return record if is_one and isinstance(record.get("files", {}), dict) else {}


def _sizes(folder: Path) -> dict[str, int]:
    """The bytes of each file below a folder, by its name there, but for a record that a killed call left.

    Files behind links, such as photographs, count too.
    """
    files = (Path(base, name) for base, _, names in os.walk(folder, followlinks=True) for name in names)
    found = {path.relative_to(folder).as_posix(): path.stat().st_size for path in sorted(files) if path.is_file()}
    return {name: size for name, size in found.items() if name != RECORD}


def _fault(folder: Path) -> str:
    """What is wrong with a result, "" where it has its record, and all the files that it lists with their sizes."""
    record = record_of(folder)
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


def _why(step: Step, inputs: str, folder: Path, source: Path) -> str:
    """The reason to run a step, "" when its result exists: the difference from the newest result."""
    if folder.exists():
        fault = _fault(folder)
        return fault and f"{fault}; the result is made again"
    found = []
    for other in folder.parent.glob(f"{step.stage}-*"):
        record = record_of(other)
        if record.get("origin") == str(source.resolve()):
            found.append((other.stat().st_mtime, record))
    if not found:
        return "no result yet"
    before = max(found, key=lambda pair: pair[0])[1]
    for name, value in step.model_dump(mode="json").items():
        if before["settings"].get(name) != value:
            return f"{name} is {value}, was {before['settings'].get(name)}"
    return "its input has changed" if before.get("inputs") != inputs else "the step itself has changed"


def _digest(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


# What the steps of `prepare` have found, as their records tell.

INTERNAL = ("origin", "inputs", "settings", "files")  # keys of a record that are not what a step has found


def step_facts(planned: Sequence[PlannedStep]) -> dict[str, dict[str, Any]]:
    """Return what each step has found, by its name; steps whose results were removed are left out."""
    records = {one.step.stage: record_of(one.folder) for one in planned}
    return {
        stage: {key: value for key, value in record.items() if key not in INTERNAL}
        for stage, record in records.items()
        if record
    }


# Make a COLMAP folder from photographs, without a pipeline: the command `clsplat data photos`.

STEPS = ".steps"  # in the folder of the scene: results from which an interrupted call continues


def place_photographs(
    source: Path,
    out: Path,
    long_side: int = 1600,
    camera_model: CameraModel = "SIMPLE_RADIAL",
    matching: Matching = "auto",
    mapper: Mapper = "incremental",
) -> int:
    """Find the cameras of the photographs in `source`, write a COLMAP folder `out`; return the number of its images.

    Raises DataError when `out` holds a model or images of another origin, OutputError when another process uses it,
    and the errors of the steps.
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
        _require_free(out)  # again: another call may have ended since
        result = prepare(plan(steps, source, out / STEPS), source, out / STEPS)
        _show(result, out)
    return int(read_json(result / RECORD)["registered"])


def _require_free(out: Path) -> None:
    """Raise DataError where the folder holds what would be written there."""
    images = out / IMAGES
    if (out / MODEL).exists():
        raise DataError(f"{out}: holds a model already, `{MODEL}`; remove it, or give another folder")
    if images.exists() and not images.is_symlink():
        raise DataError(f"{out}: holds `{IMAGES}` already; give another folder")


def _show(result: Path, out: Path) -> None:
    """Let `out` be a COLMAP folder: link the images of the last step, copy its model.  Raises OutputError."""
    with raising_output_error(out):
        (out / IMAGES).unlink(missing_ok=True)
        link(result / IMAGES, out / IMAGES)
        half = out / STEPS / f".{MODEL}"
        shutil.rmtree(half, ignore_errors=True)
        shutil.copytree(result / MODEL, half)
        sync_below(half)
        half.rename(out / MODEL)
        sync_folder(out)
