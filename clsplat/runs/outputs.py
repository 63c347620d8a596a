"""Write and check the files of a run at its end."""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from clsplat.core.errors import ConfigError, OutputError
from clsplat.core.files import (
    CHECKSUMS,
    EARLY_RUN_FILES,
    LOCK,
    LOG_FILE,
    METRICS,
    PIPELINE,
    RECORDS,
    RUN_FILES,
    TRIAL,
    path_exists,
    write_text,
)
from clsplat.core.machine import Owner
from clsplat.core.reading import read_file, sha256
from clsplat.pipeline.loading import Pipeline
from clsplat.runs.state import Phase, RunState, find_damaged_files, is_below, read_sums
from clsplat.scene.images import is_image
from clsplat.stages.export import sky_gaussians
from clsplat.stages.report import is_overfit
from clsplat.training.run import Run
from clsplat.training.stage import Training


def write_metrics(pipeline: Pipeline, run: Run) -> None:
    """Write the results of a run to metrics.json.  For each stage name, `files` has the last stage's first output."""
    training = next((stage.stage for stage in reversed(pipeline.stages) if isinstance(stage, Training)), "optimize")
    # times of this process, except for the training time, which includes earlier processes
    seconds = {**run.status.seconds, training: run.train_seconds}
    output_paths = {stage.stage: path for stage in pipeline.stages for path in stage.outputs(run.out)[:1]}
    metrics = {
        "test": run.metrics.get("test", {}),
        "train": run.metrics.get("train", {}),
        **({"validation": run.metrics["validation"]} if "validation" in run.metrics else {}),
        **({"kept": run.best.summary()} if run.best else {}),
        **({"overfit": True} if is_overfit(run) else {}),
        "gaussians": run.gaussians,
        **({"sky_gaussians": sky} if (sky := sky_gaussians(run)) else {}),
        **({"parameters": run.learned_field.parameter_count} if run.learned_field else {}),
        "steps": run.step,
        "train_seconds": round(run.train_seconds, 3),
        "cpu_seconds": round(run.cpu_seconds, 3),
        "device_memory": run.device.peak,
        "seed": run.seed,
        "device": run.device.label,
        "pipeline": run.name,
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "scene": str(run.scene.path.resolve()),
        **({"origin": run.scene.origin.tolist()} if run.scene.origin.any() else {}),
        "files": {name: path.relative_to(run.out).as_posix() for name, path in output_paths.items()},
        **({"preparation": run.preparation} if run.preparation else {}),
        **({"changes": run.changes} if run.changes else {}),
    }
    write_text(run.out / METRICS, json.dumps(metrics, indent=1) + "\n")


def previous_sums(pipeline: Pipeline, run: Run) -> dict[str, str]:
    """Return the SHA-256, by path in the run folder, of a finished run's files that no remaining stage rewrites.

    A file whose contents differ from this hash is damaged.  The records, and the files of a training stage that
    continues, are included only if they are damaged.
    """
    sums = read_sums(run.out)  # read again: with --minutes this process may have changed them
    if sums is None:
        sums = run.model_hashes if run.status.was_done else {}
    stages = pipeline.stages[run.stage_index :]
    training_files = [path for stage in stages if isinstance(stage, Training) for path in stage.outputs(run.out)]
    rewritten_files = [path for stage in stages if not isinstance(stage, Training) for path in stage.outputs(run.out)]
    rewritten_files += [run.out / name for name in (PIPELINE, METRICS)]
    previous = {name: value for name, value in sums.items() if not is_below(run.out / name, rewritten_files)}
    damaged_names, growing_files = find_damaged_files(run.out, previous), [run.out / RECORDS, *training_files]
    return {n: value for n, value in previous.items() if n in damaged_names or not is_below(run.out / n, growing_files)}


def write_checksums(pipeline: Pipeline, run: Run, previous: Mapping[str, str]) -> None:
    """Write the SHA-256 of each file of the finished run, by path in the run folder.

    previous: checksums of files that the resumed run did not rewrite.
    """
    files = [run.out / name for name in (PIPELINE, METRICS, RECORDS, TRIAL)]
    for output in (path for stage in pipeline.stages for path in stage.outputs(run.out)):
        files += sorted(output.rglob("*")) if output.is_dir() else [output]
    new_files = [path for path in dict.fromkeys(files) if path.is_file() and _name(path, run) not in previous]
    save_checksums(run, {**{_name(path, run): sha256(path, error_type=OutputError) for path in new_files}, **previous})


