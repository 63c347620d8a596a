"""Save and restore a run, bit for bit: parameters, Adam's moments, statistics and counters, without pickle.

Random numbers and the order of views depend on (seed, step) alone, so the step is their state.  A state that is not
finite is no checkpoint: it lies beside them as failed_N.npz, and a run goes on from the last good one.
"""

import logging
import re
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clsplat.errors import ClsplatError, ConfigError, DataError, NotFiniteError, OutputError, in_shell
from clsplat.files import atomic
from clsplat.names import CHECKPOINTS, PIPELINE
from clsplat.training import archive, run_tables
from clsplat.training.advice import lower_rate
from clsplat.training.archive import Arrays
from clsplat.training.changes import differences
from clsplat.training.run import Run
from clsplat.training.state import State
from clsplat.version import full_version

FORMAT = 4
LOG = logging.getLogger("clsplat")


def save(run: Run, keep: int | None = None) -> Path:
    """Write checkpoints/step_N.npz, whole or not at all; with `keep` remove all but so many of the newest, up to it.

    Raises NotFiniteError, after writing failed_N.npz, where the model is not finite; then nothing is removed.  Raises
    ClsplatError where a step or an edit is half done.
    """
    if not run.whole:
        raise ClsplatError(f"{run.out}: step {run.step} is half done, so it is not saved; resume the run to go on")
    if broken := run.not_finite():
        raise NotFiniteError(f"step {run.step}: {set_aside(run, broken)}")
    path = _write(run, "refit" if run.is_refit else "step")
    run.status.saved_at = time.monotonic()
    run.status.note(checkpoint=path.name)
    run.status.refresh()
    if keep is not None:
        files = saved(run.out)
        _remove(files[: files.index(path) + 1][:-keep])  # a later one is damaged, and could not be renamed
    return path


def set_aside(run: Run, broken: list[str]) -> str:
    """Write a state that is not finite as failed_N.npz, the only one of its kind; return what to tell and to do."""
    try:
        path = _write(run, "failed")
        _remove(other for other in path.parent.glob("failed_*.npz") if other != path)
        state = f"the state is in {path}"
    except OutputError as error:
        state = f"the state is lost: {error}"
    good = saved(run.out)
    return (
        f"parameters not finite: {', '.join(broken) or 'none'}; {state}; "
        f"`clsplat resume {in_shell(run.out)} --set {lower_rate(run, broken)}` lowers a rate and "
        f"{f'goes on from {good[-1].name}' if good else 'starts again'}"
    )


def saved(out: Path) -> list[Path]:
    """Return the checkpoints of a run folder from old to new; those of a refit come after those before it."""
    places = {
        (found[1] == "refit", int(found[2])): path
        for path in (out / CHECKPOINTS).glob("*.npz")
        if (found := re.fullmatch(r"(step|refit)_(\d+)\.npz", path.name))
    }
    return [places[place] for place in sorted(places)]


def load(path: Path) -> tuple[State, Arrays]:
    """Read a checkpoint.  Raises DataError, with the reason alone, when damaged; ConfigError for another format."""
    notes, tables = archive.read(path)
    if type(notes.get("format")) is int and notes["format"] != FORMAT:
        raise ConfigError(
            f"{path}: has format {notes['format']}, expected {FORMAT}; resume it with the version that wrote it, "
            "or give another --out"
        )
    try:
        state = State.model_validate(notes)
    except ValidationError as error:
        first = error.errors()[0]
        raise DataError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    if state.cursor > len(state.pipeline.get("stages", ())):  # equal to it: all stages have ended
        raise DataError(f"it has no stage {state.cursor}")
    run_tables.check(state, tables)
    return state, tables


def restore(run: Run) -> tuple[Path | None, list[str]]:
    """Take the newest checkpoint that is whole; return its file, or None where the run has saved none so far.

    Also returns what to say where the run goes on: the settings and the device that have changed.

    Raises ConfigError when it was made with settings that a run cannot go on with, or has another format; OutputError
    when no checkpoint is whole, or all are gone.
    """
    paths = saved(run.out)
    again = (
        f"`clsplat run {in_shell(run.out / PIPELINE)} --out {in_shell(run.out)} --restart` starts from the beginning"
    )
    for path in reversed(paths):
        try:
            state, tables = load(path)
        except DataError as error:
            if path == paths[0]:
                raise OutputError(f"{path} is damaged ({error}), and no checkpoint is whole; {again}") from error
            LOG.warning("%s is damaged (%s); using the one before it", path, error)
            continue
        changed = _take_changes(run, path, state)
        remarks = [f"{text}; from here on the bits are not those of a run without a change" for text in changed]
        if state.device != run.device.text:
            remarks.append(f"the run was started on {state.device}: the bits may differ from here on")
        _restore(run, state, tables)
        return path, remarks
    if last := run.status.now.checkpoint:
        raise OutputError(f"{run.out / CHECKPOINTS}: is empty, but {last} was saved there; put it back, or {again}")
    return None, []


