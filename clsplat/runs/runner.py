"""Run the stages of a pipeline in order, from the newest checkpoint or from the start."""

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
from clsplat.prepare.inspect.findings import check_view_count
from clsplat.runs.outputs import check_outputs, previous_sums, save_checksums, write_checksums, write_metrics
from clsplat.runs.run_folder import RESOLVED, Start, clear
from clsplat.runs.state import find_damaged_files
from clsplat.scene.identity import Identity
from clsplat.stages.densify import Densify
from clsplat.stages.optimize import Optimize
from clsplat.stages.report import overfitting_note
from clsplat.training import checkpoint
from clsplat.training.best_model import Best
from clsplat.training.checkpoint import save_on_failure
from clsplat.training.run import Run
from clsplat.training.stage import Training

# The refit: a second training on all photos, for the number of steps that validation found best.

LOG = logging.getLogger("clsplat")
WITHOUT_VALIDATION = {"keep": "last", "patience": None, "refit": False}


def is_refit_due(run: Run) -> bool:
    """Return whether validation has chosen the number of steps and the refit has not started yet."""
    return run.best is not None and run.best.refit == "due"


def start_refit_if_due(run: Run) -> None:
    """Reset the run to its first stage if a refit is due."""
    if run.best is None or run.best.refit != "due":
        return
    LOG.info(
        "refit: training on all %d photos for %d steps",
        len(run.original.train) + len(run.original.validation),
        run.best.measured.step,
    )
    run.records.move_to_trial()
    run.restart_for_refit(run.best.model_copy(update={"refit": "begun"}))


def with_refit_steps(pipeline: Pipeline, run: Run) -> Pipeline:
    """Return the pipeline to train: in a refit, with the number of steps that validation chose, else unchanged.

    A refit is bit-identical to a run of the returned pipeline without validation views.
    """
    if not run.is_refit or run.best is None:
        return pipeline
    best = run.best

    def with_steps(stage: Optimize) -> Optimize:
        if stage.keep != "best":
            return stage
        during = [_with_growth_end(inner, best) if isinstance(inner, Densify) else inner for inner in stage.during]
        return stage.model_copy(update={"steps": best.measured.step, "during": during, **WITHOUT_VALIDATION})

    return replace(pipeline, settings=map_trainings(pipeline.settings, Optimize, with_steps))


def _with_growth_end(stage: Densify, best: Best) -> Densify:
    """Return a stage whose growth ends at the same step as in the first training."""
    end_steps = [step for step in (stage.grow_until, best.growth_ended if stage.patience else None) if step is not None]
    return stage.model_copy(update={"patience": None, "grow_until": min(end_steps, default=None)})


# inputs.json: the identity of a run's inputs, which is compared when the run resumes.


def write_inputs(run: Run) -> None:
    """Write the identity of the run's scene into its folder.  Raises OutputError."""
    if run.identity:
        write_text(run.out / INPUTS, json.dumps(run.identity.data()) + "\n")


def require_same_inputs(scene: Path, identity: Identity | None, out: Path, digest: str = "") -> None:
    """Raise ConfigError, which lists the changes, if a run was started with other photos, cameras, or points.

    digest: digest of the earlier inputs from a checkpoint; "": use the one in inputs.json.
    """
    previous = _read_identity(out / INPUTS)
    digest = digest or (previous.digest if previous else "")
    if not digest:
        LOG.warning("%s: missing or damaged; cannot check that the photos are the same", out / INPUTS)
    elif identity and identity.digest != digest:
        changes = ", ".join(identity.changes(previous)) if previous else ""
        changes = changes or f"{INPUTS} is missing or damaged, so the changes are unknown"
        raise ConfigError(
            f"{scene}: differs from the inputs of the run: {shorten(changes, 500)}; restore them, or start over: "
            "`clsplat run` with --restart or another --out"
        )


def _read_identity(path: Path) -> Identity | None:
    try:
        return Identity.from_data(read_json(path))
    except (DataError, ValueError):
        return None


# Ctrl-C, SIGTERM, and SIGHUP.


