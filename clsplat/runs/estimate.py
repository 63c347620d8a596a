"""Estimate the time of a run as a rough range, without running anything on the device.

The time of a step is proportional to pixels and Gaussians, or to the samples and weights of a field, divided by the
compute units of the device.  The range is wider if the final number of Gaussians, or the step at which validation ends
the training, is unknown.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from clsplat.core.errors import DataError
from clsplat.core.schedule import schedule_values
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, apply_adaptation
from clsplat.prepare.cache import PlannedStep
from clsplat.scene.images import read_image_size
from clsplat.scene.quality import Measures
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.stages.train_field import TrainField
from clsplat.training.run import Run

PIXEL_SECONDS, GAUSSIAN_SECONDS = 1.0e-7, 4.0e-7  # s per pixel and per Gaussian in a training step, on one AVX-512 core
WEIGHT_SECONDS, LEVEL_SECONDS = 2.0e-11, 2.0e-8  # s per network weight and per grid level of a field, for each sample
LAUNCH_SECONDS = 1.0e-3  # s per step for kernel launches, independent of its size
SLOWDOWN = 6.0  # factor for slower processors and larger Gaussians than in the benchmark
MIN_GAUSSIANS = 5000  # initial number for a small capture whose points are unknown
MAX_PER_PIXEL = 1.0  # Gaussians per pixel of an image, if no setting limits them; typical captures end at 0.1 to 1


@dataclass(frozen=True)
class Estimate:
    """The estimated time of a part of a run, with an explanation."""

    name: str
    seconds: tuple[float, float]  # minimum and maximum
    reason: str

    @property
    def text(self) -> str:
        """The estimate in one line."""
        return f"  {self.name:<14} {format_minutes(self.seconds)}: {self.reason}"


def estimate_time(
    pipeline: Pipeline,
    planned_steps: Sequence[PlannedStep],
    names: Sequence[str],
    measures: Measures | None,
    device: Device,
    run: Run | None,
) -> list[str]:
    """Return a line with the estimated time of the run, and one line per part; empty if nothing can be estimated.

    names, measures: file names and measures of the photos to prepare.  run: None if the scene is not prepared yet.
    """
    estimates = list(_estimate_preparation(planned_steps, len(names))) if names else []
    if (size_and_count := _find_training_size_and_count(pipeline, planned_steps, names, run)) is not None:
        settings = (apply_adaptation(pipeline, measures) if measures and run is None else pipeline).settings
        training_stages = [stage for stage in settings.stages if isinstance(stage, Optimize)]
        estimates += [_estimate_training(training, *size_and_count, device.info.units) for training in training_stages]
    field_stages = [stage for stage in pipeline.settings.stages if isinstance(stage, TrainField)]
    estimates += [_estimate_field(training, device.info.units) for training in field_stages]
    if not estimates:
        return []
    low, high = (sum(estimate.seconds[end] for estimate in estimates) for end in (0, 1))
    total = f"expected: {format_minutes((low, high))}, roughly, without evaluation, renders, and pages"
    return [total, *(estimate.text for estimate in estimates)]


def _estimate_preparation(planned_steps: Sequence[PlannedStep], photo_count: int) -> Iterator[Estimate]:
    """Yield an estimate for each preparation step that is due."""
    for planned_step in planned_steps:
        if planned_step.reason and (seconds := planned_step.step.seconds) is not None:
            count, unit = planned_step.step.count_items(photo_count)
            yield Estimate(planned_step.step.stage, (seconds[0] * count, seconds[1] * count), f"{count:,} {unit}")


def _find_training_size_and_count(
    pipeline: Pipeline, planned_steps: Sequence[PlannedStep], names: Sequence[str], run: Run | None
) -> tuple[tuple[int, int], int] | None:
    """Return the size of the training images, px, and the initial number of Gaussians; None if the size is unknown."""
    if run is not None:
        views = run.scene.merge_validation().split("train")
        sizes = sorted(((view.camera.width, view.camera.height) for view in views), key=lambda size: size[0] * size[1])
        counts = [stage.expected_count(run.scene) for stage in pipeline.settings.stages if isinstance(stage, Init)]
        return sizes[len(sizes) // 2], counts[0] if counts else MIN_GAUSSIANS
    scene = pipeline.settings.scene
    if (size := _first_photo_size(scene.folder, names)) is None:
        return None
    long_side = getattr(planned_steps[-1].step, "long_side", None) or max(size)
    scale = min(1.0, long_side / max(size)) / scene.downscale
    return (max(1, round(scale * size[0])), max(1, round(scale * size[1]))), MIN_GAUSSIANS


def _first_photo_size(folder: Path, names: Sequence[str]) -> tuple[int, int] | None:
    """Return the size, px, of the first readable photo; None if the first three are unreadable."""
    for name in names[:3]:
        with suppress(DataError):
            return read_image_size(folder / name)
    return None


def _estimate_training(training: Optimize, size: tuple[int, int], initial: int, units: int) -> Estimate:
    """Estimate the time of a training stage, from its minimum and maximum numbers of steps and Gaussians.

    size: width and height of the images, px.  initial: the initial number of Gaussians.  units: as for `step_seconds`.
    """
    pixels = size[0] * size[1]
    maximum = max(initial, int(max_gaussians(training) or MAX_PER_PIXEL * pixels))
    low, high = step_seconds(units, size, initial)[0], step_seconds(units, size, maximum)[1]
    steps = training.min_steps, training.steps * (2 if training.refit else 1)
    steps_text, counts_text = (_format_range(*(f"{end:,}" for end in ends)) for ends in (steps, (initial, maximum)))
    reason = f"{steps_text} steps of {_format_ms(low, high)}, with {counts_text} Gaussians at {size[0]}x{size[1]} px"
    return Estimate(training.stage, (steps[0] * low, steps[1] * high), reason)


def _estimate_field(training: TrainField, units: int) -> Estimate:
    """Estimate the time of a stage that trains a field.  All its steps take the same time."""
    shape = training.field
    samples = training.rays * (shape.coarse_samples + shape.fine_samples)
    levels = shape.grid.levels if shape.grid else 0
    sample_seconds = WEIGHT_SECONDS * shape.network_length + LEVEL_SECONDS * levels
    low = LAUNCH_SECONDS + samples * sample_seconds / units
    reason = f"{training.steps:,} steps of {_format_ms(low, SLOWDOWN * low)}, of {training.rays:,} rays"
    return Estimate(training.stage, (training.steps * low, training.steps * SLOWDOWN * low), reason)


def max_gaussians(training: Optimize) -> float | None:
    """Return the maximum number of Gaussians that the settings of a training allow; None if there is no limit."""
    growth_stages = [stage for stage in training.during if isinstance(stage, Densify)]
    limits = [max(schedule_values(stage.max_gaussians)) for stage in growth_stages if stage.max_gaussians is not None]
    return min(limits, default=None)


def step_seconds(units: int, size: tuple[int, int], count: int) -> tuple[float, float]:
    """Return the minimum and maximum time of a training step, s.

    units: number of compute units of the device.  size: width and height of an image, px.  count: number of Gaussians.
    """
    seconds = LAUNCH_SECONDS + (PIXEL_SECONDS * size[0] * size[1] + GAUSSIAN_SECONDS * count) / units
    return seconds, SLOWDOWN * seconds


def format_minutes(seconds: Sequence[float]) -> str:
    """Format a minimum and a maximum time in seconds as a range of minutes."""
    minutes = [max(0.1, end / 60) for end in seconds]
    return _format_range(*(f"{end:.0f}" if end >= 10 else f"{end:.1f}" for end in minutes)) + " min"


def _format_ms(low: float, high: float) -> str:
    return _format_range(f"{1e3 * low:.0f}", f"{1e3 * high:.0f}") + " ms"


def _format_range(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"
