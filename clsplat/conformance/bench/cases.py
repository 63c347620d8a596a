"""Time training steps of scenes in alternation, so that a temporary slowdown affects all scenes; report medians."""

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import PARAMETERS, SH_C0, Parameters
from clsplat.formats.table import detect
from clsplat.gaussians.conversion import from_points
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.model import load
from clsplat.methods.adc import PruneLarge
from clsplat.opencl.device import Device, constants
from clsplat.photos.photographs import Photograph, Photographs
from clsplat.pipeline.file import PipelineFile
from clsplat.render.camera import upload_camera
from clsplat.render.rasterizer import RECORD, Frame, Rasterizer
from clsplat.scene.camera import Camera
from clsplat.scene.points import read_points_ply
from clsplat.scene.quality import near_plane
from clsplat.scene.view import View
from clsplat.training.adam import Adam, Rates
from clsplat.training.memory import plan
from clsplat.training.motion import MotionRates
from clsplat.training.records import stage_milliseconds
from clsplat.training.trainer import StepTrainer

MIN_SECONDS = 2e-3  # shortest measurement; the first launch and the final wait take about 0.02 ms of it


@dataclass(frozen=True)
class Peaks:
    """Peak rates of a device, from which the minimum times of stages are computed."""

    gflops: float  # multiply-adds count as two
    gexp: float  # 10⁹ exponentials per second
    gbytes: float  # 10⁹ bytes per second, read plus written, arrays larger than caches


