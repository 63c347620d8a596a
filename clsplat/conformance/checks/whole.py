"""Check a short training run, and the memory and speed of a device."""

import time
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.bench.cases import Peaks, make_case, measure_peaks, run_bench
from clsplat.conformance.check import Checks, Deviation, Note, Results, compare_max, match
from clsplat.conformance.scenes import Case, random_case
from clsplat.core.errors import MemoryLimitError
from clsplat.core.machine import available_memory
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.losses.image import L1, Dssim
from clsplat.methods.adc import Clone, PruneFaint, SplitLarge
from clsplat.opencl.device import Array, Device
from clsplat.photos.photographs import Photograph
from clsplat.pipeline.loading import load
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates
from clsplat.training.trainer import StepTrainer

CHECKS = Checks()
SPEED = Checks()  # run once per device, not for each schedule
STEPS = 60
MAX_TRAINING_S = 40.0  # time after which a slow device stops early
MEMORY_FRACTION = 0.25  # of free memory to use, since device and host may share it and must not swap
FIRST_BUFFER = 128 << 20  # bytes
MAX_WRITE_S = 4.0  # longest time to write a buffer
DEVICE_IN_USE = "other programs may use the device's memory; close them and run `clsplat doctor` again"
BENCH_SIZE = (256, 256, 20_000)  # width, height, Gaussians


def _render_photograph(device: Device, case: Case) -> Photograph:
    """Render a scene on the device and return the 8-bit image as a photograph."""
    camera = case.device_camera(device)
    frame = Rasterizer(device, "radix").forward(case.model(device), camera, device.zeros(3))
    image = frame.image.get()[:, : camera.height, : camera.width]
    return Photograph(camera, device.upload(np.clip(255 * image + 0.5, 0, 255).astype(np.uint8)))


def train(
    device: Device, case: Case, start: dict[str, NDArray[Any]], steps: int
) -> tuple[list[float], dict[str, NDArray[Any]]]:
    """Train Gaussians from `start` on a render of a scene, with one density edit.  Return the losses and tables."""
    photograph = _render_photograph(device, case)
    model = Case(start, case.view).model(device)
    gaussians, rasterizer = model.gaussians, Rasterizer(device, "radix")
    adam, stats = Adam(gaussians), SplatStats(gaussians)
    losses = [L1(weight=0.8), Dssim(weight=0.2)]
    trainer = StepTrainer(rasterizer, model, adam, stats, device.zeros(3), losses, Rates(sh_base=0.03))
    loss_values: list[float] = []
    start_time = time.monotonic()
    for step in range(1, steps + 1):
        loss_values.append(trainer.step(photograph, step).loss)
        if step == STEPS // 2:
            edit = Edit(gaussians, stats, SceneScale(4.0), step, seed=0)
            densify(edit, [Clone(gradient_above=1e-3), SplitLarge(gradient_above=1e-3), PruneFaint()], rasterizer.tiler)
        if time.monotonic() - start_time > MAX_TRAINING_S and len(loss_values) < steps:
            break
    return loss_values, {name: gaussians.get(name) for name in gaussians.tables}


@CHECKS.add()
def training(device: Device, rng: np.random.Generator) -> Results:
    case = random_case(rng, 120, 48, 40)
    start = {name: table.copy() for name, table in case.parameters.items()}
    start["means"] += rng.normal(0, 0.05, start["means"].shape).astype(np.float32)
    start["sh_base"] *= 0  # gray
    losses, tables = train(device, case, start, STEPS)
    losses2, tables2 = train(device, case, start, len(losses))
    count, label = len(tables["means"]), f"{len(losses)} steps"
    yield Note("training", {"steps": len(losses), "losses": [losses[0], losses[-1]], "gaussians": count})
    yield match("training", f"losses of {label}, a second time", np.array(losses2), np.array(losses[: len(losses2)]))
    for name, table in tables.items():
        if table.shape != tables2[name].shape:
            difference, row_label = abs(len(tables2[name]) - count), f"rows of {name} after {label}, a second time"
            yield Deviation("training", row_label, difference, 0, counts=True)
        else:
            bits = tables2[name].view(np.uint32), table.view(np.uint32)
            yield match("training", f"{name} after {label}, a second time", *bits)
    nonfinite_count = sum(int(np.count_nonzero(~np.isfinite(table))) for table in tables.values())
    yield Deviation("training", f"values that are not finite after {label}", nonfinite_count, 0, counts=True)
    if len(losses) == STEPS:
        yield Deviation("training", f"the loss after {label}, relative to the first loss", losses[-1] / losses[0], 0.7)


