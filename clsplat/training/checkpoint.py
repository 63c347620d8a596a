"""Save and restore a run, bit for bit: parameters, Adam moments, statistics, and counters, without pickle.

Random numbers and the order of views depend only on (seed, step), so no generator state is saved.  A run state with NaN
or infinity is saved as failed_N.npz, which is never resumed.
"""

import logging
import math
import re
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from clsplat.core.errors import (
    ClsplatError,
    ConfigError,
    DataError,
    Interrupted,
    NotFiniteError,
    OutputError,
    one_line,
    shell_quote,
)
from clsplat.core.files import CHECKPOINTS, PIPELINE, open_atomic
from clsplat.core.resources import full_version
from clsplat.core.schedule import at_step
from clsplat.density.statistics import PREFIX as STATS_PREFIX
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.formats.splats import MOTION, PARAMETERS, sh_coefficients
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.model import WIDTHS
from clsplat.gaussians.structs import moment_tables
from clsplat.losses.base import ViewLosses
from clsplat.losses.image import psnr
from clsplat.scene.scene import SPLITS
from clsplat.training import archive, best_model, field
from clsplat.training.adam import Adam, Rates
from clsplat.training.archive import Arrays, split
from clsplat.training.best_model import Best, Tables, model_tables
from clsplat.training.modules.base import Scalars, module_class, modules_so_far, restore_modules
from clsplat.training.run import Run
from clsplat.training.settings_diff import differences
from clsplat.training.sh_offload import make_room

# The metadata of a checkpoint contains the state of a run without its tables.

MAX_VALUE = 10**15  # larger counts and seconds mean damage; float64 represents all smaller integers
Count = Annotated[int, Field(ge=0, le=MAX_VALUE)]
Seconds = Annotated[float, Field(ge=0, le=MAX_VALUE)]
Metrics = dict[str, dict[str, dict[str, Any]]]  # averages by split and downscale factor


class State(BaseModel):
    """The state of a run in a checkpoint, without its tables."""

    model_config = ConfigDict(strict=True, extra="forbid")

    format: int
    version: str
    step: Count
    stage_index: Count
    stage_step: Count
    during_index: Count
    edited: bool
    field: dict[str, Any] | None  # kind, shape, and parameters of a field, which is trained instead of Gaussians
    degree: Annotated[int, Field(ge=0, le=3)]
    zero_fresh: list[str]
    updates: dict[str, Count]
    scalars: dict[str, float]  # state of rules and budgets
    modules: dict[str, dict[str, float]]  # scalars of training modules, by type
    best: Best | None  # the best model by validation
    train_seconds: Seconds  # wall-clock time of training
    cpu_seconds: Seconds  # CPU time of all threads during `train_seconds`
    metrics: Metrics
    records: Count  # number of lines in metrics.jsonl
    model_hashes: dict[str, str]  # SHA-256 of model files, by path in the run folder
    changes: list[str]
    device: str
    inputs: str  # identity of the scene
    file_hashes: dict[str, str]  # hashes of the files that settings name, by path
    pipeline: dict[str, Any]

    def is_trained(self, pipeline: dict[str, Any]) -> bool:
        """Return whether the current stage has completed all the steps that a resolved pipeline gives it."""
        (stage,) = pipeline["stages"][self.stage_index].values()
        return bool(stage.get("steps") == self.stage_step)