def measure_peaks(device: Device, repeats: int = 5) -> Peaks:
    """Measure the rates of multiply-adds, exponentials and copies; return the best of `repeats` measurements."""
    program, lanes = device.program("peak.cl"), int(device.tuning["LANES"])
    group = int(device.tuning["GROUP"])
    is_cpu = device.info.kind == "CPU"
    items = 64 * group * max(1, device.info.units // (8 if is_cpu else 2))  # a GPU unit runs about 2048 at once
    result = device.empty(items * lanes)

    def time_launches(launch: Callable[[], None], count: int) -> float:
        device.finish()
        start = time.perf_counter()
        for _ in range(count):
            launch()
        device.finish()
        return time.perf_counter() - start

    def time_launch(launch: Callable[[], None]) -> float:
        count = 1
        time_launches(launch, count)  # the first launch compiles
        while (elapsed := time_launches(launch, count)) < MIN_SECONDS:
            count *= 4
        return min([elapsed, *(time_launches(launch, count) for _ in range(repeats - 1))]) / count

    floats, copy_group = max(lanes, 4), program.peak_copy.group[0]  # per item, and items per group
    rounds = 40_000 if is_cpu else 4000  # enough for the system to distribute the threads
    fma_time = time_launch(lambda: program.peak_fma(items=items, result=result, factor=0.5, rounds=rounds))
    exp_time = time_launch(lambda: program.peak_exp(items=items, result=result, step=1e-3, rounds=rounds))
    length = min(64 << 20, device.info.allocation // 16 // 4) // (floats * copy_group) * (floats * copy_group)
    src, dst = device.zeros(length), device.zeros(length)
    copy_time = time_launch(lambda: program.peak_copy(items=length // floats, values=src, copied=dst))
    work = items * lanes * rounds
    return Peaks(16 * work / fma_time / 1e9, 2 * work / exp_time / 1e9, 8 * length / copy_time / 1e9)


LOSS_BYTES = 3 + 12 + (24 + 36) + (36 + 24 + 12)  # unpack the photograph; maps and gradient of the SSIM, with the L1


@dataclass(frozen=True)
class Work:
    """The amount of work of one training step."""

    gaussians: int
    pairs: int
    rows: int  # (pair, row of 16 pixels) combinations that blending computes
    pixels: int


def traffic(work: Work) -> dict[str, int]:
    """Return the bytes that each stage of a step with L1 and D-SSIM reads and writes, each value once per kernel.

    These are 236 bytes of parameters per Gaussian, 59 parameters with two moments, 64 bytes per record, 20 bytes of
    statistics, nine derivatives of the SSIM per pixel, and so on.
    """
    n, pairs, pixels = work.gaussians, work.pairs, work.pixels
    return {
        "project": (236 + 64 + 28) * n,
        "pairs": 2 * 64 * n + 12 * pairs,
        "sort": 64 * n + 24 * pairs,
        "blend": 64 * pairs + 16 * pixels,
        "loss": LOSS_BYTES * pixels,
        "blend backward": 128 * pairs + 24 * pixels,
        "update": 64 * pairs + (64 + 8 + 20 + 24 * 59) * n,
    }


def floors(work: Work, peaks: Peaks) -> dict[str, float]:
    """Return a lower bound on the time of each stage, in ms, from its operations and from its bytes.

    Blending is counted in vector instructions of 16 lanes (31 per row forward; 80 per row and 60 per pair backward),
    issued at the rate of multiply-adds.
    """
    n, pairs, vector = work.gaussians, work.pairs, 2 * 16  # operations of a multiply-add instruction
    operations = {
        "project": 380 * n,
        "pairs": 80 * pairs,
        "blend": 31 * vector * work.rows,
        "loss": 1250 * work.pixels,
        "blend backward": vector * (80 * work.rows + 60 * pairs),
        "update": (900 + 12 * 59) * n + 9 * pairs,
    }
    return {
        stage: 1e3 * max(operations.get(stage, 0) / (1e9 * peaks.gflops), size / (1e9 * peaks.gbytes))
        for stage, size in traffic(work).items()
    }


SPLAT_Y_MIN, SPLAT_Y_MAX = (int(constants("splat.h")[name]) for name in ("SPLAT_Y_MIN", "SPLAT_Y_MAX"))
STEPS = 5  # without a wait between them
WARM_UP_STEPS = 3  # compile kernels and grow buffers
TINY_RATE = 1e-30  # changes nothing, so that all steps do the same work; a rate of 0 would skip harmonics


@dataclass
class BenchResult:
    """The times of a training step for one scene, in ms."""

    work: Work
    stages: dict[str, float]
    floors: dict[str, float]
    step: float  # wall-clock time, with a wait for the device after each step
    steps: float  # mean time of `STEPS` steps without waits between them, as in a training run
    densify: float
    host: float  # time of the step minus that of the device's stages
    memory: int  # bytes on the device, at peak
    planned: int  # bytes, from the memory plan of training
    launches: int  # kernels in a step
    bytes: int  # bytes that the kernels of a step read and write, see `traffic`


class BenchCase:
    """A scene on which to time training steps with a pipeline's losses, statistics and rendering.

    An exported model has its 3D filter baked into the scales, so the time of that filter is not measured.
    """

    def __init__(
        self, device: Device, parameters: Parameters, photograph: Photograph, background: str, settings: PipelineFile
    ) -> None:
        self.device, self.photograph, optimize = device, photograph, settings.optimize
        self._initial_bytes = device.peak = device.allocated
        gaussians = Gaussians(device, parameters)
        for name in sorted(optimize.tables):
            gaussians.add(name, 1)
        color = device.zeros(3)
        color.fill(1.0 if background == "white" else 0.0)
        model = settings.model.model(gaussians, gaussians.sh_degree)
        rates: dict[str, Any] = dict.fromkeys(PARAMETERS, TINY_RATE)
        motion = MotionRates(**dict.fromkeys(MotionRates.model_fields, TINY_RATE))
        self.trainer = StepTrainer(
            Rasterizer(device, settings.rasterizer.sort),
            model,
            Adam(gaussians),
            SplatStats(gaussians, optimize.statistics),
            color,
            optimize.losses,
            Rates(**rates, motion=motion),
            rows=optimize.update,
        )
        self.step_times: list[float] = []
        self.mean_step_times: list[float] = []
        self.stages: dict[str, list[float]] = defaultdict(list)
        self.densify_times: list[float] = []
        self.frame: Frame | None = None
        self.launches = 0
        for _ in range(WARM_UP_STEPS):
            self.step(record=False)
        self.step(record=False, frozen=PARAMETERS)  # writes gradients to memory, as a step with an edit does
        self.edit()
        self.memory = device.peak - self._initial_bytes

    def step(self, record: bool, frozen: Collection[str] = ()) -> None:
        """Run one training step.  record: whether to record times; frozen: parameters that are not updated."""
        self.device.finish()
        self.device.timings.sampling = record
        start = time.perf_counter()
        view = self.trainer.step(self.photograph, 1, frozen=frozen)
        self.device.finish()
        seconds = time.perf_counter() - start
        self.device.timings.sampling = False
        self.frame = view.frame
        if record:
            self.launches = self.device.timings.launches
            self.step_times.append(1e3 * seconds)
            for name, milliseconds in stage_milliseconds(self.device.timings).items():
                self.stages[name].append(milliseconds)

    def repeat(self) -> None:
        """Run `STEPS` training steps without waiting between them, and record the mean time."""
        self.device.finish()
        start = time.perf_counter()
        for _ in range(STEPS):
            self.trainer.step(self.photograph, 1)
        self.device.finish()
        self.mean_step_times.append(1e3 * (time.perf_counter() - start) / STEPS)

    def edit(self) -> None:
        """Run a density edit that rearranges all tables without changing any Gaussian."""
        self.device.finish()
        start = time.perf_counter()
        edit = Edit(self.trainer.model.gaussians, self.trainer.stats, SceneScale(1.0), step=1, seed=0)
        densify(edit, [PruneLarge(size_above=1e30)], self.trainer.rasterizer.tiler)
        self.device.finish()
        self.densify_times.append(1e3 * (time.perf_counter() - start))

    def result(self, peaks: Peaks) -> BenchResult:
        """Return the medians of all times, and the shortest possible times at the peak rates `peaks`."""
        work = self._measure_work()
        stages = {name: statistics.median(times) for name, times in self.stages.items()}
        step = statistics.median(self.step_times)
        host = step - sum(stages.values())
        steps, densify_ms = statistics.median(self.mean_step_times), statistics.median(self.densify_times[1:])
        memory, launches = (self.memory, self._planned_bytes()), (self.launches, sum(traffic(work).values()))
        return BenchResult(work, stages, floors(work, peaks), step, steps, densify_ms, host, *memory, *launches)

    def _planned_bytes(self) -> int:
        camera = self.photograph.camera
        gaussians = self.trainer.model.gaussians
        sizes = self.photograph.nbytes, camera.stride * camera.rows, self.trainer.stats.pixel_sums
        memory = plan(gaussians.device.info, gaussians.components, *sizes, tile=camera.tile)
        return memory.required_bytes(gaussians.count)

    def _measure_work(self) -> Work:
        assert self.frame is not None
        lists, camera = self.frame.lists, self.frame.camera
        records = self.frame.splats.get().reshape(-1, RECORD)[lists.pair_splat.get()[: lists.pairs]]
        offsets = lists.tile_offset.get()[: camera.tiles + 1]
        tiles = np.empty(lists.pairs, np.int64)
        tiles[lists.tile_pairs.get()[: lists.pairs]] = np.repeat(np.arange(camera.tiles), np.diff(offsets))
        tile_top = tiles // camera.tiles_x * camera.tile + 0.5
        first_row = np.maximum(np.ceil(records[:, SPLAT_Y_MIN] - tile_top), 0)
        last_row = np.minimum(np.floor(records[:, SPLAT_Y_MAX] - tile_top), camera.tile - 1)
        rows = int(np.maximum(last_row - first_row + 1, 0).sum()) * camera.tile // 16
        return Work(self.trainer.model.gaussians.count, lists.pairs, rows, camera.width * camera.height)


def run_bench(cases: dict[str, BenchCase], peaks: Peaks, repeats: int) -> dict[str, BenchResult]:
    """Time each scene `repeats` times, alternating between scenes; return the results by name."""
    for _ in range(repeats):
        for case in cases.values():
            case.step(record=True)
            case.repeat()
    for case in cases.values():
        for _ in range(3):
            case.edit()
    return {name: case.result(peaks) for name, case in cases.items()}


FOCAL = 400.0  # px, focal length of the synthetic scenes
SIZE = 2.2  # px, standard deviation of their splats
SIZES = {"A": (400, 400, 50_000), "B": (800, 800, 300_000), "C": (1920, 1080, 1_000_000)}


def synthetic_scene(width: int, height: int, count: int) -> tuple[Parameters, View]:
    """Return flat Gaussians of about SIZE px that face the camera, with log-normal sizes and random opacities."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-8, width + 8, count), rng.uniform(-8, height + 8, count)
    sizes = SIZE * np.exp(rng.normal(0, 0.5, (count, 2)))
    angle, depth = rng.uniform(0, np.pi, count), rng.uniform(1, 10, count)
    means = np.stack([(u - width / 2) / FOCAL * depth, (v - height / 2) / FOCAL * depth, depth], axis=1)
    scales = np.column_stack([sizes * depth[:, None] / FOCAL, np.full(count, 1e-4)])
    zero = np.zeros(count)
    tables: dict[str, NDArray[Any]] = {
        "means": means,
        "quats": np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=1),
        "log_scales": np.log(scales),
        "logit_opacity": rng.normal(-1, 1.5, (count, 1)),
        "sh_base": (rng.uniform(0, 1, (count, 3)) - 0.5) / SH_C0,
        "sh_rest": rng.normal(0, 0.02, (count, 45)),
    }
    camera = Camera(width, height, FOCAL, FOCAL, width / 2, height / 2)
    parameters = {key: table.astype(np.float32) for key, table in tables.items()}
    return parameters, View("bench", camera, np.eye(4)[:3], Path("bench"))


NEAR = 0.2  # scene units, near plane of the synthetic scenes


def make_case(device: Device, width: int, height: int, count: int, settings: PipelineFile) -> BenchCase:
    """Return a benchmark of a synthetic scene, with noise as its photograph."""
    parameters, view = synthetic_scene(width, height, count)
    camera = upload_camera(device, view)
    shape = (3, height, width)
    pixels = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    return BenchCase(device, parameters, Photograph(camera, device.upload(pixels)), "black", with_near(settings, NEAR))


def load_case(device: Device, model: Path, scene: Path, settings: PipelineFile) -> BenchCase:
    """Return a benchmark of a splat file, or of Gaussians from a point cloud, at the first training view."""
    loaded_scene, background = settings.scene.read(scene)
    photographs = Photographs(device, background)
    parameters = load(model).tables() if detect(model) else from_points(read_points_ply(model), 0.1, 3)
    settings = with_near(settings, near_plane(loaded_scene))
    return BenchCase(device, parameters, photographs.get(loaded_scene.split("train")[0]), background, settings)


def with_near(settings: PipelineFile, near: float) -> PipelineFile:
    """Return settings in which a near plane of `auto` is replaced with `near`, in scene units."""
    model = settings.model.model_copy(update={"near": near})
    return settings.model_copy(update={"model": model}) if settings.model.near == "auto" else settings
