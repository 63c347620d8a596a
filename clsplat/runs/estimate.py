"""Estimate the time of a run as a rough range, without running anything on the device.

The time of a step is proportional to pixels and Gaussians, or to the samples and weights of a field, divided by the
compute units of the device.  Unknowns widen the range: how many Gaussians grow, and at which step validation ends the
training.
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
from clsplat.scene.images import image_size
from clsplat.scene.quality import Measures
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.stages.train_field import TrainField
from clsplat.training.run import Run

PIXEL, GAUSSIAN = 1.0e-7, 4.0e-7  # s per pixel and per Gaussian of a training step, on one AVX-512 core
WEIGHT, LEVEL = 2.0e-11, 2.0e-8  # s per weight of a field and per level of its grid, for each sample
LAUNCHES = 1.0e-3  # s per step, whatever its size
SLOWER = 6.0  # factor for slower processors and larger Gaussians than in the benchmark
MIN_GAUSSIANS = 5000  # initial number for a small capture, while the points are unknown
MAX_PER_PIXEL = 1.0  # Gaussians per pixel of an image, if no setting limits them; typical captures end at 0.1 to 1


@dataclass(frozen=True)
class Estimate:
    """The estimated time of a part of a run, s, from minimum to maximum, with an explanation."""

    name: str
    seconds: tuple[float, float]
    reason: str

    @property
    def text(self) -> str:
        """The estimate in one line."""
        return f"  {self.name:<14} {minutes_text(self.seconds)}: {self.reason}"


def estimate_time(
    pipeline: Pipeline,
    planned: Sequence[PlannedStep],
    names: Sequence[str],
    measures: Measures | None,
    device: Device,
    run: Run | None,
) -> list[str]:
    """Return a line with the time of the run, and one for each part; empty if nothing can be estimated.

    names, measures: of the photos to prepare; run: only if the scene is prepared already.
    """
    parts = list(_preparation_estimates(planned, len(names))) if names else []
    if (capture := _capture(pipeline, planned, names, run)) is not None:
        settings = (apply_adaptation(pipeline, measures) if measures and run is None else pipeline).settings
        trainings = [stage for stage in settings.stages if isinstance(stage, Optimize)]
        parts += [_training_estimate(training, *capture, device.info.units) for training in trainings]
    fields = [stage for stage in pipeline.settings.stages if isinstance(stage, TrainField)]
    parts += [_field_estimate(training, device.info.units) for training in fields]
    if not parts:
        return []
    low, high = (sum(part.seconds[end] for part in parts) for end in (0, 1))
    total = f"expected: {minutes_text((low, high))}, roughly, without evaluation, renders, and pages"
    return [total, *(part.text for part in parts)]


def _preparation_estimates(planned: Sequence[PlannedStep], photographs: int) -> Iterator[Estimate]:
    """Estimate the preparation steps that are due."""
    for planned_step in planned:
        if planned_step.why and (seconds := planned_step.step.seconds) is not None:
            count, name = planned_step.step.pieces(photographs)
            yield Estimate(planned_step.step.stage, (seconds[0] * count, seconds[1] * count), f"{count:,} {name}")


def _capture(
    pipeline: Pipeline, planned: Sequence[PlannedStep], names: Sequence[str], run: Run | None
) -> tuple[tuple[int, int], int] | None:
    """Return the image size in training, px, and the initial number of Gaussians; None if unknown."""
    if run is not None:
        views = run.scene.merge_validation().split("train")
        sizes = sorted(((view.camera.width, view.camera.height) for view in views), key=lambda size: size[0] * size[1])
        counts = [stage.expected_count(run.scene) for stage in pipeline.settings.stages if isinstance(stage, Init)]
        return sizes[len(sizes) // 2], counts[0] if counts else MIN_GAUSSIANS
    scene = pipeline.settings.scene
    if (size := _size(scene.folder, names)) is None:
        return None
    longest = getattr(planned[-1].step, "long_side", None) or max(size)
    scale = min(1.0, longest / max(size)) / scene.downscale
    return (max(1, round(scale * size[0])), max(1, round(scale * size[1]))), MIN_GAUSSIANS


def _size(folder: Path, names: Sequence[str]) -> tuple[int, int] | None:
    """Return the size of the first photo that can be read, px; None if none of the first three can."""
    for name in names[:3]:
        with suppress(DataError):
            return image_size(folder / name)
    return None


def _training_estimate(training: Optimize, size: tuple[int, int], initial: int, units: int) -> Estimate:
    """Estimate a training, for the smallest and the largest number of steps and Gaussians."""
    pixels = size[0] * size[1]
    maximum = max(initial, int(max_gaussians(training, pixels) or MAX_PER_PIXEL * pixels))
    low, high = step_seconds(units, size, initial)[0], step_seconds(units, size, maximum)[1]
    steps = training.min_steps, training.steps * (2 if training.refit else 1)
    steps_text, counts_text = (_range(*(f"{end:,}" for end in ends)) for ends in (steps, (initial, maximum)))
    reason = f"{steps_text} steps of {_ms(low, high)}, with {counts_text} Gaussians at {size[0]}x{size[1]} px"
    return Estimate(training.stage, (steps[0] * low, steps[1] * high), reason)


def _field_estimate(training: TrainField, units: int) -> Estimate:
    """Estimate a training of a field, whose steps all take the same time."""
    shape = training.field
    samples = training.rays * (shape.coarse_samples + shape.fine_samples)
    sample_seconds = WEIGHT * shape.network_parameters + LEVEL * (shape.grid.levels if shape.grid else 0)
    low = LAUNCHES + samples * sample_seconds / units
    reason = f"{training.steps:,} steps of {_ms(low, SLOWER * low)}, of {training.rays:,} rays"
    return Estimate(training.stage, (training.steps * low, training.steps * SLOWER * low), reason)


def max_gaussians(training: Optimize, pixels: int) -> float | None:
    """Return the maximum number of Gaussians by the settings of a training; None if there is no limit.

    pixels: of an image.
    """
    growing = [stage for stage in training.during if isinstance(stage, Densify)]
    limits = [max(schedule_values(stage.max_gaussians)) for stage in growing if stage.max_gaussians is not None]
    return min([*limits, *(stage.per_pixel * pixels for stage in growing if stage.per_pixel)], default=None)


def step_seconds(units: int, size: tuple[int, int], count: int) -> tuple[float, float]:
    """Return the minimum and maximum time of a training step, s.

    units: compute units of the device; size: of an image, px; count: of Gaussians.
    """
    seconds = LAUNCHES + (PIXEL * size[0] * size[1] + GAUSSIAN * count) / units
    return seconds, SLOWER * seconds


def minutes_text(seconds: Sequence[float]) -> str:
    """Format a minimum and a maximum time, s, as a range of minutes."""
    minutes = [max(0.1, end / 60) for end in seconds]
    return _range(*(f"{end:.0f}" if end >= 10 else f"{end:.1f}" for end in minutes)) + " min"


def _ms(low: float, high: float) -> str:
    return _range(f"{1e3 * low:.0f}", f"{1e3 * high:.0f}") + " ms"


def _range(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"
