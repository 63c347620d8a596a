"""Whole training steps of several scenes in turns, so that a slow moment of the machine affects all; medians count."""

import statistics
import time
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from clsplat.bench.floors import Work, floors
from clsplat.bench.peaks import Peaks
from clsplat.density.basic import PruneLarge
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import Parameters
from clsplat.gaussians.tables import PARAMETERS, Gaussians
from clsplat.opencl.device import Device
from clsplat.opencl.program import constants
from clsplat.pipeline.file import PipelineFile
from clsplat.render.rasterizer import RECORD, Frame, Rasterizer
from clsplat.training.adam import Adam, Rates
from clsplat.training.memory import plan
from clsplat.training.motion import MotionRates
from clsplat.training.profile import stage_milliseconds
from clsplat.training.trainer import Trainer
from clsplat.views.photographs import Photograph

SPLAT_Y_MIN, SPLAT_Y_MAX = (int(constants("splat.h")[name]) for name in ("SPLAT_Y_MIN", "SPLAT_Y_MAX"))
WARM_UP_STEPS = 3  # compile kernels and grow buffers
LEAST_RATE = 1e-30  # changes nothing, so that every step does the same work; at a rate of 0 harmonics have no update


@dataclass
class Result:
    """One scene's figures, in milliseconds."""

    work: Work
    stages: dict[str, float]
    floors: dict[str, float]
    step: float  # on the clock
    densify: float
    host: float  # time of the step minus that of the device's stages
    memory: int  # bytes on the device, the peak
    planned: int  # bytes, from the memory plan of training


class Case:
    """One scene for training steps with a pipeline's losses, statistics and rendering.

    An exported model has the world filter in its scales, so the filter takes no time here.
    """

    def __init__(
        self, device: Device, parameters: Parameters, photograph: Photograph, background: str, settings: PipelineFile
    ) -> None:
        self.device, self.photograph, optimize = device, photograph, settings.optimize
        self._before = device.peak = device.allocated
        gaussians = Gaussians(device, parameters)
        for name in sorted(optimize.tables):
            gaussians.add(name, 1)
        colour = device.zeros(3)
        colour.fill(1.0 if background == "white" else 0.0)
        model = settings.model.model(gaussians, gaussians.sh_degree)
        least: dict[str, Any] = dict.fromkeys(PARAMETERS, LEAST_RATE)
        motion = MotionRates(**dict.fromkeys(MotionRates.model_fields, LEAST_RATE))
        self.trainer = Trainer(
            Rasterizer(device, "radix"),
            model,
            Adam(gaussians),
            SplatStats(gaussians, optimize.statistics),
            colour,
            optimize.losses,
            Rates(**least, motion=motion),
            rows=optimize.update,
        )
        self.clock: list[float] = []
        self.stages: dict[str, list[float]] = defaultdict(list)
        self.densify: list[float] = []
        self.frame: Frame | None = None
        for _ in range(WARM_UP_STEPS):
            self.step(record=False)
        self.step(record=False, stale=PARAMETERS)  # as at a step with an edit: gradients are written to memory
        self.edit()
        self.memory = device.peak - self._before

    def step(self, record: bool, stale: Collection[str] = ()) -> None:
        """Do one training step; `record` keeps its times, parameters in `stale` are not updated."""
        self.device.finish()
        self.device.timings.sampling = record
        start = time.perf_counter()
        view = self.trainer.step(self.photograph, 1, stale=stale)
        self.device.finish()
        seconds = time.perf_counter() - start
        self.device.timings.sampling = False
        self.frame = view.frame
        if record:
            self.clock.append(1e3 * seconds)
            for name, milliseconds in stage_milliseconds(self.device.timings).items():
                self.stages[name].append(milliseconds)

    def edit(self) -> None:
        """Do one density edit that moves every table and changes nothing."""
        self.device.finish()
        start = time.perf_counter()
        edit = Edit(self.trainer.model.gaussians, self.trainer.stats, SceneScale(1.0), step=1, seed=0)
        densify(edit, [PruneLarge(size_above=1e30)], self.trainer.rasterizer.tiler)
        self.device.finish()
        self.densify.append(1e3 * (time.perf_counter() - start))

    def result(self, peaks: Peaks) -> Result:
        """Return the medians of all times, with the floors for `peaks`."""
        work = self._work()
        stages = {name: statistics.median(times) for name, times in self.stages.items()}
        clock = statistics.median(self.clock)
        host = clock - sum(stages.values())
        densify_ms, planned = statistics.median(self.densify[1:]), self._planned()
        return Result(work, stages, floors(work, peaks), clock, densify_ms, host, self.memory, planned)

    def _planned(self) -> int:
        camera = self.photograph.camera
        gaussians = self.trainer.model.gaussians
        pixels, pixel_sums = camera.stride * camera.rows, self.trainer.stats.pixel_sums
        info, components = gaussians.device.info, gaussians.components
        return plan(info, components, self.photograph.nbytes, pixels, pixel_sums).needed(gaussians.count)

    def _work(self) -> Work:
        assert self.frame is not None
        lists, camera = self.frame.lists, self.frame.camera
        records = self.frame.splats.get().reshape(-1, RECORD)[lists.pair_splat.get()[: lists.pairs]]
        offsets = lists.tile_offset.get()[: camera.tiles + 1]
        tiles = np.empty(lists.pairs, np.int64)
        tiles[lists.tile_pairs.get()[: lists.pairs]] = np.repeat(np.arange(camera.tiles), np.diff(offsets))
        top = tiles // camera.tiles_x * camera.tile + 0.5
        first = np.maximum(np.ceil(records[:, SPLAT_Y_MIN] - top), 0)
        last = np.minimum(np.floor(records[:, SPLAT_Y_MAX] - top), camera.tile - 1)
        rows = int(np.maximum(last - first + 1, 0).sum()) * camera.tile // 16
        return Work(self.trainer.model.gaussians.count, lists.pairs, rows, camera.width * camera.height)


def run_bench(cases: dict[str, Case], peaks: Peaks, repeats: int) -> dict[str, Result]:
    """Time every scene `repeats` times, one scene after the other; return the results by name."""
    for _ in range(repeats):
        for case in cases.values():
            case.step(record=True)
    for case in cases.values():
        for _ in range(3):
            case.edit()
    return {name: case.result(peaks) for name, case in cases.items()}
