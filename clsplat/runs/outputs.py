"""The files that a run has at its end."""

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from clsplat.core.errors import ConfigError, DataError, OutputError
from clsplat.core.files import (
    BEFORE_A_RUN,
    CHECKSUMS,
    LOCK,
    LOG_FILE,
    METRICS,
    OF_A_RUN,
    PIPELINE,
    RECORDS,
    STATUS,
    TRIAL,
    is_there,
    write_text,
)
from clsplat.core.machine import Owner
from clsplat.core.reading import read_file, read_json, sha256
from clsplat.pipeline.loading import Pipeline, load
from clsplat.runs.recovery import Course, is_below
from clsplat.runs.results import read_metrics
from clsplat.runs.state import has_begun, not_whole, read_sums, sum_of
from clsplat.stages.report import is_by_heart
from clsplat.training.run import Run
from clsplat.training.stage import Stage, Training


def write_metrics(pipeline: Pipeline, run: Run) -> None:
    """Write what the run has come to, and where its files are: of each kind of stage that of the last."""
    trained = next((stage.stage for stage in reversed(pipeline.stages) if isinstance(stage, Training)), "optimize")
    spent = {**run.status.seconds, trained: run.train_seconds}  # of this process, but training of all
    files = {stage.stage: path for stage in pipeline.stages for path in stage.outputs(run.out)[:1]}
    metrics = {
        "test": run.metrics.get("test", {}),
        "train": run.metrics.get("train", {}),
        **({"validation": run.metrics["validation"]} if "validation" in run.metrics else {}),
        **({"kept": run.best.figures()} if run.best else {}),
        **({"by_heart": True} if is_by_heart(run) else {}),
        "gaussians": run.gaussians,
        **({"parameters": run.learned_field.parameters} if run.learned_field else {}),
        "steps": run.step,
        "train_seconds": round(run.train_seconds, 3),
        "cpu_seconds": round(run.cpu_seconds, 3),
        "device_memory": run.device.peak,
        "seed": run.seed,
        "device": run.device.text,
        "pipeline": run.name,
        "seconds": {name: round(seconds, 3) for name, seconds in spent.items()},
        "scene": str(run.scene.path.resolve()),
        "files": {name: path.relative_to(run.out).as_posix() for name, path in files.items()},
        **({"preparation": run.found} if run.found else {}),
        **({"changes": run.changes} if run.changes else {}),
    }
    write_text(run.out / METRICS, json.dumps(metrics, indent=1) + "\n")


@dataclass(frozen=True)
class Lost:
    """Files of an earlier end of a run that are missing or changed."""

    repeatable: list[Path] = field(default_factory=list)  # that a stage which has ended can write again
    gone: dict[Path, tuple[str, str | None]] = field(default_factory=dict)
    """Those that no stage writes again, each with the SHA-256 of what was written, and of what is there."""
    is_unlisted: bool = False
    """Whether the list of what a run that was done had written is lost itself."""


def keep_checksums(course: Course, run: Run) -> Lost:
    """Leave in the list what holds while the run goes on: the files that it does not write.  Return what is lost.

    What cannot be made again stays in the list, so that it is not taken for whole at the end.
    """
    sums = read_sums(run.out)
    is_unlisted = sums is None and run.status.was_done
    if sums is None:
        sums = run.written if is_unlisted else {}
    sums = {name: value for name, value in sums.items() if not course.writes(run.out / name)}
    lost = not_whole(run.out, sums)
    gone = {file: (sums[_name(file, run)], sum_of(file)) for file in lost if not course.mends(file)}
    going_on = {name for name in sums if run.out / name not in lost and course.may_write(run.out / name)}
    _write_sums(run, {name: value for name, value in sums.items() if name not in going_on})
    return Lost([file for file in lost if file not in gone], gone, is_unlisted)


def renew_checksums(stage: Stage, run: Run) -> None:
    """Put what a stage has written again into the list that the run goes on with."""
    sums = read_sums(run.out) or {}
    for name in [name for name in sums if is_below(run.out / name, stage.outputs(run.out))]:
        sums[name] = sum_of(run.out / name) or sums[name]
    _write_sums(run, sums)


