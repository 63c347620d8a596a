"""Choices that follow from the photographs, made before the first step and written into the run's pipeline."""

import logging
from collections.abc import Callable
from dataclasses import replace

from clsplat.pipeline.choosing import choose
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.on_host import harmonics_of
from clsplat.pipeline.stretching import of_trainings
from clsplat.render.backdrops import Auto as AutoSky
from clsplat.scene.capture import measured, nearest_points
from clsplat.stages.optimize import Optimize
from clsplat.training.backgrounds import is_drawn
from clsplat.training.colours import settled
from clsplat.training.run import Run
from clsplat.training.skies import settled as settled_sky
from clsplat.training.skies import share_with_sky
from clsplat.views.colours import Auto

WITH_POSES = "optimize.poses are learned, which a sky does not go with"
WITH_DRAWN = "optimize.background is drawn, which a sky does not go with"
LOG = logging.getLogger("clsplat")


def settle(pipeline: Pipeline, run: Run, tell: Callable[[str], None] = LOG.info) -> Pipeline:
    """Return the pipeline with what its `choices` and its keys `auto` choose by the photographs of a run, which takes
    it; log reasons, those of `choices` by `tell`.

    Choices that are made already stay.
    """
    with run.status.stage("choose"):
        settled_pipeline = _taken(_with_colours(_by_capture(pipeline, run, tell), run), run)
        if any(isinstance(stage, Optimize) for stage in pipeline.stages):
            _warn_of_near(settled_pipeline.settings.model.near, nearest_points(run.scene))
        return settled_pipeline


def _warn_of_near(near: float, nearest: float | None) -> None:
    """Warn where points begin before the near plane; both in scene units."""
    if nearest is not None and nearest < near:
        LOG.warning(
            "nothing is drawn nearer than model.near=%g scene units, and the points of the training photographs "
            "begin at %.3g: set model.near to %.2g",
            *(near, nearest, nearest / 2),
        )


def _by_capture(pipeline: Pipeline, run: Run, tell: Callable[[str], None]) -> Pipeline:
    """The pipeline with what its `choices` choose."""
    still_open = [one for one in pipeline.settings.choices if not one.reason]
    if not still_open:
        return pipeline
    measures = measured(run.scene)
    if any(one.depends("sky", measures) for one in still_open) and (share := share_with_sky(run)) is not None:
        measures["sky"] = share
    chosen = replace(pipeline, settings=choose(pipeline.settings, measures))
    if chosen.settings.scene.validation != pipeline.settings.scene.validation:
        run.divide(chosen.settings.scene.split.with_validation(run.original.with_fold()))
        run.identity = run.identity and run.identity.divided(run.original)  # as of a run that begins with that split
    for one in chosen.settings.choices:
        tell(one.told)
    return chosen


def _taken(pipeline: Pipeline, run: Run) -> Pipeline:
    """The same; the run has its settings."""
    run.settings, run.pipeline, run.model_settings = pipeline.settings, pipeline.resolved(), pipeline.settings.model
    run.harmonics = harmonics_of(pipeline.settings)
    return pipeline


def _with_colours(pipeline: Pipeline, run: Run) -> Pipeline:
    """The pipeline with what its keys `auto` choose."""
    open_ones = [one.colours for one in pipeline.stages if isinstance(one, Optimize) and isinstance(one.colours, Auto)]
    background = pipeline.settings.model.background
    if all(colours.chosen for colours in open_ones) and (getattr(background, "chosen", "") is not None):
        return pipeline

    def chosen(training: Optimize) -> Optimize:
        if not isinstance(training.colours, Auto):
            return training
        colours = settled(training.colours, run)
        LOG.info("optimize.colours: %s, since %s", colours.chosen, colours.reason)
        return training.model_copy(update={"colours": colours})

    return replace(pipeline, settings=_with_sky(of_trainings(pipeline.settings, Optimize, chosen), run))


def _with_sky(settings: PipelineFile, run: Run) -> PipelineFile:
    """Settings with the choice of a sky, where it is open: none beside what it does not go with."""
    background = settings.model.background
    if isinstance(background, AutoSky) and background.chosen is None and (reason := _against_a_sky(settings, run)):
        background = background.model_copy(update={"chosen": "off", "reason": reason})
        LOG.info("model.background: off, since %s", reason)
    background = settled_sky(background, run)
    if background is settings.model.background:
        return settings
    return settings.model_copy(update={"model": settings.model.model_copy(update={"background": background})})


def _against_a_sky(settings: PipelineFile, run: Run) -> str:
    """What a sky does not go with, of what the trainings do; "" where there is nothing."""
    trainings = [stage for stage in settings.stages if isinstance(stage, Optimize)]
    if any(one.poses for one in trainings):
        return WITH_POSES
    return WITH_DRAWN if any(is_drawn(one.background, run.scene) for one in trainings) else ""
