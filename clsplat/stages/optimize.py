"""The training loop: render, compare, differentiate, update."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from clsplat.density.statistics import SplatStats
from clsplat.losses.base import ImageLoss, Loss, Penalty, ViewGradients, ViewLosses, require_symmetric
from clsplat.names import VIEW_POSES
from clsplat.schedule import Probability
from clsplat.settings import OneOf
from clsplat.stages.base import Scheduled
from clsplat.stages.densify import Densify
from clsplat.stages.keeping import Keeping
from clsplat.stages.progress import report
from clsplat.training.adam import Adam, Rates, Rows
from clsplat.training.backgrounds import Behind, drawn_backgrounds, drawn_beside_a_sky, is_drawn
from clsplat.training.colours import photograph_colours, write_view_colours
from clsplat.training.depths import known_depths, require_depths
from clsplat.training.distractors import photograph_distractors
from clsplat.training.forecast import Forecast
from clsplat.training.placing import more_room, place_harmonics
from clsplat.training.poses import photograph_poses, poses_beside_a_sky, require_zoom, write_view_poses
from clsplat.training.profile import clocks
from clsplat.training.rescue import finite_values
from clsplat.training.run import Run
from clsplat.training.skies import will_learn_sky
from clsplat.training.skipping import Skip, Visit
from clsplat.training.trainer import Trainer
from clsplat.views.colours import Colours
from clsplat.views.distractors import Distractors
from clsplat.views.poses import Poses
from clsplat.views.sampling import Sampler, ViewSettings
from clsplat.views.transients import Transients

LOG = logging.getLogger("clsplat")
DISTRIBUTION_INTERVAL, READ_AHEAD = 5, 4  # reports; photographs


class Optimize(Keeping):
    """Train for a number of steps, one view each (Kerbl et al. 2023).

    Stages in `during` that edit the model act between two steps, so that other stages see the model before the edit.
    No edit follows the last step.  As in the reference, a parameter is not updated at the step before its edit.
    """

    stage: Literal["optimize"] = "optimize"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"adam", "stats"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"rates", "update", "skip", "dropout", "background"})

    rates: Rates = Rates()
    """Learning rates."""
    update: Rows = "all"
    """Gaussians that a step changes: `all`, or `seen`: those that the view culls keep their parameters and moments.
    `deferred`: all, with the same bits; `sh_rest` of those that are culled has its updates when a view sees them."""
    views: ViewSettings = ViewSettings()
    """View, size and photograph of each step."""
    losses: list[OneOf[Loss]]
    """Losses and penalties; training minimises their sum."""
    colours: OneOf[Colours] | None = None
    """Colours of each photograph, where exposures differ: `gain`, `affine`, `grid`, `auto`; without it, the scene's."""
    poses: Poses | None = None
    """Places of the cameras that are learned with the model, where poses are not exact; without it, the dataset's."""
    transients: Transients | None = None
    """Pixels that are left out, where photographs show what the scene does not have; without it, none."""
    distractors: Distractors | None = None
    """Gaussians that each photograph has for itself, for what the scene does not have; without it, none."""
    dropout: Probability = 0.0
    """Probability with which a step leaves a Gaussian out, by step, 0.9 at most; for few photographs.  The opacities of
    the others are divided by 1 less it (DropGaussian, Park et al. 2025).  Pictures and measurements leave none out."""
    background: Behind = "scene"
    """Colour behind all; random: another in each step; transparent: random where photographs are so."""
    skip: Skip | None = None
    """Steps that skip the backward pass, where a view has converged; without it, none."""
    during: list[OneOf[Scheduled]] = Field([])
    """Stages that run every so many steps."""
    log_every: Annotated[int, Field(gt=0)] = 100
    """Steps between lines of metrics.jsonl."""

    @field_validator("losses")
    @classmethod
    def _of_an_image(cls, losses: list[Loss]) -> list[Loss]:
        if not any(isinstance(loss, ImageLoss) and loss.reads_photograph for loss in losses):
            raise ValueError("expected at least one loss that compares images, such as l1")
        return losses

    def check(self) -> None:
        require_symmetric(self.losses, self.views.transforms)
        super().check()

    def outputs(self, out: Path) -> list[Path]:
        own = [*(self.colours.files if self.colours else ()), *([VIEW_POSES] if self.poses else [])]
        return [*super().outputs(out), *(out / name for name in own)]

    def run(self, run: Run) -> None:
        for _ in self.iterate(run):
            pass

    def check_in(self, run: Run) -> None:
        super().check_in(run)
        require_depths(self.losses, run.scene, poses=bool(self.poses))
        if self.poses and self.poses.focal:
            require_zoom(run.original)
        if will_learn_sky(run):
            self.check_beside_a_sky(drawn=is_drawn(self.background, run.scene))

    def check_beside_a_sky(self, drawn: bool) -> None:
        """Raise ConfigError for what does not go with a sky; drawn: whether steps draw what is behind everything."""
        if self.poses:
            raise poses_beside_a_sky()
        if drawn:
            raise drawn_beside_a_sky()

    def iterate(self, run: Run) -> Iterator[ViewLosses]:
        """Train step by step; what a step yields, ViewGradients unless it is skipped, is valid until the next."""
        self.begin_to_keep(run)
        views = self.views.settled(run.training_images)
        last_step = run.step - run.stage_step + self.steps
        trainer, sampler = self._trainer(run, views, last_step), Sampler(run.scene.split("train"), views, run.seed)
        memory, count = run.memory_plan(), run.model.gaussians.count
        if run.harmonics != "auto" or memory.host == 0:  # else it was looked at before they moved
            memory.check(count, more_room(run))
        LOG.info(memory.text(count))
        forecast = Forecast.of(run.step, last_step, [stage.due for stage in self._density])
        seconds: list[float] = []  # of the steps since the last report
        self.act_between(run)
        while not self.has_ended(run):
            start = clocks()
            self._edit(run, views)
            view = self._step(run, trainer, sampler)
            run.status.count("steps", run.stage_step, self.steps, step=run.step, steps=last_step)
            is_reported = run.step % self.log_every == 0 or run.stage_step == self.steps or run.interrupted
            loss, psnr = finite_values(run, sampler.at(run.step).view.name, view) if is_reported else (0.0, 0.0)
            seconds.append(run.add_training_time(start))
            if is_reported:
                if self.skip and run.step == last_step:
                    self.skip.tell(run)
                report(run, forecast, (loss, psnr), seconds, DISTRIBUTION_INTERVAL * self.log_every)
                seconds.clear()
            self.end_step(run)
            yield view
        self.leave(run)  # a resumed run may have no step left
        write_view_colours(run, trainer.colours)
        write_view_poses(run, trainer.poses)

    @property
    def statistics(self) -> set[str]:
        """Columns of statistics that density rules read."""
        return {name for stage in self._density for name in stage.statistics}

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that penalties and rules read beside the parameters."""
        parts: list[Penalty | Densify] = [*(loss for loss in self.losses if isinstance(loss, Penalty)), *self._density]
        return {name for part in parts for name in part.tables}

    @property
    def _density(self) -> list[Densify]:
        return [stage for stage in self.during if isinstance(stage, Densify)]

    def _trainer(self, run: Run, views: ViewSettings, last: int) -> Trainer:
        """Attach moments, statistics and tables to the run's Gaussians; a resumed run has them."""
        gaussians, photographs = run.model.gaussians, run.photographs
        run.stats = SplatStats(gaussians, self.statistics, len(run.scene.split("train")))
        for name in sorted(self.tables - gaussians.tables.keys()):
            gaussians.add(name, 1)
            run.refresh_filter()
        for stage in self.during:
            stage.attach(run)
        place_harmonics(run)
        run.adam = run.adam or Adam(gaussians)
        parts = run.rasterizer, run.model, run.adam, run.stats, photographs.background
        rates, colours = self.rates.settled(views.full_size(last)), photograph_colours(self.colours, run, last)
        poses = photograph_poses(self.poses, run, last)
        own = colours, self.transients, run.sky, self.dropout, run.seed
        behind, depths = drawn_backgrounds(self.background, run), known_depths(self.losses, run, poses)
        trained = self.losses, rates, run.scene.extent, run.numbers, self.update
        layers = photograph_distractors(self.distractors, run)
        return Trainer(*parts, *trained, *own, poses=poses, backgrounds=behind, depths=depths, distractors=layers)

    def _edit(self, run: Run, views: ViewSettings) -> None:
        """Run the edits that were due at the step before."""
        if run.stage_step == 0 or run.edited:
            return
        run.divisor = views.divisor(run.step)
        with run.changing():
            for stage in (stage for stage in self.during if stage.edits and stage.due(run.step)):
                stage.act(run)
            run.edited = True

    def _step(self, run: Run, trainer: Trainer, sampler: Sampler) -> ViewLosses:
        """Do one step; a failure before its update leaves the run at the step before."""
        run.step += 1
        run.stage_step += 1
        try:
            view, stale, visit = self._differentiate(run, trainer, sampler)
        except BaseException:  # a second Ctrl-C too
            run.step, run.stage_step = run.step - 1, run.stage_step - 1
            run.device.timings.sampling = False
            raise
        with run.changing():
            run.numbers.update(visit.numbers)
            if isinstance(view, ViewGradients):
                trainer.update(view, stale)
            run.acted, run.edited = 0, False
        run.device.timings.sampling = False
        run.status.note(step=run.step)
        return view

    def _differentiate(self, run: Run, trainer: Trainer, sampler: Sampler) -> tuple[ViewLosses, set[str], Visit]:
        """The losses of one view, with gradients unless it is skipped, and the parameters that they do not update."""
        run.device.timings.sampling = run.step % self.log_every == self.log_every // 2  # away from density edits
        sample = sampler.at(run.step)
        photograph = run.photographs.of_sizes(sample.view, sample.original, sample.number)
        ahead = range(1, min(READ_AHEAD, self.steps - run.stage_step) + 1)
        run.photographs.announce(sampler.at(run.step + number).view for number in ahead)
        stale = {name for stage in self.during if stage.due(run.step) for name in stage.stale(run)}
        trainer.losses = [*self.losses, *run.losses]
        view = trainer.compare(photograph, run.step, sample.transforms)
        visit = self.skip.visit(sample.view.name, view, run.numbers) if self.skip else Visit()
        stale = set() if run.stage_step == self.steps else stale
        return view if visit.skipped else trainer.backward(view), stale, visit