def check_tables(state: State, tables: Arrays) -> None:
    """Raise DataError if the tables of Gaussians are incomplete, have wrong shapes, or do not fit the state."""
    if missing_names := [name for name in PARAMETERS if name not in tables]:
        raise DataError(f"it lacks {', '.join(missing_names)}")
    count = len(tables["means"])
    for name, table in tables.items():
        if table.dtype != np.float32 or table.ndim != 2 or len(table) != count:
            raise DataError(f"{name} is not a float32 array [{count}, components]")
    if count == 0:
        raise DataError("it has no Gaussians")
    parameters = [*PARAMETERS, *([MOTION] if MOTION in tables else [])]
    for name in parameters:
        if tables[name].shape[1] not in WIDTHS[name]:
            raise DataError(
                f"{name} has {tables[name].shape[1]} components; expected {' or '.join(map(str, WIDTHS[name]))}"
            )
        if name == "sh_rest" and tables[name].shape[1] < 3 * (sh_coefficients(state.degree) - 1):
            raise DataError(f"{name} has {tables[name].shape[1]} components, too few for degree {state.degree}")
        moments = [moment for moment in moment_tables(name) if moment in tables]
        if non_finite := [key for key in (name, *moments) if not np.isfinite(tables[key]).all()]:
            raise DataError(f"{non_finite[0]} has values that are not finite")
        if [tables[moment].shape for moment in moments] != [tables[name].shape] * (2 if state.updates else 0):
            raise DataError(f"the moments of {name} do not have its shape")
    if state.updates and state.updates.keys() != set(parameters):
        raise DataError("its update counts belong to other parameters")


# The tables of a run's modules, in a checkpoint and in the best model.

MODULES = "modules/"  # prefix of module names, which are prefixes of table names


def module_tables(run: Run, full: bool = True) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """Yield the tables of a run's modules with their keys in the file.  full: also tables that only training needs."""
    for module, state in run.modules.items():
        if full or state.after_training != "dropped":
            yield from ((f"{MODULES}{module}/{name}", table) for name, table in state.tables(full).items())


def check_modules(scalars: Mapping[str, Scalars], tables: Arrays) -> None:
    """Raise DataError if tables do not fit the modules.  scalars: by module; tables: by key, without MODULES."""
    for name in scalars:
        saved_tables, tables = split(tables, f"{name}/")
        module_class(name).check_saved(scalars[name], saved_tables)
    if tables:
        raise DataError(f"it has tables of modules that its metadata does not list: {', '.join(tables)}")


def reload_modules(run: Run, scalars: Mapping[str, Scalars], tables: Arrays) -> None:
    """Restore a run's modules from the scalars and tables of an earlier step."""
    for name, values in scalars.items():
        if name in run.modules and name in modules_so_far(run):
            run.modules[name].load(values, split(tables, f"{name}/")[0])


# Copies of the best model of a run, on the host.


def copy_model(run: Run) -> Tables:
    """Copy to the host the tables needed to render the run's model, or to train it further."""
    return {**model_tables(run.model), **dict(module_tables(run, full=False))}


def restore_best(run: Run, tables: Tables, best: Best) -> None:
    """Replace the run's model with the copy of its best model."""
    from_modules, parameters = split(tables, MODULES)
    reload_modules(run, best.modules, from_modules)
    run.model = run.model_settings.model(Gaussians(run.device, parameters), best.degree)


# A checkpoint has either the tables of a field, or those of Gaussians, modules, and the best model.

UPDATES = "field"  # key of a field's number of updates


def run_tables(run: Run) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """Yield the tables of a run with their keys in the file; the tables are copied to the host one at a time."""
    if run.learned_field:
        yield from ((field.FOLDER + name, table) for name, table in run.learned_field.tables().items())
        return
    gaussians = run.model.gaussians
    yield from ((_key(name), gaussians.get(name)) for name in gaussians.tables)
    yield from module_tables(run)
    yield from ((best_model.FOLDER + name, table) for name, table in run.best_tables.items())


def update_counts(run: Run) -> dict[str, int]:
    """Return the number of Adam updates of each parameter, or of the whole field if the run trains a field."""
    if run.learned_field:
        return {UPDATES: run.learned_field.updates}
    return run.adam.updates if run.adam else {}


