"""Measure the host's part of a training step of `clsplat bench`: `python -m tests.support.host_time SCHEDULE [SORT]`.

Kernels, copies to the host, and the functions that set arguments are replaced by functions that do nothing, so that
scenes of any size are measured in seconds; times are CPU time of one thread.  A line counts what a step enqueues.
"""

import sys
import time
from collections import Counter
from statistics import median
from typing import Any

import numpy as np

from clsplat.conformance.bench.cases import SIZES, BenchCase, synthetic_scene, with_near
from clsplat.opencl import device as device_module
from clsplat.opencl.device import Array, Device, cl  # type: ignore[attr-defined]
from clsplat.photos.photographs import Photograph
from clsplat.pipeline.loading import load
from clsplat.render.camera import upload_camera

PAIRS = {"T": 3000, "A": 150_643, "B": 980_000, "C": 3_000_000}  # about as many as the scenes have
ROUNDS, STEPS = 15, 20


class Unlaunched(BenchCase):
    """A bench case whose kernels never run."""

    def step(self, *arguments: Any, **others: Any) -> None:
        """Leave out the warm-up."""

    def edit(self) -> None:
        """Leave out the edit, which reads counts from the device."""


def measure(device: Device, name: str, sort: str) -> str:
    """Return the least and the median milliseconds of a step, and its commands."""
    counts: Counter[str] = Counter()

    def counting(command: str, value: Any = None) -> Any:
        return lambda *_, **__: counts.update([command]) or value

    settings = with_near(load("splat", [f"rasterizer.sort={sort}"]).settings, 0.2)
    width, height, count = {**SIZES, "T": (64, 64, 1000)}[name]
    cl.enqueue_nd_range_kernel = lambda *_: None
    parameters, view = synthetic_scene(width, height, count)
    pixels = np.zeros((3, height, width), np.uint8)
    photographs = [Photograph(upload_camera(device, view), device.upload(pixels)) for _ in range(2)]
    Array.get_item_later = lambda *_: lambda: PAIRS[name]  # type: ignore[method-assign]
    trainer = Unlaunched(device, parameters, photographs[0], "black", settings).trainer
    set_args, set_arg, empty = cl.Kernel.set_args, cl.Kernel.set_arg, Device.empty
    try:
        cl.Kernel.set_args = cl.Kernel.set_arg = lambda *_: None
        times = []
        for first in range(1, ROUNDS * STEPS, STEPS):
            start = time.thread_time()
            for step in range(first, first + STEPS):
                trainer.step(photographs[step % 2], step)
            times.append(1e3 * (time.thread_time() - start) / STEPS)
        cl.enqueue_nd_range_kernel = counting("launches")
        cl.Kernel.set_args, cl.Kernel.set_arg = counting("set_args"), counting("set_arg")
        Array.get_item_later = counting("reads", lambda: PAIRS[name])  # type: ignore[method-assign]
        Device.empty = counting("allocations")  # type: ignore[method-assign]
        trainer.step(photographs[0], ROUNDS * STEPS + 2)
    finally:
        cl.Kernel.set_args, cl.Kernel.set_arg = set_args, set_arg
        Device.empty = empty  # type: ignore[method-assign]
    return f"{name}: {min(times[1:]):.3f} ms, median {median(times[1:]):.3f}; {dict(counts)}"


if __name__ == "__main__":
    assert device_module.cl is cl
    for scene in PAIRS:
        print(measure(Device(None, sys.argv[1]), scene, "".join(sys.argv[2:]) or "auto"), flush=True)  # type: ignore[arg-type]
