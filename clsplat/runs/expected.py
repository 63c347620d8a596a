"""How long the parts of a run take, from what small parts of the work take on this machine now.

Features and matches are tried on three of the photographs; training steps on made scenes of the photographs' size, with
few and with many Gaussians.  What only the work itself tells is a range: how often cameras are sought, how many
Gaussians grow, and at which step photographs for validation end the training.
"""

import logging
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import median

from clsplat.bench.scenes import SIZE, SIZES, case
from clsplat.errors import ClsplatError, DataError
from clsplat.opencl.device import Device
from clsplat.pipeline.choosing import choose
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline
from clsplat.prepare.cache import Planned
from clsplat.prepare.gather import is_readable, link
from clsplat.progress import only
from clsplat.scene.capture import Measures
from clsplat.scene.images import image_size
from clsplat.schedule import values_of
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.stages.train_field import TrainField
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
TRIED = 3  # photographs, the fewest of which features are found
STEPS = 5  # training steps that are timed
MEASURED = 20_000, 50_000  # Gaussians at most, of the two made scenes; the time of a step goes on as between them
MISTAKEN = 1.5  # times as long, or as short, as a trial: photographs differ
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


@dataclass(frozen=True)
class Capture:
    """What is known of the photographs before they are prepared, or of the scene that they have become."""

    size: tuple[int, int]  # px, of a photograph that is trained on
    gaussians: int  # that the training begins with


def expected(
    pipeline: Pipeline,
    planned: Sequence[Planned],
    names: Sequence[str],
    measures: Measures,
    device: Device,
    run: Run | None,
) -> list[str]:
    """Return a line for each part of a run, and one for all.

    names, measures: of the photographs that are to be prepared; run: with its scene, where that is prepared.

    Photographs are read and the device is used for some seconds; nothing is written but a temporary folder.
    """
    parts = list(_of_preparation(planned, pipeline.settings.scene.folder, names))
    without = "measurements" if parts or not any(one.why for one in planned) else "the preparation, measurements"
    if (capture := _capture(pipeline, planned, names, run)) is not None:
        settings = choose(pipeline.settings, measures) if run is None else pipeline.settings
        parts += [_of_training(training, settings, capture, device) for training in _trainings(settings)]
    if run is not None:
        parts += [_of_field(one, run) for one in pipeline.settings.stages if isinstance(one, TrainField)]
    if not parts:
        return []
    low, high = (sum(one.seconds[end] for one in parts) for end in (0, 1))
    told = f"without {without}, pictures and pages; by what small parts take on this machine as it is now"
    return [f"expected: {minutes_text((low, high))}, {told}", *(one.text for one in parts)]


def _of_preparation(planned: Sequence[Planned], folder: Path, names: Sequence[str]) -> Iterator[Expected]:
    """The steps that are to be done: by pieces of their work, or by the time of the first one."""
    if len(names) < TRIED or not any(one.why for one in planned):
        return
    try:
        tried = _tried(planned, folder, names)
    except ClsplatError as error:
        LOG.warning("the preparation cannot be tried, and is not in what is expected: %s", error)
        return
    whole = next(iter(tried.values()), 0.0) * len(names) / TRIED
    for one in planned:
        if not one.why:
            continue
        few, pieces, of_first = one.step.pieces(TRIED), one.step.pieces(len(names)), one.step.of_first
        if few and pieces and one.step.stage in tried:
            seconds = tried[one.step.stage] * pieces[0] / few[0]
            yield Expected(one.step.stage, (seconds / MISTAKEN, MISTAKEN * seconds), "{} {}".format(*pieces))
        elif of_first is not None:
            why = f"a guess, {of_first[0]:g} to {of_first[1]:g} times what {planned[0].step.stage} takes"
            yield Expected(one.step.stage, (of_first[0] * whole, of_first[1] * whole), why)


def _tried(planned: Sequence[Planned], folder: Path, names: Sequence[str]) -> dict[str, float]:
    """What the first steps take for some photographs that follow each other, s, by step; damaged ones are passed over.

    Raises DataError.
    """
    middle, found = (len(names) - TRIED) // 2, dict[str, float]()
    in_turn = (name for name in [*names[middle:], *reversed(names[:middle])] if is_readable(folder / name))
    if len(chosen := list(islice(in_turn, TRIED))) < TRIED:
        raise DataError(f"{folder}: {len(chosen)} of {len(names)} photographs can be read, {TRIED} are needed")
    with tempfile.TemporaryDirectory() as made, only(logging.ERROR):
        source = photographs = Path(made, "photographs")
        for name in chosen:
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            link(folder.resolve() / name, source / name)
        for number, one in enumerate(planned):
            if one.step.pieces(TRIED) is None:
                break
            target = Path(made, str(number))
            target.mkdir()
            began = time.perf_counter()
            try:
                one.step.make(source, target, target)
            except ClsplatError as error:  # names files that are gone when it is read
                told = str(error).replace(str(photographs), str(folder))
                for k, other in reversed([*enumerate(planned)]):  # 10 before 1
                    told = told.replace(str(Path(made, str(k))), other.step.stage)
                raise DataError(f"{one.step.stage}: {told}") from error
            found[one.step.stage], source = time.perf_counter() - began, target
    return found