def check_run_tables(state: State, tables: Arrays) -> None:
    """Raise DataError if tables do not match the state."""
    if state.field:
        if state.updates.keys() != {UPDATES}:
            raise DataError("its update counts are not those of a field")
        field_type = field.field_class(state.field)
        field_type.check_tables(state.field["shape"], *split(tables, field.FOLDER))
        return
    best, current = split(tables, best_model.FOLDER)
    best_model.check(state.best, _check_and_remove_modules(state.best.modules if state.best else {}, best))
    current = _check_and_remove_modules(state.modules, current)
    check_tables(state, {name.removeprefix("gaussians/"): table for name, table in current.items()})


def _check_and_remove_modules(modules: Mapping[str, Scalars], tables: Arrays) -> Arrays:
    """Check the tables of modules, and return the remaining tables."""
    from_modules, remaining = split(tables, MODULES)
    check_modules(modules, from_modules)
    return remaining


def restore_tables(run: Run, state: State, tables: Arrays) -> None:
    """Restore a run's Gaussians, modules, and optimizer, or its field, from the tables of a checkpoint."""
    if state.field:
        tables, _ = split(tables, field.FOLDER)
        field_type = field.field_class(state.field)
        run.learned_field = field_type.from_tables(state.field["shape"], tables, run.photographs.background)
        run.learned_field.updates = state.updates[UPDATES]
        return
    run.best_tables, tables = split(tables, best_model.FOLDER)
    from_modules, tables = split(tables, MODULES)
    modules = {name: (scalars, split(from_modules, f"{name}/")[0]) for name, scalars in state.modules.items()}
    run.modules = restore_modules(run, modules)
    gaussians = Gaussians(run.device, {name.removeprefix("gaussians/"): table for name, table in tables.items()})
    run.model = run.model_settings.model(gaussians, state.degree)
    if state.updates:
        make_room(run, gaussians.count)
        run.adam = Adam(gaussians)
        run.adam.updates = state.updates
        statistics = [name for name in tables if name.startswith(STATS_PREFIX) and name != SEEN]
        run.stats = SplatStats(gaussians, [name.removeprefix(STATS_PREFIX) for name in statistics])
    for key, table in tables.items():  # including those of rules, penalties and plug-ins
        name = key.removeprefix("gaussians/")
        if name not in gaussians.tables:
            gaussians.add(name, table.shape[1], zero_fresh=name in state.zero_fresh)
        gaussians.set(name, table)


def _key(table: str) -> str:
    """Return the key of a table in the file; keys of parameters start with `gaussians/`."""
    return table if "/" in table else f"gaussians/{table}"


# A remedy for parameters that are not finite.

RATE_FACTOR = 0.1  # multiplies a rate to lower it
VELOCITY = "motion.velocity"  # its rate is lowered if a motion is not finite


def suggest_rate(run: Run, broken: Collection[str]) -> str:
    """Return a `key=value` for `--set` that lowers the learning rate of one of the `broken` parameters.

    This is the parameter whose rate has the largest ratio to its default.  The value is a tenth of the current rate, or
    the default if that is smaller.  A field has only one rate.
    """
    if run.learned_field:
        (stage,) = run.pipeline["stages"][run.stage_index]
        return f"{stage}.rate={RATE_FACTOR * run.learned_field.rate:.2g}"
    stages, default = run.pipeline["stages"], Rates()
    stages_with_rates = [
        (i, name) for i, stage in enumerate(stages) for name, fields in stage.items() if "rates" in fields
    ]
    index, stage = next((item for item in reversed(stages_with_rates) if item[0] <= run.stage_index), (0, "optimize"))
    current = Rates.model_validate(stages[index].get(stage, {}).get("rates", {}))

    def rate(rates: Rates, name: str) -> float:
        return at_step(rates.motion.velocity if name == VELOCITY else getattr(rates, name), run.step)

    names = [VELOCITY if name == MOTION else name for name in broken or PARAMETERS]
    name = max(names, key=lambda name: rate(current, name) / rate(default, name))
    is_unique = [stage_name for _, stage_name in stages_with_rates].count(stage) <= 1
    value = min(RATE_FACTOR * rate(current, name), rate(default, name))
    return f"{stage if is_unique else f'stages.{index}'}.rates.{name}={value:.2g}"


