"""Run the training of a pipeline step by step."""

from collections.abc import Iterator
from itertools import takewhile

from clsplat.losses.base import ViewGradients
from clsplat.pipeline.loading import Pipeline
from clsplat.runs.runner import is_refit_due, start_refit_if_due, with_refit_steps
from clsplat.stages.optimize import Optimize
from clsplat.training.run import Run


def run_until_training(pipeline: Pipeline, run: Run) -> None:
    """Run the stages before the first training, starting at the run's stage."""
    for index, stage in enumerate(pipeline.stages):
        if isinstance(stage, Optimize):
            return
        if index >= run.stage_index:
            run.stage_index = index
            stage.act(run)


def train(pipeline: Pipeline, run: Run) -> Iterator[ViewGradients]:
    """Run the stages from the first to the last training, and the edits after it; yield the gradients of each step.

    A refit starts with the first stage again.
    """
    full_pipeline, starts_refit = pipeline, is_refit_due(run)
    start_refit_if_due(run)
    pipeline = with_refit_steps(full_pipeline, run)
    if starts_refit:
        run_until_training(pipeline, run)
    first_index, last_index = _training_stage_indices(pipeline)
    for index in range(max(first_index, run.stage_index), last_index + 1):
        if index > run.stage_index:
            run.next_stage(index)
        stage = pipeline.stages[index]
        if isinstance(stage, Optimize):
            run.status.note(stage=stage.stage, progress=None)
            for gradients in stage.iterate(run):
                if index == last_index and stage.has_ended(run) and not is_refit_due(run):
                    _run_final_edits(pipeline, run)
                    yield gradients
                    return
                yield gradients
            if is_refit_due(run):
                yield from train(full_pipeline, run)
                return
        else:
            stage.act(run)


def _run_final_edits(pipeline: Pipeline, run: Run) -> None:
    """Run the stages that edit the model directly after the training, as part of its last step."""
    for stage in takewhile(lambda stage: stage.edits, pipeline.stages[run.stage_index + 1 :]):
        run.next_stage(run.stage_index + 1)
        stage.act(run)


def is_trained(pipeline: Pipeline, run: Run) -> bool:
    """Return whether all training steps have run, including the steps of a refit."""
    _, last_index = _training_stage_indices(pipeline)
    stage = with_refit_steps(pipeline, run).stages[last_index]
    is_at_end = isinstance(stage, Optimize) and run.stage_index == last_index and stage.has_ended(run)
    return (run.stage_index > last_index or is_at_end) and not is_refit_due(run)


def _training_stage_indices(pipeline: Pipeline) -> tuple[int, int]:
    """Return the indices of the first and the last training stage."""
    indices = [i for i, stage in enumerate(pipeline.stages) if isinstance(stage, Optimize)]
    return indices[0], indices[-1]
