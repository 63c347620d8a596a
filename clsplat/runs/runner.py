"""Run the stages of a pipeline in order, from the newest checkpoint or from the beginning."""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from clsplat.core.errors import ConfigError, DataError, Interrupted, shell_quote, shorten
from clsplat.core.files import INPUTS, PIPELINE, PREPARE_SUMMARY, write_text
from clsplat.core.progress import Progress, Stopped
from clsplat.core.reading import read_json
from clsplat.core.signals import stop_at_once, stopping_on_signals
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.stretching import map_trainings
from clsplat.prepare.inspect.findings import few_views
from clsplat.runs.outputs import check_outputs, keep_checksums, sums_before, write_checksums, write_metrics
from clsplat.runs.run_folder import RESOLVED, Start, clear
from clsplat.runs.state import not_whole
from clsplat.scene.identity import Identity
from clsplat.stages.densify import Densify
from clsplat.stages.optimize import Optimize
from clsplat.stages.report import overfitting_note
from clsplat.training import checkpoint
from clsplat.training.best_model import Best
from clsplat.training.checkpoint import saved_on_failure
from clsplat.training.run import Run
from clsplat.training.stage import Training

# Training again on all photographs, for the number of steps that validation has found best.

LOG = logging.getLogger("clsplat")
WITHOUT = {"keep": "last", "patience": None, "refit": False}


def is_due(run: Run) -> bool:
    """Whether validation has found the number of steps, and they are not begun."""
    return run.best is not None and run.best.refit == "due"


def begin_if_due(run: Run) -> None:
    """Come to the beginning of the pipeline where a refit is due."""
    if run.best is None or run.best.refit != "due":
        return
    LOG.info(
        "refit: all %d training photographs, for %d steps",
        len(run.original.train) + len(run.original.validation),
        run.best.measured.step,
    )
    run.records.set_aside()
    run.restart_for_refit(run.best.model_copy(update={"refit": "begun"}))


def as_trained(pipeline: Pipeline, run: Run) -> Pipeline:
    """Return the pipeline; in a refit with as many steps as validation has found best, and with its last model kept.

    The bits of a refit are those of a run of this pipeline without validation views.
    """
    if not run.is_refit or run.best is None:
        return pipeline
    best = run.best

    def refitted(stage: Optimize) -> Optimize:
        if stage.keep != "best":
            return stage
        during = [_as_grown(inner, best) if isinstance(inner, Densify) else inner for inner in stage.during]
        return stage.model_copy(update={"steps": best.measured.step, "during": during, **WITHOUT})

    return replace(pipeline, settings=map_trainings(pipeline.settings, Optimize, refitted))


def _as_grown(stage: Densify, best: Best) -> Densify:
    """The same, with the step from which on nothing grew in the place of its patience."""
    ended = [step for step in (stage.grow_until, best.growth_ended if stage.patience else None) if step is not None]
    return stage.model_copy(update={"patience": None, "grow_until": min(ended, default=None)})


# The record of what a run was started with, inputs.json, and its comparison when the run goes on.


def write_inputs(run: Run) -> None:
    """Write the identity of the run's scene into its folder.  Raises OutputError."""
    if run.identity:
        write_text(run.out / INPUTS, json.dumps(run.identity.data()) + "\n")


def require_same_inputs(scene: Path, identity: Identity | None, out: Path, digest: str = "") -> None:
    """Raise ConfigError, saying what changed, when a run was started with other photographs, cameras or points.

    digest: of those, where a checkpoint has it.
    """
    before = _read(out / INPUTS)
    digest = digest or (before.digest if before else "")
    if not digest:
        LOG.warning("%s: missing or damaged; photographs that have changed go unnoticed", out / INPUTS)
    elif identity and identity.digest != digest:
        changes = ", ".join(identity.changes(before)) if before else ""
        changes = changes or f"{INPUTS} is missing or damaged, so what changed is not known"
        raise ConfigError(
            f"{scene}: not what the run was started with: {shorten(changes, 500)}; put that back, or begin anew: "
            "`clsplat run` with --restart or another --out"
        )


def _read(path: Path) -> Identity | None:
    try:
        return Identity.from_data(read_json(path))
    except (DataError, ValueError):
        return None


# What a run does on Ctrl-C, SIGTERM and SIGHUP.


@contextmanager
def finishing_on_interrupt(run: Run) -> Iterator[None]:
    """Finish the step, or the view of a longer stage, and save the state at the first signal.

    The second signal stops at once, and so does the first where there is no model to save.
    """

    def finish() -> None:
        if run.interrupted or not run.has_model:
            stop_at_once()
            return
        run.interrupted = True
        LOG.info("finishing the step; press Ctrl-C again to stop at once")

    with stopping_on_signals(finish):
        yield


