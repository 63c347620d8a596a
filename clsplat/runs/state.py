"""What a folder holds of a run."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from clsplat.core.errors import ClsplatError, ConfigError, DataError, in_shell
from clsplat.core.files import CHECKSUMS, METRICS, PIPELINE, STATUS, is_inside
from clsplat.core.reading import read_json, sha256
from clsplat.core.settings import variants
from clsplat.pipeline.loading import Pipeline, load, with_decisions, without_auto
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.runs.results import read_metrics
from clsplat.stages.optimize import Optimize
from clsplat.training import checkpoint
from clsplat.training.settings_diff import Difference, first_difference
from clsplat.training.stage import Stage, Training
from clsplat.training.status import read_status


def has_pipeline(folder: Path) -> bool:
    """Whether a folder holds the pipeline of a run, or of a matrix."""
    return (folder / PIPELINE).is_file()


def has_begun(out: Path) -> bool:
    """Whether a run has begun in a folder, whatever is left of it."""
    is_listed = bool(read_status(out)) and read_sums(out) is not None
    return (out / PIPELINE).exists() or bool(checkpoint.saved(out)) or is_listed


def has_state(folder: Path) -> bool:
    """Whether a folder holds a run or a matrix, or what one has said before it began."""
    return has_pipeline(folder) or (folder / STATUS).is_file()


def is_done(out: Path) -> bool:
    """Whether a run has come to its end in a folder, whose files may have been lost since."""
    return read_status(out).get("state") == "done"


def is_done_with(pipeline: Pipeline, out: Path) -> bool:
    """Whether that was a run of this pipeline."""
    with suppress(ConfigError):  # a damaged file
        return is_done(out) and _difference(load(str(out / PIPELINE)), pipeline) is None
    return False


def has_ended(pipeline: Pipeline, out: Path) -> bool:
    """Whether a run of this pipeline has come to its end.  Raises ConfigError when that was with other settings."""
    if not is_done(out) or not has_pipeline(out):
        return False
    try:
        before = load(str(out / PIPELINE))
    except ConfigError:
        if out / PIPELINE in changed(out):  # the run writes it again, or says that it cannot go on
            return False
        raise
    if difference := _difference(before, pipeline):
        raise ConfigError(f"{out}: was run with other settings: {difference}; use another folder, or those settings")
    return True


def _difference(before: Pipeline, now: Pipeline) -> Difference | None:
    """The first setting in which what was asked of a run is another now, by what the run decided; None: there is none.

    Raises ConfigError.
    """
    old, new = (without_auto(one.resolved()) for one in (before, with_decisions(now, before.decisions)))
    return first_difference({**old, "adapt": None}, {**new, "adapt": None})


def restart(out: Path) -> str:
    """The command that begins a run again."""
    pipeline = "…"
    with suppress(ConfigError):  # where it is lost
        load(str(out / PIPELINE))
        pipeline = in_shell(out / PIPELINE)
    return f"`clsplat run {pipeline} --out {in_shell(out)} --restart`"


def read_sums(out: Path) -> dict[str, str] | None:
    """The list of checksums; None where it is missing or damaged."""
    try:
        sums = read_json(out / CHECKSUMS)
    except DataError:
        return None
    return {name: str(value) for name, value in sums.items() if is_inside(name)} if isinstance(sums, dict) else None


def changed(out: Path) -> list[Path]:
    """The files of a finished run that are missing or not as they were written; the list of them where that is lost."""
    sums = read_sums(out)
    if sums is not None:
        return not_whole(out, sums)
    try:
        read_metrics(out / METRICS)
    except DataError:
        return [out / CHECKSUMS, out / METRICS]
    return [out / CHECKSUMS]


def not_whole(out: Path, sums: Mapping[str, str]) -> list[Path]:
    """The files of a list of checksums that are missing or changed."""
    return [out / name for name, expected in sums.items() if sum_of(out / name) != expected]


def sum_of(file: Path) -> str | None:
    """The SHA-256 of a file; None where it cannot be read."""
    with suppress(DataError):
        return sha256(file)
    return None


def steps_key(folder: Path) -> str:
    """Return the key of the steps in a run folder, such as optimize.steps; this one too where the file tells none."""
    try:
        data = read_yaml(folder / PIPELINE).data
    except ClsplatError:  # told when the run is resumed
        data = None
    stages = data.get("stages") if isinstance(data, dict) else None
    known = variants(Stage)
    for stage in stages if isinstance(stages, list) else ():
        name = stage.get("stage", next(iter(stage), "")) if isinstance(stage, dict) else stage
        if isinstance(name, str) and issubclass(known.get(name, Stage), Training):
            return f"{name}.steps"
    return f"{Optimize.model_fields['stage'].default}.steps"