def _capture(pipeline: Pipeline, planned: Sequence[Planned], names: Sequence[str], run: Run | None) -> Capture | None:
    """What is known of the photographs; None: too little."""
    if run is not None:
        views = run.scene.with_fold().split("train")
        cameras = sorted(((one.camera.width, one.camera.height) for one in views), key=lambda size: size[0] * size[1])
        begins = [one.expected_count(run.scene) for one in pipeline.settings.stages if isinstance(one, Init)]
        return Capture(cameras[len(cameras) // 2], begins[0] if begins else FEWEST)
    scene = pipeline.settings.scene
    if (found := _size(scene.folder, names)) is None:
        return None
    width, height = found
    longest = getattr(planned[-1].step, "long_side", None) or max(width, height)
    shrink = min(1.0, longest / max(width, height)) / scene.downscale
    return Capture((max(1, round(shrink * width)), max(1, round(shrink * height))), FEWEST)


def _size(folder: Path, names: Sequence[str]) -> tuple[int, int] | None:
    """The size of the first photograph, px; None where none of the first ones can be read."""
    for name in names[:TRIED]:
        with suppress(DataError):
            return image_size(folder / name)
    return None


def _trainings(settings: PipelineFile) -> list[Optimize]:
    return [stage for stage in settings.stages if isinstance(stage, Optimize)]


def _of_training(training: Optimize, settings: PipelineFile, capture: Capture, device: Device) -> Expected:
    """A training: between its fewest steps with the Gaussians of its start, and its most with the most of them."""
    pixels = capture.size[0] * capture.size[1]
    most = max(capture.gaussians, int(most_of(training, pixels) or DENSEST * pixels))
    each = step_seconds(device, capture.size, (capture.gaussians, most), settings)
    steps = training.fewest_steps, training.steps * (2 if training.refit else 1)
    of_steps, of_counts = (_range(*(f"{end:,}" for end in ends)) for ends in (steps, (capture.gaussians, most)))
    times, size = _range(*(f"{1e3 * one:.0f}" for one in each)), "{}x{}".format(*capture.size)
    why = f"{of_steps} steps of {times} ms, with {of_counts} Gaussians at {size} px; how many grow is a guess"
    return Expected(training.stage, (steps[0] * each[0], steps[1] * each[1]), why)


def _of_field(training: TrainField, run: Run) -> Expected:
    """A training of a field, whose steps all take the same time."""
    each = training.time_of_step(run)
    why = f"{training.steps:,} steps of {1e3 * each:.0f} ms, of {training.rays:,} rays"
    return Expected(training.stage, (training.steps * each, training.steps * each), why)


def most_of(training: Optimize, pixels: int) -> float | None:
    """Return the number of Gaussians at which a training ends growth, by its settings; None where they do not say it.

    pixels: of a photograph.
    """
    growing = [stage for stage in training.during if isinstance(stage, Densify)]
    limits = [max(values_of(one.max_gaussians)) for one in growing if one.max_gaussians is not None]
    return min([*limits, *(one.per_pixel * pixels for one in growing if one.per_pixel)], default=None)


def step_seconds(device: Device, size: tuple[int, int], counts: Sequence[int], settings: PipelineFile) -> list[float]:
    """Return the time of a training step for each number of Gaussians, s: by those of two made scenes, on a line.

    size: of a photograph, px.  The device is used for some seconds.
    """
    few = min(*counts, MEASURED[0])
    many = max(2 * few, min(max(counts), MEASURED[1]))
    base, grown = (_step(device, size, count, settings) for count in (few, many))
    more = max(0.0, grown - base) / (many - few)
    return [base + more * (count - few) for count in counts]


def _step(device: Device, size: tuple[int, int], count: int, settings: PipelineFile) -> float:
    """The time of a training step, s, of a made scene: so many Gaussians, which cover the photograph alike."""
    width, height, usual = SIZES["A"]
    spread = SIZE * math.sqrt(size[0] * size[1] / count * usual / (width * height))
    one = case(device, *size, count, settings, spread)
    for _ in range(STEPS):
        one.step(record=True)
    return median(one.clock) / 1e3


def minutes_text(seconds: Sequence[float]) -> str:
    """Return two times, s, as a range of minutes."""
    ends = [max(0.1, one / 60) for one in seconds]
    return _range(*(f"{one:.0f}" if one >= 10 else f"{one:.1f}" for one in ends)) + " min"


def _range(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"