@contextmanager
def finishing_on_interrupt(run: Run) -> Iterator[None]:
    """At the first signal, finish the current step, or the current view of a longer stage, and save the state.

    The second signal stops the run immediately, as does the first if there is no model to save.
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
    """Run the stages, from the newest checkpoint if the run is resumed, and write the files of the run folder.

    show: receives the progress reports.  The caller has to record failures.
    """
    run.on_progress = show
    previous = begin(pipeline, run, start)
    with finishing_on_interrupt(run), save_on_failure(run):
        run_stages(pipeline, run)
    for finding in check_view_count(len(run.original.train)):
        LOG.warning("%s", finding.text)
    if run.best is None and (note := overfitting_note(run)):
        LOG.info("%s", note)
    run.status.require_lock()
    write_metrics(pipeline, run)
    damaged_names = find_damaged_files(run.out, previous)
    check_outputs(pipeline, run, damaged_names)
    write_checksums(pipeline, run, previous)
    for name in damaged_names:
        LOG.warning("%s: is missing or has changed; only --restart writes it again", run.out / name)
    run.status.end("done", exit_code=0)


def begin(pipeline: Pipeline, run: Run, start: Start) -> dict[str, str]:
    """Restore the newest checkpoint, or clear the folder, and write the first files of the run.

    Returns the checksums of files of the finished run that no remaining stage rewrites.
    """
    restored = restore(pipeline, run) if start == "resume" else None
    check_run(pipeline, run)
    if start == "restart":
        clear(run.status)
    if start == "resume":
        LOG.info("resumed at step %d" if restored else "nothing to resume; starting from the beginning%.0s", run.step)
    previous = previous_sums(pipeline, run) if restored else {}
    run.status.enter("running", step=run.step)  # before this line, an error leaves the folder unchanged
    save_checksums(run, previous)
    checkpoint.rename_damaged(run.out, restored)
    write_pipeline(pipeline, run)
    write_inputs(run)
    if run.prepared:
        write_text(run.out / PREPARE_SUMMARY, json.dumps(run.prepared) + "\n")
    run.records.start(run.is_refit)
    return previous


def check_run(pipeline: Pipeline, run: Run) -> None:
    """Check that all remaining stages can run, without writing files.  Raises the errors of the stages."""
    for stage in pipeline.stages[run.stage_index :]:
        stage.check_run(run)


def write_pipeline(pipeline: Pipeline, run: Run) -> None:
    """Write pipeline.yaml with all settings, and a comment with the reason if some differ from the pipeline file."""
    reason = f"# {pipeline.reason}\n" if pipeline.reason else ""
    write_text(run.out / PIPELINE, f"{RESOLVED}{pipeline.path.name}\n{reason}{pipeline.text()}")


def restore(pipeline: Pipeline, run: Run) -> Path | None:
    """Restore the newest intact checkpoint, and return its path, or None if there is none.  Nothing is written.

    Raises ConfigError if the checkpoint has other settings, photos, cameras, or points, or is beyond the last step, and
    OutputError if all checkpoints are damaged.
    """
    path, warnings = checkpoint.restore(run)
    if path:
        require_same_inputs(run.scene.path, run.identity, run.out, run.resumed_inputs)
        stage = pipeline.stages[run.stage_index] if run.stage_index < len(pipeline.stages) else None
        if isinstance(stage, Training) and stage.steps < run.stage_step:
            raise ConfigError(
                f"{path}: already at step {run.step}; {stage.stage}.steps={stage.steps} would end before it; use "
                f"{run.stage_step} or more, or start over: `clsplat run` with --restart or another --out"
            )
    for warning in warnings:
        LOG.warning("%s", warning)
    return path


def run_stages(pipeline: Pipeline, run: Run) -> None:
    """Run the stages from the current one to the last, and all of them again if a refit is due.

    The index of the current stage advances only at stages that train or edit the model.  The stages between two of
    these use the same model, so a resumed run repeats all of them.
    """
    start_refit_if_due(run)
    for index, stage in enumerate(with_refit_steps(pipeline, run).stages):
        if index < run.stage_index:
            continue
        changes_model = stage.edits or isinstance(stage, Training)
        if changes_model and index > run.stage_index:
            run.next_stage(index)
        with suppress(Stopped):
            stage.act(run)
            if changes_model:
                run.next_stage(index + 1)  # a resumed run must not repeat an edit
        if run.interrupted:
            path = checkpoint.save(run)
            raise Interrupted(
                f"stopped in {stage.stage}, saved in {path}; `clsplat resume {shell_quote(run.out)}` continues from it"
            )
        if is_refit_due(run):
            run_stages(pipeline, run)
            return