def save_checksums(run: Run, sums: Mapping[str, str]) -> None:
    """Write the list of checksums, or remove its file if the list is empty."""
    if sums:
        write_text(run.out / CHECKSUMS, json.dumps(sums, indent=1) + "\n")
    else:
        (run.out / CHECKSUMS).unlink(missing_ok=True)


def _name(path: Path, run: Run) -> str:
    return path.relative_to(run.out).as_posix()


def check_output_paths(pipeline: Pipeline, state: RunState) -> None:
    """Raise ConfigError if a run would write outside of its folder, or replace files that are not from a run.

    Raises OutputError if the path of the folder is invalid.
    """
    out = state.out
    path_exists(out)
    folder, scene = out.resolve(), pipeline.settings.scene
    if folder == folder.parent:
        raise ConfigError(f"{out}: is the root of a file system; use another folder for the run")
    reserved = [folder, folder.parent] if pipeline.settings.prepare else [folder]  # `prepare` hashes the photos' folder
    is_inside = scene.path is not None and (
        scene.folder.resolve() in reserved or (state.phase < Phase.BEGUN and _is_in_photo_folder(folder, scene.folder))
    )
    if is_inside:
        raise ConfigError(f"{out}: is, or is inside, the folder of the photos; use another folder for the run")
    check_names(state, RUN_FILES, [path for stage in pipeline.stages for path in stage.outputs(out)])


def _is_in_photo_folder(out: Path, scene: Path) -> bool:
    """Return whether `out`, or a folder between `out` and the scene folder, contains photos."""
    folders_between = [path for path in (out, *out.parents) if scene.resolve() in path.parents and path.is_dir()]
    return any(is_image(file) for path in folders_between for file in path.iterdir())


def check_names(state: RunState, names: Collection[str], outputs: Sequence[Path] = ()) -> None:
    """Raise ConfigError if a file to write is outside of the run folder, or exists and is not from a run.

    names: file names in the folder of the run or matrix.  outputs: other files or folders to write.
    """
    out, files = state.out, [*(state.out / name for name in sorted(names)), *outputs]
    require_inside(out, files)
    early_files = EARLY_RUN_FILES if Owner.from_record(state.status) else {LOCK} if _is_lock(out / LOCK) else set[str]()
    leftovers = {out / name for name in early_files}  # of a run that has not started
    for path in files if state.phase < Phase.BEGUN else ():
        if path not in leftovers and (path.is_file() or (path.is_dir() and any(path.iterdir()))):
            raise ConfigError(f"{path}: exists, and is not from a run; use another folder for the run")


def require_inside(out: Path, files: Sequence[Path]) -> None:
    """Raise ConfigError if one of the files is a link to a target outside of `out`."""
    folder = out.resolve()
    if links := [path for path in files if not path.resolve().is_relative_to(folder)]:
        raise ConfigError(f"{links[0]}: links to a target outside of the run folder; remove it, or use another name")


def _is_lock(file: Path) -> bool:
    """Return whether a file is a run.lock, even if its process stopped before it had written all of it."""
    start = b'{"process": '
    return file.is_file() and start.startswith(read_file(file)[: len(start)])


def check_outputs(pipeline: Pipeline, run: Run, damaged: Collection[str] = ()) -> None:
    """Raise OutputError if an output of the run is missing, or if a model has changed since the run wrote it.

    damaged: names of files that were damaged before the run; they are not checked.
    """
    outputs = [path for stage in pipeline.stages for path in stage.outputs(run.out)]
    models = {name: value for name, value in run.model_hashes.items() if is_below(run.out / name, outputs)}
    faults = {name for name in (METRICS, PIPELINE, *declared_outputs(pipeline)) if not (run.out / name).is_file()}
    if faults := (faults | {*find_damaged_files(run.out, models)}) - {*damaged}:
        fault = "is missing, or changed after the run wrote it"
        raise OutputError(f"{run.out / min(faults)}: {fault}; see {run.out / LOG_FILE}")


def declared_outputs(pipeline: Pipeline) -> list[str]:
    """Return the output files named in the settings of the stages, as paths in the run folder."""
    fields = [(stage, *entry) for stage in pipeline.stages for entry in stage.named_outputs().items()]
    return [name for stage, key, endings in fields if endings and (name := getattr(stage, key)) is not None]