def execute(pipeline: Pipeline, run: Run, start: Start, show: Callable[[Progress], None]) -> None:
    """Run the stages, from the newest checkpoint where the run is resumed, and write the files of the run folder.

    The caller records a failure.
    """
    run.on_progress = show
    before = begin(pipeline, run, start)
    with finishing_on_interrupt(run), saved_on_failure(run):
        run_stages(pipeline, run)
    for finding in few_views(len(run.original.train)):
        LOG.warning("%s", finding.text)
    if run.best is None and (text := overfitting_note(run)):
        LOG.info("%s", text)
    run.status.require_held()
    write_metrics(pipeline, run)
    lost = not_whole(run.out, before)
    check_outputs(pipeline, run, lost)
    write_checksums(pipeline, run, before)
    for name in lost:
        LOG.warning("%s: is missing or was changed, and only --restart writes it again", run.out / name)
    run.status.end("done", exit_code=0)


def begin(pipeline: Pipeline, run: Run, start: Start) -> dict[str, str]:
    """Take the newest checkpoint, or clear the folder, and write what a run folder holds from the beginning on.

    Return the checksums of files that an earlier end of the run has written, and that its coming stages do not.
    """
    taken = restore(pipeline, run) if start == "resume" else None
    check_run(pipeline, run)
    if start == "restart":
        clear(run.status)
    if start == "resume":
        LOG.info("resumed at step %d" if taken else "nothing to resume; starting from the beginning%.0s", run.step)
    before = sums_before(pipeline, run) if taken else {}
    run.status.enter("running", step=run.step)  # a refusal leaves all as it was; from here on files change
    keep_checksums(run, before)
    checkpoint.drop_later(run.out, taken)
    write_pipeline(pipeline, run)
    write_inputs(run)
    if run.prepared:
        write_text(run.out / PREPARE_SUMMARY, json.dumps(run.prepared) + "\n")
    run.records.start(run.is_refit)
    return before


def check_run(pipeline: Pipeline, run: Run) -> None:
    """Raise what stages that are still to run can know of the run before any of them; nothing is written."""
    for stage in pipeline.stages[run.stage_index :]:
        stage.check_run(run)


def write_pipeline(pipeline: Pipeline, run: Run) -> None:
    """Write every setting of the run, with the reason where some are not those of the file."""
    reason = f"# {pipeline.reason}\n" if pipeline.reason else ""
    write_text(run.out / PIPELINE, f"{RESOLVED}{pipeline.path.name}\n{reason}{pipeline.text()}")


def restore(pipeline: Pipeline, run: Run) -> Path | None:
    """Take the newest checkpoint that is whole; return it, or None where none was saved so far.  Nothing is written.

    Raises ConfigError when it is of another run: with other settings, photographs, cameras or points, or of one that
    has trained for longer already; OutputError when no checkpoint is whole.
    """
    taken, remarks = checkpoint.restore(run)
    if taken:
        require_same_inputs(run.scene.path, run.identity, run.out, run.inputs_before)
        stage = pipeline.stages[run.stage_index] if run.stage_index < len(pipeline.stages) else None
        if isinstance(stage, Training) and stage.steps < run.stage_step:
            raise ConfigError(
                f"{taken}: already at step {run.step}; {stage.stage}.steps={stage.steps} would end before it: give "
                f"{run.stage_step} or more, or begin anew: `clsplat run` with --restart or another --out"
            )
    for remark in remarks:
        LOG.warning("%s", remark)
    return taken


def run_stages(pipeline: Pipeline, run: Run) -> None:
    """Run the stages from where the run stands on, and again from the beginning for a refit.

    Behind a training or an edit the run stands there until the next one begins: the stages between them see the same
    model, and a run that goes on has them all again.
    """
    begin_if_due(run)
    for cursor, stage in enumerate(as_trained(pipeline, run).stages):
        if cursor < run.stage_index:
            continue
        changes = stage.edits or isinstance(stage, Training)
        if changes and cursor > run.stage_index:
            run.next_stage(cursor)
        with suppress(Stopped):
            stage.act(run)
            if changes:
                run.next_stage(cursor + 1)  # a resumed run must not repeat an edit
        if run.interrupted:
            path = checkpoint.save(run)
            raise Interrupted(
                f"stopped in {stage.stage}, saved in {path}; `clsplat resume {shell_quote(run.out)}` continues from it"
            )
        if is_due(run):
            run_stages(pipeline, run)
            return
