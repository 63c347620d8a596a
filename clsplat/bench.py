"""`clsplat bench`: the stages of a training step on fixed scenes, beside what the device can do at best.

Peaks are measured in the same run.  A stage's floor is the larger of its arithmetic by the multiply-add peak and of its
bytes by the copy bandwidth; the counts are those of the algorithm, not of the code, so a ratio of 1 is out of reach and
2 is good.  Scenes take turns, so that a slow moment of the machine meets all of them; figures are medians.
"""

import statistics
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.model import SH_C0, Gaussians, Model
from clsplat.gaussians.ply import Parameters, read_ply
from clsplat.opencl.device import Device
from clsplat.render.renderer import RECORD, Frame, Renderer
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Camera, View
from clsplat.training.adam import Adam, Rates
from clsplat.training.density import Measures, PruneLarge, densify
from clsplat.training.losses import L1, Dssim
from clsplat.training.profile import stage_milliseconds
from clsplat.training.statistics import SplatStats
from clsplat.training.step import differentiate
from clsplat.training.targets import Target, Targets

FOCAL = 400.0  # px, of the synthetic scenes
SIZES = {"A": (400, 400, 50_000), "B": (800, 800, 300_000), "C": (1920, 1080, 1_000_000)}
WARM_UP = 3  # steps: kernels are compiled and buffers grown


@dataclass(frozen=True)
class Peaks:
    """Yardsticks of the device."""

    gflops: float  # multiply-adds count as two
    gexp: float  # 10⁹ exponentials per second
    gbytes: float  # 10⁹ bytes per second, read plus written, arrays larger than caches


@dataclass(frozen=True)
class Work:
    """What one step has to do."""

    gaussians: int
    pairs: int
    rows: int  # (pair, pixel row) combinations: what blending walks, 16 pixels each
    pixels: int


@dataclass
class Result:
    """One scene's figures, in milliseconds."""

    work: Work
    stages: dict[str, float]
    floors: dict[str, float]
    step: float  # on the clock
    densify: float
    host: float  # of the step, beyond the device's own time


class Contestant:
    """One scene, ready to be stepped."""

    def __init__(self, device: Device, parameters: Parameters, target: Target, background: str) -> None:
        self.device, self.target = device, target
        self.renderer = Renderer(device, "radix")
        gaussians = Gaussians(device, parameters)
        self.model = Model(gaussians, gaussians.sh_degree)
        self.adam, self.stats = Adam(gaussians), SplatStats(gaussians)
        self.background = device.zeros(3)
        self.background.fill(1.0 if background == "white" else 0.0)
        self.losses = (L1(weight=0.8), Dssim(weight=0.2))
        self.rates = dict.fromkeys(Rates().at(1, 1.0), 0.0)  # nothing moves: every step does the same work
        self.clock: list[float] = []
        self.stages: dict[str, list[float]] = defaultdict(list)
        self.densify: list[float] = []
        self.frame: Frame | None = None

    def step(self, record: bool) -> None:
        """One training step; `record` keeps its times."""
        self.device.finish()
        self.device.timings.sampling = record
        start = time.perf_counter()
        view = differentiate(self.renderer, self.model, self.target, self.background, self.losses)
        self.stats.add(view, self.adam.update(self.model, view.frame, view.moments, self.rates))
        self.device.finish()
        seconds = time.perf_counter() - start
        self.device.timings.sampling = False
        self.frame = view.frame
        if record:
            self.clock.append(1e3 * seconds)
            for name, milliseconds in stage_milliseconds(self.device.timings).items():
                self.stages[name].append(milliseconds)

    def edit(self) -> None:
        """One density edit that moves every table and changes nothing."""
        self.device.finish()
        start = time.perf_counter()
        never = [PruneLarge(size_above=1e30)]
        densify(self.model.gaussians, self.stats, list(never), self.renderer.tiler, Measures(1.0), 1, 0)
        self.device.finish()
        self.densify.append(1e3 * (time.perf_counter() - start))

    def result(self, peaks: Peaks) -> Result:
        work = self._work()
        stages = {name: statistics.median(times) for name, times in self.stages.items()}
        clock = statistics.median(self.clock)
        host = clock - sum(stages.values())
        return Result(work, stages, floors(work, peaks), clock, statistics.median(self.densify), host)

    def _work(self) -> Work:
        assert self.frame is not None
        lists, camera = self.frame.lists, self.frame.camera
        records = self.frame.splats.get().reshape(-1, RECORD)[lists.pair_splat.get()[: lists.pairs]]
        offsets = lists.tile_offset.get()[: camera.tiles + 1]
        tiles = np.empty(lists.pairs, np.int64)
        tiles[lists.tile_pairs.get()[: lists.pairs]] = np.repeat(np.arange(camera.tiles), np.diff(offsets))
        top = tiles // camera.tiles_x * camera.tile + 0.5
        first = np.maximum(np.ceil(records[:, 9] - top), 0)
        last = np.minimum(np.floor(records[:, 10] - top), camera.tile - 1)
        rows = int(np.maximum(last - first + 1, 0).sum()) * camera.tile // 16
        return Work(self.model.gaussians.count, lists.pairs, rows, camera.width * camera.height)


