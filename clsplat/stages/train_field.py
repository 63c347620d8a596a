"""Train a field, a network instead of Gaussians, and export it."""

import logging
import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from clsplat.core.errors import ConfigError, DataError, NotFiniteError, OutputError
from clsplat.core.schedule import Decay, NonNegative, at_step
from clsplat.core.settings import OneOf
from clsplat.gaussians.model import Rendering
from clsplat.nerf.files import FILE, SUFFIX, FieldModel, load_field
from clsplat.nerf.shape import FieldShape
from clsplat.nerf.training import AdamStep, LearnedField, RayPhotograph, field_plan, require_visible_grid
from clsplat.photos.sampling import Order, Uniform, ViewPool
from clsplat.stages.optimize import report
from clsplat.training import checkpoint
from clsplat.training.records import Forecast, read_clocks
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled, Stage, Training, path_in_run

LOG = logging.getLogger("clsplat")


class TrainField(Training):
    """Train a field of densities and colors on random rays of the photos (Mip-NeRF, Barron et al. 2021).

    A step samples its rays from one photo, or the same number of rays from each of several photos.  With several image
    sizes, pixels are weighted by their area, so that all sizes contribute equally (section 4).  Stages that render,
    measure and report support fields as well as Gaussians; `export_field` writes a file.
    """

    stage: Literal["train_field"] = "train_field"
    makes: ClassVar[frozenset[str]] = frozenset({"painter", "field"})
    removes: ClassVar[frozenset[str]] = frozenset({"model"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "coarse_weight", "epsilon"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"warm_up"})
    rehearsal_steps: ClassVar[int] = 20  # since all steps take the same time

    field: FieldShape = FieldShape()
    """Network and samples."""
    rays: Annotated[int, Field(gt=0, le=1 << 20)] = 4096
    """Rays per step."""
    photographs: Annotated[int, Field(gt=0, le=1 << 20)] = 1
    """Photos per step; each contributes the same number of rays."""
    order: OneOf[Order] = Uniform()
    """Order of the photos."""
    coarse_weight: Annotated[float, Field(ge=0)] = 0.1
    """Weight of the coarse level's loss; the fine level's is 1."""
    rate: NonNegative = Decay(initial=5e-4, final=5e-6, over=1_000_000)
    """Learning rate."""
    warm_up: Annotated[int, Field(ge=0)] = 2500
    """Number of steps in which the learning rate rises to `rate`, along a quarter of a sine."""
    warm_up_from: Annotated[float, Field(ge=0, le=1)] = 0.01
    """Fraction of `rate` with which the warm-up starts."""
    epsilon: Annotated[float, Field(gt=0)] = 1e-8
    """Term added to the square root of Adam's second moment.  Gradients that are much smaller, as is common in grids,
    have little effect."""
    during: list[OneOf[Scheduled]] = Field([])
    """Stages that run at a cadence."""
    log_every: Annotated[int, Field(gt=0)] = 100
    """Steps between lines of metrics.jsonl."""

    @model_validator(mode="after")
    def _check_settings(self) -> "TrainField":
        if self.rays % self.photographs:
            raise ValueError(f"'rays' must be a multiple of 'photographs', {self.photographs}; got {self.rays}")
        if any(stage.edits for stage in self.during):
            raise ValueError("'during' has a stage that edits Gaussians, but a field has none; remove the stage")
        return self

    def check_run(self, run: Run) -> None:
        """Check the run before the field is created.

        Raises ConfigError if no camera sees the grid, MemoryLimitError if the field does not fit, and the errors of
        the stages in `during`.
        """
        super().check_run(run)
        require_visible_grid(self.field, run.scene)
        views = run.scene.split("train")
        image_bytes = min(run.photographs.budget, sum(4 * view.camera.width * view.camera.height for view in views))
        field_plan(self.field, image_bytes).check(run.device.info)

    def run(self, run: Run) -> None:
        self.check_run(run)
        field = run.learned_field = self._create_field(run)
        last_step = run.step - run.stage_step + self.steps
        pool, forecast = ViewPool(run.scene.split("train"), run.seed), Forecast.from_rules(run.step, last_step, [])
        seconds: list[float] = []  # of the steps since the last report
        self.act_between(run)
        while not self.has_ended(run):
            start = read_clocks()
            self._step(run, field, pool)
            run.status.count("steps", run.stage_step, self.steps, step=run.step, steps=last_step)
            is_reported = run.step % self.log_every == 0 or run.stage_step == self.steps or run.interrupted
            values = self._loss_and_psnr(run, field) if is_reported else (0.0, 0.0)
            seconds.append(run.add_training_time(start))
            if is_reported:
                report(run, forecast, values, seconds)
                seconds.clear()
            self.end_step(run)

    def rate_at(self, step: int) -> float:
        """Return the learning rate at a global step, with the delayed warm-up of Barron et al. 2021 (released code)."""
        progress = math.sin(0.5 * math.pi * min(step / self.warm_up, 1.0)) if self.warm_up else 1.0
        return (self.warm_up_from + (1 - self.warm_up_from) * progress) * at_step(self.rate, step)

    def _create_field(self, run: Run) -> LearnedField:
        """Return the field of a resumed run, or a new one."""
        shape = self.field.with_unit(run.scene).model_copy(update={"unit_auto": None})
        if isinstance(run.learned_field, LearnedField) and run.learned_field.field.shape == shape:
            return run.learned_field
        if run.stage_step:
            raise DataError("train_field.field: the saved field has another shape or unit; start over with --restart")
        field = LearnedField.initial(shape, run.seed, run.photographs.background)
        LOG.info("training a field with %s parameters", f"{self.field.parameter_count:,}")
        return field

    def _step(self, run: Run, field: LearnedField, pool: ViewPool) -> None:
        """Train for one step.  A failure before its update leaves the run at the previous step."""
        step = run.step + 1
        run.device.timings.sampling = step % self.log_every == self.log_every // 2
        photographs = list(self._sample(run, pool, step))
        with run.editing_tables():
            run.step, run.stage_step = step, run.stage_step + 1
            field.step(photographs, self.coarse_weight, AdamStep(self.rate_at(step), self.epsilon), run.seed, step)
            run.device.finish()  # the only wait in a step
            run.during_index = 0
        run.device.timings.sampling = False
        run.status.note(step=run.step)

    def _sample(self, run: Run, pool: ViewPool, step: int) -> Iterator[RayPhotograph]:
        """Yield the photos of a step, each with its number of rays."""
        for index in range(self.photographs):
            view = self.order.view_at(pool, (step - 1) * self.photographs + index + 1)
            photograph = run.photographs.get(view)
            if photograph.mask is not None:
                raise ConfigError(f"train_field: {view.name} has a mask, which fields do not support; remove the masks")
            area = view.camera.width * view.camera.height * view.downscale**2  # in original pixels
            yield RayPhotograph(photograph.camera, photograph, self.rays // self.photographs, area)

    def _loss_and_psnr(self, run: Run, field: LearnedField) -> tuple[float, float]:
        """Return the loss of the last step, and the PSNR of its fine level, dB.

        Raises NotFiniteError, after saving the state separately, if the loss or the field is not finite.
        """
        loss, error = field.loss(self.coarse_weight)
        damaged_tables = field.find_nonfinite()
        if damaged_tables or not math.isfinite(loss):
            raise NotFiniteError(f"step {run.step}: the loss is {loss}; {checkpoint.save_failed(run, damaged_tables)}")
        return loss, -10 * math.log10(max(error, 1e-12))


class ExportField(Stage):
    """Write the field that `train_field` trained, in a format that only clsplat reads, and read it back.

    `clsplat render` and `clsplat evaluate` accept the file or its run folder.
    """

    stage: Literal["export_field"] = "export_field"
    needs: ClassVar[frozenset[str]] = frozenset({"field"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"file"})

    file: Annotated[str, path_in_run(SUFFIX)] = FILE
    """Path inside the run folder; .npz."""

    def run(self, run: Run) -> None:
        assert isinstance(run.learned_field, LearnedField)
        field, file = run.learned_field.field, run.out / self.file
        rendering = Rendering(background=run.photographs.background_name, alpha=run.original.views[0].alpha)
        model = FieldModel(field.shape, field.parameters.get(), rendering, run.scene.origin)
        run.model_hashes[self.file] = model.save(file)
        try:
            load_field(file)
        except DataError as error:
            raise OutputError(f"{error}; the file was just written: check the disk and its free space") from error
        LOG.info("wrote a field with %s parameters to %s", f"{field.shape.parameter_count:,}", file)