@SPEED.add()
def memory(device: Device, rng: np.random.Generator) -> Results:
    """Allocate buffers of growing size, up to the largest that the device allows; write each and read samples.

    A failed allocation is not a failure of the check: other programs may use the memory, and OpenCL does not report
    how much of it is free.
    """
    max_allocation, free_memory = device.info.allocation, available_memory()
    budget = int(MEMORY_FRACTION * min(device.info.memory, device.info.memory if free_memory is None else free_memory))
    limit = min(max_allocation, budget) // 64 * 64  # allocations are rounded up to 64
    tested_size, size = 0, min(FIRST_BUFFER, limit)
    end_reason = "more was not tried, because too little memory is free"
    while size > tested_size:
        start = time.perf_counter()
        try:
            yield from _check_buffer(device, size)
        except MemoryLimitError:
            end_reason = f"a buffer of {size / 2**20:,.0f} MiB cannot be allocated: {DEVICE_IN_USE}"
            break
        tested_size, size = size, min(2 * size, limit)
        if 2 * (time.perf_counter() - start) > MAX_WRITE_S and size > tested_size:
            end_reason = "more was not tried, because it would take too long"
            break
    if tested_size == max_allocation // 64 * 64:
        end_reason = "the largest size works"
    yield Note("memory", {"promised": max_allocation, "held": tested_size, "free": free_memory, "stopped": end_reason})


def _check_buffer(device: Device, size: int) -> Results:
    buffer = device.empty(size // 4)
    buffer.fill(1.5)
    Array(device, buffer.buffer, (16,), np.dtype(np.float32)).fill(2.5)  # must not appear at the other end
    indices = [*range(0, size // 4, max(1, size // 4 // 64)), size // 4 - 1]
    actual = np.array([buffer.get_item(i) for i in indices])
    expected = np.where(np.arange(len(actual)) == 0, 2.5, 1.5)
    yield match("fill_words", f"samples of a buffer of {size / 2**20:,.0f} MiB", actual, expected)


@SPEED.add("peak_fma", "peak_exp", "peak_copy")
def yardsticks(device: Device, rng: np.random.Generator) -> Results:
    lanes, group = (int(device.tuning[name]) for name in ("LANES", "GROUP"))
    program, item_count = device.program("peak.cl"), 2 * group
    result = device.empty(item_count * lanes)
    program.peak_fma(items=item_count, result=result, factor=0.5, rounds=5)
    chains = np.arange(item_count)[:, None] + np.arange(8.0)
    for _ in range(5):
        chains = chains * 0.5 + 0.25
    expected = np.repeat(chains.sum(axis=1), lanes)
    yield compare_max("peak_fma", "chains of multiply-adds", result.get(), expected, 1e-6)
    program.peak_exp(items=item_count, result=result, step=1e-3, rounds=4)
    x = -0.01 * (np.arange(item_count) % 8)
    sums = sum(np.exp(x - 1e-3 * k) + np.exp(x - 0.5 - 1e-3 * k) for k in range(4))
    yield compare_max("peak_exp", "sums of exponentials", result.get(), np.repeat(sums, lanes), 1e-5)
    items = 2 * program.peak_copy.group[0]
    values = rng.normal(size=items * max(lanes, 4)).astype(np.float32)
    dst = device.zeros(len(values))
    program.peak_copy(items=items, values=device.upload(values), copied=dst)
    yield match("peak_copy", "copied values", dst.get(), values)


@SPEED.add()
def speed(device: Device, rng: np.random.Generator) -> Results:
    peaks = measure_peaks(device, repeats=2)
    bench = make_case(device, *BENCH_SIZE, load("splat").settings)
    result = run_bench({"": bench}, Peaks(**asdict(peaks)), repeats=5)[""]
    yield Note("speed", {"scene": BENCH_SIZE, "peaks": asdict(peaks), **asdict(result)})
