"""Run the stages of a pipeline in order, from the newest checkpoint or from the beginning."""

import json
import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from clsplat.errors import ConfigError, DataError, Interrupted, in_shell
from clsplat.files import write_text
from clsplat.inspect.findings import few_views
from clsplat.names import CHECKSUMS, NOTE, PIPELINE
from clsplat.pipeline.loading import Pipeline
from clsplat.progress import Progress, Stopped
from clsplat.report.parting import parting
from clsplat.runs.course import Course, is_below
from clsplat.runs.folders import RESOLVED, Start, clear
from clsplat.runs.inputs import require_same_inputs, write_inputs
from clsplat.runs.outputs import Lost, check_outputs, keep_checksums, renew_checksums, write_checksums, write_metrics
from clsplat.runs.refitting import as_trained, begin_if_due, is_due
from clsplat.runs.signals import finishing_on_interrupt
from clsplat.stages.training import Training
from clsplat.training import checkpoint
from clsplat.training.rescue import saved_on_failure
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


def execute(pipeline: Pipeline, run: Run, start: Start, show: Callable[[Progress], None]) -> None:
    """Run the stages, from the newest checkpoint where the run is resumed, and write the files of the run folder.

    The caller records a failure.
    """
    run.show = show
    lost = begin(pipeline, run, start)
    with finishing_on_interrupt(run), saved_on_failure(run):
        _write_again(pipeline, run, lost)
        run_stages(pipeline, run)
    for finding in few_views(len(run.original.train)):
        LOG.warning("%s", finding.text)
    if run.best is None and (text := parting(run)):
        LOG.info("%s", text)
    run.status.require_held()
    write_metrics(pipeline, run)
    check_outputs(as_trained(pipeline, run), run, lost.gone)
    write_checksums(pipeline, run, lost.gone)
    run.status.end("done", exit_code=0)


def begin(pipeline: Pipeline, run: Run, start: Start) -> Lost:
    """Take the newest checkpoint, or clear the folder, and write what a run folder holds from the beginning on.

    Return which files of an earlier end are lost.
    """
    taken = restore(pipeline, run) if start == "resume" else None
    check_in(pipeline, run)
    if start == "restart":
        clear(run.status)
    if start == "resume":
        LOG.info("resumed at step %d" if taken else "nothing to resume; starting from the beginning%.0s", run.step)
    run.status.enter("running", step=run.step)  # a refusal leaves all as it was; from here on files change
    lost = keep_checksums(Course(pipeline, run.out, run), run)
    checkpoint.drop_later(run.out, taken)
    write_pipeline(pipeline, run)
    write_inputs(run)
    if run.prepared:
        write_text(run.out / NOTE, json.dumps(run.prepared) + "\n")
    run.records.start(run.is_refit)
    return lost


def check_in(pipeline: Pipeline, run: Run) -> None:
    """Raise what stages that are still to run can know of the run before any of them; nothing is written."""
    for stage in pipeline.stages[run.cursor :]:
        stage.check_in(run)


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
        require_same_inputs(run)
        stage = pipeline.stages[run.cursor] if run.cursor < len(pipeline.stages) else None
        if isinstance(stage, Training) and stage.steps < run.stage_step:
            raise ConfigError(
                f"{taken}: already at step {run.step}; {stage.stage}.steps={stage.steps} would end before it: give "
                f"{run.stage_step} or more, or begin anew: `clsplat run` with --restart or another --out"
            )
    for remark in remarks:
        LOG.warning("%s", remark)
    return taken


def _write_again(pipeline: Pipeline, run: Run, lost: Lost) -> None:
    """Repeat the stages whose files are lost or damaged, of those that ended since the model changed last.

    Files that are lost and that no stage writes again are named in a warning.
    """
    stages = Course(pipeline, run.out, run).repeatable
    if stages and lost.is_unlisted:
        LOG.warning("%s: is missing or damaged; what can be is written again, the rest is not verified", CHECKSUMS)
    for stage in reversed(stages):
        own = [file for file in lost.repeatable if is_below(file, stage.outputs(run.out))]
        try:
            stage.verify(run)
            if own:
                raise DataError(f"{own[0]}: is missing or was changed")
        except DataError as error:
            LOG.warning("%s; it is written again", error)
        else:
            if not (lost.is_unlisted and stage.outputs(run.out)):
                continue
        stage.act(run)
        renew_checksums(stage, run)
    for file in lost.gone:
        LOG.warning("%s: is missing or was changed since it was written, and cannot be made again", file)


def run_stages(pipeline: Pipeline, run: Run) -> None:
    """Run the stages from where the run stands on, and again from the beginning for a refit."""
    begin_if_due(run)
    for cursor, stage in enumerate(as_trained(pipeline, run).stages if run.is_refit else pipeline.stages):
        if cursor < run.cursor:
            continue
        with suppress(Stopped):
            stage.act(run)
            run.next_stage(cursor + 1)  # a resumed run must not repeat an edit
        if run.interrupted:
            path = checkpoint.save(run)
            raise Interrupted(
                f"stopped in {stage.stage}, saved in {path}; `clsplat resume {in_shell(run.out)}` goes on from it"
            )
        if is_due(run):
            run_stages(pipeline, run)
            return
