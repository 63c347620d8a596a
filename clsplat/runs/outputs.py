"""The files that a run has at its end."""

import json
from collections.abc import Iterator
from pathlib import Path

from clsplat.compare.run_folder import read_metrics
from clsplat.errors import ConfigError, DataError, OutputError
from clsplat.files import is_there, write_text
from clsplat.names import CHECKSUMS, LOG_FILE, METRICS, PIPELINE, RECORDS
from clsplat.pipeline.loading import Pipeline, load
from clsplat.reading import sha256
from clsplat.stages.base import Stage
from clsplat.stages.optimize import Optimize
from clsplat.training import checkpoint
from clsplat.training.run import Run


def write_metrics(run: Run) -> None:
    metrics = {
        "test": run.metrics.get("test", {}),
        "train": run.metrics.get("train", {}),
        "gaussians": run.model.gaussians.count,
        "steps": run.step,
        "train_seconds": round(run.train_seconds, 3),
        "seed": run.seed,
        "device": run.device.text,
        "pipeline": run.name,
        **({"changes": run.changes} if run.changes else {}),
    }
    write_text(run.out / METRICS, json.dumps(metrics, indent=1) + "\n")


def write_checksums(pipeline: Pipeline, run: Run) -> None:
    """Write the SHA-256 of every file that the run has at its end, by its path in the run folder."""
    found = [run.out / name for name in (PIPELINE, METRICS, RECORDS)]
    for place in (path for stage in pipeline.stages for path in stage.outputs(run.out)):
        found += sorted(place.rglob("*")) if place.is_dir() else [place]
    sums = {
        path.relative_to(run.out).as_posix(): sha256(path, kind=OutputError)
        for path in dict.fromkeys(found)
        if path.is_file()
    }
    write_text(run.out / CHECKSUMS, json.dumps(sums, indent=1) + "\n")


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
    own = [path for stage in pipeline.stages for path in stage.outputs(out)]
    for path in [*own, out / LOG_FILE]:
        if not path.resolve().is_relative_to(folder):
            raise ConfigError(f"{path}: a link leads outside of the run folder; remove it, or choose another name")
    again = (out / PIPELINE).exists() or checkpoint.saved(out)
    for path in () if again else own:
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise ConfigError(f"{path}: exists, and is not of this run; give another folder for the run")


def check_outputs(pipeline: Pipeline, run: Run) -> None:
    """Read back the files of a run.  Raises OutputError where one is missing or damaged."""
    try:
        read_metrics(run.out / METRICS)
        load(str(run.out / PIPELINE))
        for stage in acting(pipeline):
            stage.verify(run)
    except (ConfigError, DataError) as error:
        raise OutputError(f"{error}, at the end of the run; see {run.out / LOG_FILE}") from error


def acting(pipeline: Pipeline) -> Iterator[Stage]:
    """The stages of a whole run, each training with those of its `during` that have run."""
    step = 0
    for stage in pipeline.stages:
        yield stage
        if isinstance(stage, Optimize):
            yield from stage.acting(step)
            step += stage.steps