def write_checksums(pipeline: Pipeline, run: Run, gone: Mapping[Path, tuple[str, str | None]]) -> None:
    """Write the SHA-256 of every file that the run has at its end, by its path in the run folder.

    Files that are `gone` keep that of what was written, unless they were made anew after all.
    """
    found = [run.out / name for name in (PIPELINE, METRICS, RECORDS, TRIAL)]
    for place in (path for stage in pipeline.stages for path in stage.outputs(run.out)):
        found += sorted(place.rglob("*")) if place.is_dir() else [place]
    sums = {_name(path, run): sha256(path, kind=OutputError) for path in dict.fromkeys(found) if path.is_file()}
    for file, (written, damaged) in gone.items():
        if file == run.out / RECORDS or sums.get(_name(file, run)) == damaged:
            sums[_name(file, run)] = written
    _write_sums(run, sums)


def _write_sums(run: Run, sums: Mapping[str, str]) -> None:
    if sums:
        write_text(run.out / CHECKSUMS, json.dumps(sums, indent=1) + "\n")
    else:
        (run.out / CHECKSUMS).unlink(missing_ok=True)


def _name(path: Path, run: Run) -> str:
    return path.relative_to(run.out).as_posix()


def check_places(pipeline: Pipeline, out: Path) -> None:
    """Raise ConfigError where a run in `out` would write elsewhere, or over files that no run there has made.

    Raises OutputError where there can be no such folder.
    """
    is_there(out)
    folder, scene = out.resolve(), pipeline.settings.scene
    if folder == folder.parent:
        raise ConfigError(f"{out}: is the root of a file system; give another folder for the run")
    taken = [folder, folder.parent] if pipeline.settings.prepare else [folder]  # the photographs' folder is hashed
    if scene.path is not None and scene.folder.resolve() in taken:
        raise ConfigError(f"{out}: is the folder of the photographs, or right in it; give another folder for the run")
    check_names(out, OF_A_RUN)
    own = [path for stage in pipeline.stages for path in stage.outputs(out)]
    _require_inside(out, own)
    if not has_begun(out):
        _require_free(own)


def check_names(out: Path, names: Collection[str]) -> None:
    """Raise ConfigError where a name that a run or a matrix writes in `out` is taken by a file that none has made."""
    files = [out / name for name in sorted(names)]
    _require_inside(out, files)
    if not has_begun(out):
        before = BEFORE_A_RUN if _names_a_process(out / STATUS) else {LOCK} if _is_lock(out / LOCK) else set()
        _require_free(file for file in files if file.name not in before)


def _is_lock(file: Path) -> bool:
    """Whether a file is run.lock as a process that was killed leaves it, also before it has written all of it."""
    begin = b'{"process": '
    return file.is_file() and begin.startswith(read_file(file)[: len(begin)])


def _names_a_process(file: Path) -> bool:
    try:
        found = read_json(file)
    except DataError:
        return False
    return isinstance(found, dict) and Owner.named_by(found) is not None


def _require_inside(out: Path, files: Iterable[Path]) -> None:
    folder = out.resolve()
    for path in files:
        if not path.resolve().is_relative_to(folder):
            raise ConfigError(f"{path}: a link leads outside of the run folder; remove it, or choose another name")


def _require_free(files: Iterable[Path]) -> None:
    for path in files:
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise ConfigError(f"{path}: exists, and is not of this run; give another folder for the run")


def check_outputs(pipeline: Pipeline, run: Run, gone: Collection[Path] = ()) -> None:
    """Read back the files of a run, but of the stages whose files are `gone`, which a warning has named.

    Raises OutputError where one is missing or damaged.
    """
    try:
        read_metrics(run.out / METRICS)
        load(str(run.out / PIPELINE))
        for stage in acting(pipeline):
            if not any(is_below(file, stage.outputs(run.out)) for file in gone):
                stage.verify(run)
    except (ConfigError, DataError) as error:
        raise OutputError(f"{error}, at the end of the run; see {run.out / LOG_FILE}") from error


def acting(pipeline: Pipeline) -> Iterator[Stage]:
    """The stages of a whole run, each training with those of its `during` that have run."""
    step = 0
    for stage in pipeline.stages:
        yield stage
        if isinstance(stage, Training):
            yield from stage.acting(step)
            step += stage.steps