def drop_later(out: Path, taken: Path | None) -> None:
    """Rename the damaged checkpoints after the one that was taken: they take no place among those that are kept."""
    files = saved(out)
    for damaged in files[files.index(taken) + 1 :] if taken else ():
        try:
            damaged.rename(damaged.with_name(re.sub("^(step|refit)", "damaged", damaged.name)))
        except OSError as error:
            LOG.warning("%s: cannot be renamed (%s); remove it", damaged, error.strerror)


def _remove(files: Iterable[Path]) -> None:
    """Remove older states; one that cannot go, as where Windows lets another program read it, stays until the next."""
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            _tell_once(f"{file}: cannot be removed ({error.strerror}); it stays")


@cache
def _tell_once(text: str) -> None:
    LOG.warning("%s", text)


def _write(run: Run, kind: str) -> Path:
    run.status.require_held()
    run.records.write()  # the state counts them
    state = State(
        format=FORMAT,
        version=full_version(),
        step=run.step,
        cursor=run.cursor,
        stage_step=run.stage_step,
        acted=run.acted,
        edited=run.edited,
        field=_field_of(run),
        degree=0 if run.learned_field else run.model.degree,
        zero_fresh=[] if run.learned_field else run.model.gaussians.zero_fresh,
        updates=run_tables.updates_of(run),
        numbers=run.numbers,
        best=run.best,
        train_seconds=run.train_seconds,
        cpu_seconds=run.cpu_seconds,
        metrics=run.metrics,
        records=run.records.lines,
        written=run.written,
        changes=run.changes,
        device=run.device.text,
        inputs=run.inputs,
        read=run.read,
        pipeline=run.pipeline,
    )
    path = run.out / CHECKPOINTS / f"{kind}_{run.step:06d}.npz"
    with atomic(path) as file:
        archive.write(file, state.model_dump(), run_tables.tables_of(run))
    return path


def _field_of(run: Run) -> dict[str, Any] | None:
    field = run.learned_field
    return {"kind": field.kind, "shape": field.shape_as_data(), "parameters": field.parameters} if field else None


def _take_changes(run: Run, path: Path, state: State) -> list[str]:
    """Note the settings that have changed, and return them.  Raises ConfigError where a run cannot go on."""
    changed, remedy = [], "give those settings, or begin anew: `clsplat run` with --restart or another --out"
    before = state.pipeline
    if run.inputs and state.inputs == run.inputs:  # the same scene, wherever it lies now
        before = {**before, "scene": {**before["scene"], "path": run.pipeline["scene"]["path"]}}
    for difference in differences(before, run.pipeline, run.settings):
        if difference.kind == "output" or difference.is_of_place(state.read, run.read):
            continue
        if difference.kind is None:
            raise ConfigError(f"{path} was made with other settings: {difference}; {remedy}")
        if difference.stage is not None and difference.stage < state.cursor:
            raise ConfigError(f"{path} was saved after that stage, at step {state.step}: {difference}; {remedy}")
        if state.best and state.best.refit == "begun" and difference.place.endswith((".steps", ".patience")):
            raise ConfigError(f"{path} is of a refit, whose steps validation has found: {difference}; {remedy}")
        is_end = difference.place.endswith(".steps")  # an end before the one that was planned
        if difference.stage == state.cursor and state.is_trained(run.pipeline) and not is_end:
            more = f"`clsplat resume {in_shell(run.out)} --steps {2 * state.stage_step}` with that setting trains on"
            raise ConfigError(f"{path}: no step is left to train, at step {state.step}: {difference}; {more}")
        changed.append(f"step {state.step}: {difference}")
    run.changes = [*state.changes, *changed]
    return changed


def _restore(run: Run, state: State, tables: Arrays) -> None:
    run.step, run.cursor, run.stage_step = state.step, state.cursor, state.stage_step
    run.acted, run.edited, run.whole, run.numbers = state.acted, state.edited, True, state.numbers
    run.best = state.best
    run_tables.restore(run, state, tables)
    if run.is_refit:
        run.divide(run.original.with_fold())
    run.train_seconds, run.cpu_seconds, run.metrics = state.train_seconds, state.cpu_seconds, state.metrics
    run.records.lines, run.inputs_before, run.written = state.records, state.inputs, state.written