def floors(work: Work, peaks: Peaks) -> dict[str, float]:
    """Least milliseconds of each stage.

    Blending is counted in vector instructions of 16 lanes (31 a row forward; 80 a row and 60 a pair backward), which
    issue at the rate of multiply-adds; the other stages in operations and bytes (473 operations and 236 bytes of
    parameters a Gaussian, 59 parameters with gradient and two moments, 64 bytes a record, …).
    """
    n, pairs, pixels = work.gaussians, work.pairs, work.pixels

    def floor(operations: float, moved: float) -> float:
        return 1e3 * max(operations / (1e9 * peaks.gflops), moved / (1e9 * peaks.gbytes))

    vector = 2 * 16  # operations that an instruction could have been
    return {
        "project": floor(380 * n, (236 + 64 + 8) * n),
        "pairs": floor(80 * pairs, 2 * 64 * n + 12 * pairs),
        "sort": floor(0, 64 * n + 24 * pairs),
        "blend": floor(31 * vector * work.rows, 64 * pairs),
        "loss": floor(1250 * pixels, 60 * pixels),
        "blend backward": floor(vector * (80 * work.rows + 60 * pairs), 128 * pairs),
        "sum records": floor(9 * pairs, 64 * pairs + 36 * n),
        "update": floor((900 + 12 * 59) * n, (64 + 36 + 8 + 24 * 59) * n),
        "statistics": floor(0, 20 * n),
    }


def measure_peaks(device: Device, repeats: int = 5) -> Peaks:
    """Multiply-add rate, exponential rate and copy bandwidth: the best of `repeats`."""
    program, lanes = device.program("peak.cl"), int(device.tuning["LANES"])
    group = int(device.tuning["GROUP"])
    items = 64 * group * max(1, device.info.units // 8)
    result = device.empty(items * lanes)

    def seconds(launch: Any) -> float:
        best = float("inf")
        for _ in range(repeats + 1):
            device.finish()
            start = time.perf_counter()
            launch()
            device.finish()
            best = min(best, time.perf_counter() - start)
        return best

    rounds = 4000 if device.info.kind == "CPU" else 1000
    fma = seconds(lambda: program.peak_fma(items=items, result=result, factor=0.5, rounds=rounds))
    exp = seconds(lambda: program.peak_exp(items=items, result=result, step=1e-3, rounds=rounds))
    length = min(64 << 20, device.info.allocation // 16 // 4) // (group * lanes) * (group * lanes)  # floats
    source, copied = device.zeros(length), device.zeros(length)
    copy = seconds(lambda: program.peak_copy(items=length // lanes, values=source, copied=copied))
    work = items * lanes * rounds
    return Peaks(16 * work / fma / 1e9, 2 * work / exp / 1e9, 8 * length / copy / 1e9)


def synthetic(name: str) -> tuple[Parameters, View]:
    """Scene A, B or C: flat Gaussians facing the camera, about 2.2 px large, log-normal sizes, random opacities."""
    width, height, count = SIZES[name]
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-8, width + 8, count), rng.uniform(-8, height + 8, count)
    sizes = 2.2 * np.exp(rng.normal(0, 0.5, (count, 2)))
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
    return parameters, View(name, camera, np.eye(4)[:3], Path(name))


def contestant(device: Device, name: str) -> Contestant:
    """Open scene A, B or C with a noise image for its photograph."""
    parameters, view = synthetic(name)
    targets = Targets(device, "black")
    shape = (3, view.camera.height, view.camera.width)
    pixels = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    return Contestant(device, parameters, Target(targets.camera(view), device.upload(pixels)), "black")


def real_contestant(device: Device, model: Path, scene: Path) -> Contestant:
    """Open a model file at the first training view of a scene."""
    opened = read_scene(scene)
    targets = Targets(device, opened.background)
    return Contestant(device, read_ply(model).parameters, targets.get(opened.split("train")[0]), opened.background)


def run_bench(contestants: dict[str, Contestant], peaks: Peaks, repeats: int) -> dict[str, Result]:
    """Step every scene `repeats` times, in turns."""
    for contender in contestants.values():
        for _ in range(WARM_UP):
            contender.step(record=False)
    for _ in range(repeats):
        for contender in contestants.values():
            contender.step(record=True)
    for contender in contestants.values():
        for _ in range(3):
            contender.edit()
    return {name: contender.result(peaks) for name, contender in contestants.items()}


def table(name: str, result: Result, earlier: dict[str, Any] | None) -> str:
    """One scene as text; `earlier` is the same scene of an earlier run's JSON."""
    work = result.work
    lines = [
        f"scene {name}: {work.gaussians:,} Gaussians, {work.pairs:,} pairs, {work.rows:,} rows, {work.pixels:,} pixels",
        f"  {'stage':<18}{'ms':>9}{'floor':>9}{'ratio':>8}" + ("     was     now/was" if earlier else ""),
    ]
    rows = [(stage, ms, result.floors.get(stage)) for stage, ms in result.stages.items()]
    rows += [
        ("host", result.host, None),
        ("step", result.step, sum(result.floors.values())),
        ("densify", result.densify, None),
    ]
    was = {**earlier["stages"], **{key: earlier[key] for key in ("host", "step", "densify")}} if earlier else {}
    for stage, ms, floor in rows:
        ratio = f"{floor:9.2f}{ms / floor:8.2f}" if floor else " " * 17
        compared = f"{was[stage]:9.2f}{ms / was[stage]:11.2f}" if stage in was and was[stage] > 0 else ""
        lines.append(f"  {stage:<18}{ms:9.2f}{ratio}{compared}")
    return "\n".join(lines)