FORMAT = 5
LOG = logging.getLogger("clsplat")


def save(run: Run, keep: int | None = None) -> Path:
    """Write checkpoints/step_N.npz atomically, and return its path.

    keep: number of newest checkpoints to keep; older ones are removed.  Raises NotFiniteError, after writing
    failed_N.npz, if the model is not finite; then nothing is removed.  Raises ClsplatError if called in the middle of
    a step or an edit.
    """
    if not run.is_consistent:
        raise ClsplatError(f"{run.out}: step {run.step} is incomplete, so it is not saved; resume the run")
    if bad_tables := run.find_nonfinite():
        raise NotFiniteError(f"step {run.step}: {save_failed(run, bad_tables)}")
    path = _write(run, "refit" if run.is_refit else "step")
    run.status.saved_at = time.monotonic()
    run.status.note(checkpoint=path.name)
    run.status.refresh()
    if keep is not None:
        files = list_files(run.out)
        _remove(files[: files.index(path) + 1][:-keep])  # later ones are damaged, and could not be renamed
    return path


def save_failed(run: Run, broken: list[str]) -> str:
    """Save a state that is not finite as failed_N.npz, and remove older ones; return the end of the error message."""
    try:
        path = _write(run, "failed")
        _remove(file for file in path.parent.glob("failed_*.npz") if file != path)
        state = f"the state is in {path}"
    except OutputError as error:
        state = f"the state is lost: {error}"
    checkpoints = list_files(run.out)
    return (
        f"parameters not finite: {', '.join(broken) or 'none'}; {state}; "
        f"run `clsplat resume {shell_quote(run.out)} --set {suggest_rate(run, broken)}` to lower a learning rate and "
        f"{f'resume from {checkpoints[-1].name}' if checkpoints else 'start over'}"
    )


def list_files(out: Path) -> list[Path]:
    """Return the checkpoints of a run folder from old to new.  Checkpoints of a refit come last."""
    by_rank = {
        (match[1] == "refit", int(match[2])): path
        for path in (out / CHECKPOINTS).glob("*.npz")
        if (match := re.fullmatch(r"(step|refit)_(\d+)\.npz", path.name))
    }
    return [by_rank[rank] for rank in sorted(by_rank)]


def load(path: Path) -> tuple[State, Arrays]:
    """Read a checkpoint.  Raises ConfigError if it has another format, and DataError if it is damaged.

    The message of DataError gives only the reason, not the path.
    """
    metadata, tables = archive.read(path)
    if type(metadata.get("format")) is int and metadata["format"] != FORMAT:
        raise ConfigError(
            f"{path}: has format {metadata['format']}, expected {FORMAT}; resume it with the version that wrote it, "
            "or use another --out"
        )
    try:
        state = State.model_validate(metadata)
    except ValidationError as error:
        first = error.errors()[0]
        raise DataError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    scene, stages = (state.pipeline.get(key) for key in ("scene", "stages"))
    if not isinstance(scene, dict) or not isinstance(stages, list):
        raise DataError("its pipeline has no scene or no stages")
    if state.stage_index > len(stages):  # equal if all stages have ended
        raise DataError(f"it has no stage {state.stage_index}")
    for metrics in (state.metrics, state.best.metrics if state.best else {}):
        _check_metrics(metrics)
    check_run_tables(state, tables)
    return state, tables


def _check_metrics(metrics: Metrics) -> None:
    """Raise DataError if metrics are invalid.  All values are numbers, except reasons and the origin of LPIPS."""
    averages = [average for by_downscale in metrics.values() for average in by_downscale.values()]
    values = [x for average in averages for name, x in average.items() if not re.search("_reason$|lpips_", name)]
    is_complete = all(average.get(name) is not None for average in averages for name in ("psnr", "ssim", "views"))
    if not (metrics.keys() <= set(SPLITS) and is_complete and all(isinstance(x, int | float | None) for x in values)):
        raise DataError("its metrics are not valid metrics of a run")


