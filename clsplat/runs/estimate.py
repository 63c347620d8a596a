"""A rough range of the time that a run takes, by the numbers of its work alone: nothing is tried on the device.

The time of a step is in proportion to pixels and Gaussians, or to the samples and weights of a field, and divided by
the compute units of the device.  What only the work itself tells widens the range: how many Gaussians grow, and at
which step photographs for validation end the training.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from clsplat.core.errors import DataError
from clsplat.core.schedule import schedule_values
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, adapted
from clsplat.prepare.cache import PlannedStep
from clsplat.scene.images import image_size
from clsplat.scene.quality import Measures
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.stages.train_field import TrainField
from clsplat.training.run import Run

PIXEL, GAUSSIAN = 1.0e-7, 4.0e-7  # s of a compute unit, for each of a training step: of an AVX-512 core
WEIGHT, LEVEL = 2.0e-11, 2.0e-8  # s of a compute unit, for each weight of a field and level of its grid, of a sample
LAUNCHES = 1.0e-3  # s of any step
SLOWER = 6.0  # times as long, on older processors and with larger Gaussians than those of the benchmark
FEWEST = 5000  # Gaussians, where the points are not known yet: those of a small capture
DENSEST = 1.0  # Gaussians for each pixel of a photograph, where no setting says the most; captures end at 0.1 to 1


@dataclass(frozen=True)
class Expected:
    """What a part of a run takes, s: at least, at most, and from what that follows."""

    name: str
    seconds: tuple[float, float]
    why: str

    @property
    def text(self) -> str:
        """The part in one line."""
        return f"  {self.name:<14} {minutes_text(self.seconds)}: {self.why}"


def expected(
    pipeline: Pipeline,
    planned: Sequence[PlannedStep],
    names: Sequence[str],
    measures: Measures | None,
    device: Device,
    run: Run | None,
) -> list[str]:
    """Return a line for each part of a run, and one for all.

    names, measures: of the photographs that are to be prepared; run: with its scene, where that is prepared.
    """
    parts = list(_of_preparation(planned, len(names))) if names else []
    if (capture := _capture(pipeline, planned, names, run)) is not None:
        settings = (adapted(pipeline, measures) if measures and run is None else pipeline).settings
        trainings = [stage for stage in settings.stages if isinstance(stage, Optimize)]
        parts += [_of_training(training, *capture, device.info.units) for training in trainings]
    fields = [stage for stage in pipeline.settings.stages if isinstance(stage, TrainField)]
    parts += [_of_field(training, device.info.units) for training in fields]
    if not parts:
        return []
    low, high = (sum(one.seconds[end] for one in parts) for end in (0, 1))
    total = f"expected: {minutes_text((low, high))}, roughly, without measurements, pictures and pages"
    return [total, *(one.text for one in parts)]


def _of_preparation(planned: Sequence[PlannedStep], photographs: int) -> Iterator[Expected]:
    """The steps that are to be done."""
    for one in planned:
        if one.why and (each := one.step.seconds) is not None:
            count, name = one.step.pieces(photographs)
            yield Expected(one.step.stage, (each[0] * count, each[1] * count), f"{count:,} {name}")


def _capture(
    pipeline: Pipeline, planned: Sequence[PlannedStep], names: Sequence[str], run: Run | None
) -> tuple[tuple[int, int], int] | None:
    """The size of a photograph that is trained on, px, and the Gaussians at the beginning; None: not known."""
    if run is not None:
        views = run.scene.merge_validation().split("train")
        cameras = sorted(((one.camera.width, one.camera.height) for one in views), key=lambda size: size[0] * size[1])
        begins = [one.expected_count(run.scene) for one in pipeline.settings.stages if isinstance(one, Init)]
        return cameras[len(cameras) // 2], begins[0] if begins else FEWEST
    scene = pipeline.settings.scene
    if (found := _size(scene.folder, names)) is None:
        return None
    longest = getattr(planned[-1].step, "long_side", None) or max(found)
    shrink = min(1.0, longest / max(found)) / scene.downscale
    return (max(1, round(shrink * found[0])), max(1, round(shrink * found[1]))), FEWEST


def _size(folder: Path, names: Sequence[str]) -> tuple[int, int] | None:
    """The size of the first photograph, px; None where none of the first ones can be read."""
    for name in names[:3]:
        with suppress(DataError):
            return image_size(folder / name)
    return None


def _of_training(training: Optimize, size: tuple[int, int], first: int, units: int) -> Expected:
    """A training: between its fewest steps with the Gaussians of its start, and its most with the most of them."""
    pixels = size[0] * size[1]
    most = max(first, int(most_of(training, pixels) or DENSEST * pixels))
    low, high = step_seconds(units, size, first)[0], step_seconds(units, size, most)[1]
    steps = training.min_steps, training.steps * (2 if training.refit else 1)
    of_steps, of_counts = (_range(*(f"{end:,}" for end in ends)) for ends in (steps, (first, most)))
    why = f"{of_steps} steps of {_ms(low, high)}, with {of_counts} Gaussians at {size[0]}x{size[1]} px"
    return Expected(training.stage, (steps[0] * low, steps[1] * high), why)


def _of_field(training: TrainField, units: int) -> Expected:
    """A training of a field, whose steps all take the same time."""
    shape = training.field
    samples = training.rays * (shape.coarse_samples + shape.fine_samples)
    of_sample = WEIGHT * shape.of_network + LEVEL * (shape.grid.levels if shape.grid else 0)
    low = LAUNCHES + samples * of_sample / units
    why = f"{training.steps:,} steps of {_ms(low, SLOWER * low)}, of {training.rays:,} rays"
    return Expected(training.stage, (training.steps * low, training.steps * SLOWER * low), why)


def most_of(training: Optimize, pixels: int) -> float | None:
    """Return the number of Gaussians at which a training ends growth, by its settings; None where they do not say it.

    pixels: of a photograph.
    """
    growing = [stage for stage in training.during if isinstance(stage, Densify)]
    limits = [max(schedule_values(one.max_gaussians)) for one in growing if one.max_gaussians is not None]
    return min([*limits, *(one.per_pixel * pixels for one in growing if one.per_pixel)], default=None)


def step_seconds(units: int, size: tuple[int, int], count: int) -> tuple[float, float]:
    """Return the time of a training step, s, at least and at most.

    units: compute units of the device; size: of a photograph, px; count: of Gaussians.
    """
    least = LAUNCHES + (PIXEL * size[0] * size[1] + GAUSSIAN * count) / units
    return least, SLOWER * least


def minutes_text(seconds: Sequence[float]) -> str:
    """Return two times, s, as a range of minutes."""
    ends = [max(0.1, one / 60) for one in seconds]
    return _range(*(f"{one:.0f}" if one >= 10 else f"{one:.1f}" for one in ends)) + " min"


def _ms(low: float, high: float) -> str:
    return _range(*(f"{1e3 * one:.0f}" for one in (low, high))) + " ms"


def _range(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"
