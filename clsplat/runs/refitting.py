"""Training again on all photographs, for the number of steps that validation has found best."""

import logging
from dataclasses import replace

from clsplat.pipeline.loading import Pipeline
from clsplat.stages.base import Stage
from clsplat.stages.densify import Densify
from clsplat.stages.optimize import Optimize
from clsplat.training.kept import Best
from clsplat.training.run import Run

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
        run.best.found.step,
    )
    run.records.set_aside()
    run.begin_again(run.best.model_copy(update={"refit": "begun"}))


def as_trained(pipeline: Pipeline, run: Run) -> Pipeline:
    """Return the pipeline with as many steps as validation leaves its training; in a refit that keeps its last model.

    The bits of a refit are those of a run of this pipeline without validation views.
    """
    stages, before = list[Stage](), 0
    for stage in pipeline.stages:
        now = _as_trained(stage, run, before) if isinstance(stage, Optimize) and stage.keep == "best" else stage
        before += stage.steps if isinstance(stage, Optimize) else 0
        stages.append(now)
    return replace(pipeline, settings=pipeline.settings.model_copy(update={"stages": stages}))


def _as_grown(stage: Densify, best: Best) -> Densify:
    """The same, with the step from which on nothing grew in the place of its patience."""
    ended = [step for step in (stage.grow_until, best.growth_ended if stage.patience else None) if step is not None]
    return stage.model_copy(update={"patience": None, "grow_until": min(ended, default=None)})


def _as_trained(stage: Optimize, run: Run, before: int) -> Optimize:
    if run.is_refit and run.best:
        during = [_as_grown(inner, run.best) if isinstance(inner, Densify) else inner for inner in stage.during]
        return stage.model_copy(update={"steps": run.best.found.step, "during": during, **WITHOUT})
    taken = run.best.taken if run.best else None
    ended = taken is not None and before < taken < before + stage.steps
    return stage.model_copy(update={"steps": taken - before}) if taken and ended else stage