def restore(run: Run) -> tuple[Path | None, list[str]]:
    """Restore the newest valid checkpoint; return its path (None if there is no checkpoint) and remarks to log.

    The remarks report changes of settings and of the device.  Raises ConfigError if a setting has changed that must not
    change on resume, or if a checkpoint has another format; OutputError if all checkpoints are damaged, or if there are
    none although status.json names one.
    """
    paths = list_files(run.out)
    restart = f"start over with `clsplat run {shell_quote(run.out / PIPELINE)} --out {shell_quote(run.out)} --restart`"
    for path in reversed(paths):
        try:
            state, tables = load(path)
        except DataError as error:
            if path == paths[0]:
                raise OutputError(
                    f"{path} is damaged ({error}), and so are all other checkpoints; {restart}"
                ) from error
            LOG.warning("%s is damaged (%s); using an earlier one", path, error)
            continue
        changes = _record_changes(run, path, state)
        remarks = [f"{text}; from here on, results differ from those without this change" for text in changes]
        if state.device != run.device.label:
            remarks.append(f"the run was started on {state.device}; from here on, results may not be bit-identical")
        _restore(run, state, tables)
        return path, remarks
    if last := run.status.now.checkpoint:
        raise OutputError(f"{run.out / CHECKPOINTS}: {last} is missing; restore it, or {restart}")
    return None, []


def rename_damaged(out: Path, restored_path: Path | None) -> None:
    """Rename damaged checkpoints newer than the restored one, so that `save` does not count them toward `keep`."""
    files = list_files(out)
    for damaged_file in files[files.index(restored_path) + 1 :] if restored_path else ():
        try:
            damaged_file.rename(damaged_file.with_name(re.sub("^(step|refit)", "damaged", damaged_file.name)))
        except OSError as error:
            LOG.warning("%s: cannot be renamed (%s); remove it", damaged_file, error.strerror)


def _remove(files: Iterable[Path]) -> None:
    """Remove files of older states.  On Windows, a file that another program is reading remains until the next call."""
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            _warn_once(f"{file}: cannot be removed ({error.strerror}); a later save tries again")


@cache
def _warn_once(text: str) -> None:
    LOG.warning("%s", text)


def _write(run: Run, prefix: str) -> Path:
    run.status.require_lock()
    run.records.write()  # the state counts them
    state = State(
        format=FORMAT,
        version=full_version(),
        step=run.step,
        stage_index=run.stage_index,
        stage_step=run.stage_step,
        during_index=run.during_index,
        edited=run.edited,
        field=_field_entry(run),
        degree=0 if run.learned_field else run.model.degree,
        zero_fresh=[] if run.learned_field else run.model.gaussians.zero_fresh,
        updates=update_counts(run),
        scalars=run.scalars,
        modules={name: module.scalars for name, module in run.modules.items()},
        best=run.best,
        train_seconds=run.train_seconds,
        cpu_seconds=run.cpu_seconds,
        metrics=run.metrics,
        records=run.records.line_count if run.stage_step else run.records.line_count_at_stage,
        model_hashes=run.model_hashes,
        changes=run.changes,
        device=run.device.label,
        inputs=run.inputs,
        file_hashes=run.file_hashes,
        pipeline=run.pipeline,
    )
    path = run.out / CHECKPOINTS / f"{prefix}_{run.step:06d}.npz"
    with open_atomic(path) as file:
        archive.write(file, state.model_dump(), run_tables(run))
    return path


def _field_entry(run: Run) -> dict[str, Any] | None:
    field = run.learned_field
    return {"kind": field.kind, "shape": field.shape_as_data(), "parameters": field.parameter_count} if field else None


