"""The training of a field: a network in the place of Gaussians."""

import logging
import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from clsplat.core.errors import ConfigError, DataError, NotFiniteError, OutputError
from clsplat.core.schedule import Decay, NonNegative, at_step
from clsplat.core.settings import OneOf
from clsplat.gaussians.model import Rendering
from clsplat.nerf.files import ENDING, FILE, FieldModel, load_field
from clsplat.nerf.shape import FieldShape
from clsplat.nerf.training import AdamStep, LearnedField, RayPhotograph, field_plan, require_seen
from clsplat.photos.sampling import Order, Uniform, ViewPool
from clsplat.stages.optimize import report
from clsplat.training import checkpoint
from clsplat.training.records import Forecast, clocks
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled, Stage, Training, path_in_run

LOG = logging.getLogger("clsplat")


class TrainField(Training):
    """Train a field of densities and colors on random rays of the photographs (Mip-NeRF, Barron et al. 2021).

    A step draws its rays from one photograph, or from several, as many from each.  Where photographs have several
    sizes, the loss is that of all their pixels, each counted as its area (section 4): so all sizes count alike.
    Stages that render, measure and report take the field as they take Gaussians; `export_field` writes a file of it.
    """

    stage: Literal["train_field"] = "train_field"
    makes: ClassVar[frozenset[str]] = frozenset({"painter", "field"})
    takes: ClassVar[frozenset[str]] = frozenset({"model"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "coarse_weight", "epsilon"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"warm_up"})
    rehearsed: ClassVar[int] = 20  # all of its steps take the same time

    field: FieldShape = FieldShape()
    """Network and samples."""
    rays: Annotated[int, Field(gt=0, le=1 << 20)] = 4096
    """Rays of a step."""
    photographs: Annotated[int, Field(gt=0, le=1 << 20)] = 1
    """Photographs that they are drawn from, as many from each."""
    order: OneOf[Order] = Uniform()
    """Which photographs a step trains on."""
    coarse_weight: Annotated[float, Field(ge=0)] = 0.1
    """Weight of the coarse level's loss beside that of the fine one."""
    rate: NonNegative = Decay(initial=5e-4, final=5e-6, over=1_000_000)
    """Learning rate, by step."""
    warm_up: Annotated[int, Field(ge=0)] = 2500
    """Steps until the rate is that of `rate`, along a quarter of a sine."""
    warm_up_from: Annotated[float, Field(ge=0, le=1)] = 0.01
    """Share of the rate at the first step."""
    epsilon: Annotated[float, Field(gt=0)] = 1e-8
    """Added to the root of Adam's second moment; below it gradients are too small to count: a grid has such."""
    during: list[OneOf[Scheduled]] = Field([])
    """Stages that run every so many steps."""
    log_every: Annotated[int, Field(gt=0)] = 100
    """Steps between lines of metrics.jsonl."""

    @model_validator(mode="after")
    def _same_rays(self) -> "TrainField":
        if self.rays % self.photographs:
            raise ValueError(f"expected 'rays' in equal parts for {self.photographs} photographs; {self.rays} are not")
        if any(stage.edits for stage in self.during):
            raise ValueError("expected stages in 'during' that edit no Gaussians: a field has none")
        return self

    def check_run(self, run: Run) -> None:
        """Raise ConfigError for a grid that the scene does not touch, MemoryLimitError for a field that does not fit,
        before it is made, and what stages of `during` raise."""
        super().check_run(run)
        require_seen(self.field, run.scene)
        views = run.scene.split("train")
        held = min(run.photographs.budget, sum(4 * view.camera.width * view.camera.height for view in views))
        field_plan(self.field, held).check(run.device.info)

    def run(self, run: Run) -> None:
        self.check_run(run)
        field = run.learned_field = self._begun(run)
        last = run.step - run.stage_step + self.steps
        pool, forecast = ViewPool(run.scene.split("train"), run.seed), Forecast.of(run.step, last, [])
        seconds: list[float] = []  # of the steps since the last report
        self.act_between(run)
        while not self.has_ended(run):
            start = clocks()
            self._step(run, field, pool)
            run.status.count("steps", run.stage_step, self.steps, step=run.step, steps=last)
            is_reported = run.step % self.log_every == 0 or run.stage_step == self.steps or run.interrupted
            values = self._values(run, field) if is_reported else (0.0, 0.0)
            seconds.append(run.add_training_time(start))
            if is_reported:
                report(run, forecast, values, seconds)
                seconds.clear()
            self.end_step(run)

    def rate_at(self, step: int) -> float:
        """Return the learning rate of a global step (Barron et al. 2021, released code: delayed warm-up)."""
        share = math.sin(0.5 * math.pi * min(step / self.warm_up, 1.0)) if self.warm_up else 1.0
        return (self.warm_up_from + (1 - self.warm_up_from) * share) * at_step(self.rate, step)

    def _begun(self, run: Run) -> LearnedField:
        """The field of the run, where an earlier step has trained one of this shape; else a new one."""
        if isinstance(run.learned_field, LearnedField) and run.learned_field.field.shape == self.field:
            return run.learned_field
        field = LearnedField.first(self.field, run.seed, run.photographs.background)
        LOG.info("a field of %s parameters", f"{self.field.learned:,}")
        return field

    def _step(self, run: Run, field: LearnedField, pool: ViewPool) -> None:
        """Do one step; a failure before its update leaves the run at the step before."""
        step = run.step + 1
        run.device.timings.sampling = step % self.log_every == self.log_every // 2
        shown = list(self._shown(run, pool, step))
        with run.editing_tables():
            run.step, run.stage_step = step, run.stage_step + 1
            field.step(shown, self.coarse_weight, AdamStep(self.rate_at(step), self.epsilon), run.seed, step)
            run.device.finish()  # the one wait of a step
            run.during_index = 0
        run.device.timings.sampling = False
        run.status.note(step=run.step)

    def _shown(self, run: Run, pool: ViewPool, step: int) -> Iterator[RayPhotograph]:
        """The photographs of a step."""
        for number in range(self.photographs):
            view = self.order.at(pool, (step - 1) * self.photographs + number + 1)
            photograph = run.photographs.get(view)
            if photograph.mask is not None:
                raise ConfigError(f"train_field: {view.name} has a mask; expected photographs whose pixels all count")
            area = view.camera.width * view.camera.height * view.downscale**2  # which its rays stand for
            yield RayPhotograph(photograph.camera, photograph, self.rays // self.photographs, area)

    def _values(self, run: Run, field: LearnedField) -> tuple[float, float]:
        """The loss of the last step and the PSNR of its fine level, dB.

        Raises NotFiniteError, with the state set aside, where the loss or the field is not finite.
        """
        loss, error = field.loss(self.coarse_weight)
        broken = field.not_finite()
        if broken or not math.isfinite(loss):
            raise NotFiniteError(f"step {run.step}: the loss is {loss}; {checkpoint.set_aside(run, broken)}")
        return loss, -10 * math.log10(max(error, 1e-12))


# The field as a file.


class ExportField(Stage):
    """Write the field that `train_field` has trained, and read it back: a file that clsplat alone reads.

    `clsplat render` and `clsplat evaluate` take it, or the run folder that holds it.
    """

    stage: Literal["export_field"] = "export_field"
    needs: ClassVar[frozenset[str]] = frozenset({"field"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"file"})

    file: Annotated[str, path_in_run(ENDING)] = FILE
    """Path inside the run folder; .npz."""

    def run(self, run: Run) -> None:
        assert isinstance(run.learned_field, LearnedField)
        field, file = run.learned_field.field, run.out / self.file
        rendering = Rendering(background=run.photographs.background_name, alpha=run.original.views[0].alpha)
        run.model_hashes[self.file] = FieldModel(field.shape, field.parameters.get(), rendering).save(file)
        try:
            load_field(file)
        except DataError as error:
            raise OutputError(f"{error}; it was written just now: check the disk and its space") from error
        LOG.info("a field of %s parameters written to %s", f"{field.shape.learned:,}", file)