def _record_changes(run: Run, path: Path, state: State) -> list[str]:
    """Record and return the changed settings.  Raises ConfigError if one of them must not change on resume."""
    changes, remedy = [], "restore the setting, or start over with `clsplat run --restart` or another --out"
    previous = state.pipeline
    if run.inputs and state.inputs == run.inputs:  # the same scene, possibly moved
        previous = {**previous, "scene": {**previous["scene"], "path": run.pipeline["scene"]["path"]}}
    for difference in differences(previous, run.pipeline, run.settings):
        if difference.kind == "output" or difference.is_moved_file(state.file_hashes, run.file_hashes):
            continue
        if difference.key_path == "model.near" and state.inputs != run.inputs:
            continue  # follows from the scene, whose change is a separate error
        if difference.kind is None:
            raise ConfigError(f"{path} was saved with other settings: {difference}; {remedy}")
        if difference.stage is not None and difference.stage < state.stage_index:
            raise ConfigError(
                f"{path} was saved at step {state.step}, after the stage that has changed: {difference}; {remedy}"
            )
        if state.best and state.best.refit == "begun" and difference.key_path.endswith((".steps", ".patience")):
            raise ConfigError(
                f"{path} is from a refit, whose steps were chosen by validation and are fixed: {difference}; {remedy}"
            )
        is_end = difference.key_path.endswith(".steps")  # an earlier end of the training
        if difference.stage == state.stage_index and state.is_trained(run.pipeline) and not is_end:
            advice = f"to train longer, run `clsplat resume {shell_quote(run.out)} --steps {2 * state.stage_step}`"
            raise ConfigError(f"{path}: no steps are left for the new setting: {difference}; {advice}")
        changes.append(f"step {state.step}: {difference}")
    run.changes = [*state.changes, *changes]
    return changes


def _restore(run: Run, state: State, tables: Arrays) -> None:
    run.step, run.stage_index, run.stage_step = state.step, state.stage_index, state.stage_step
    run.during_index, run.edited, run.is_consistent, run.scalars = state.during_index, state.edited, True, state.scalars
    run.best = state.best
    if run.is_refit:
        run.use_split(run.original.merge_validation())
    restore_tables(run, state, tables)
    run.train_seconds, run.cpu_seconds, run.metrics = state.train_seconds, state.cpu_seconds, state.metrics
    run.records.line_count, run.resumed_inputs, run.model_hashes = state.records, state.inputs, state.model_hashes


# Save the state of a run that fails.


@contextmanager
def save_on_failure(run: Run) -> Iterator[None]:
    """If the block fails, save the last complete step, log its path, and raise the error again."""
    try:
        yield
    except (Interrupted, NotFiniteError):  # already saved
        raise
    except (Exception, SystemExit, GeneratorExit):  # plug-ins may raise any; a second Ctrl-C stops at once
        if run.step > 0 and not run.status.lock_error:
            LOG.warning(_save_if_consistent(run))
        raise


def finite_values(run: Run, view: str, losses: ViewLosses) -> tuple[float, float]:
    """Return the loss and the PSNR (dB) of a step; waits for the device.

    Raises NotFiniteError, after saving the state as failed_N.npz, if the loss or the model is not finite.
    """
    bad_tables, loss = run.find_nonfinite(), losses.loss
    if bad_tables or not math.isfinite(loss):
        raise NotFiniteError(f"step {run.step}, view '{view}': the loss is {loss}; {save_failed(run, bad_tables)}")
    return loss, psnr(losses.comparison)


def _save_if_consistent(run: Run) -> str:
    """Save the state if it is consistent and finite; return a clause that reports the result."""
    try:
        if run.is_consistent and not run.find_nonfinite() and run.gaussians != 0:
            return f"the state of step {run.step} is saved in {save(run)}; `clsplat resume` continues from it"
        reason = "the failed step was incomplete" if not run.is_consistent else "the model is not finite"
    except Exception as error:  # must not hide the original failure
        reason = f"the state could not be saved ({one_line(error)})"
    files = list_files(run.out)
    return f"{reason}; {f'the last good state is {files[-1]}' if files else 'no earlier state was saved'}"
