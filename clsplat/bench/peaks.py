"""Peak rates of a device, from which the floors of stages are computed."""

import time
from dataclasses import dataclass
from typing import Any

from clsplat.opencl.device import Device


@dataclass(frozen=True)
class Peaks:
    """Peak rates of the device."""

    gflops: float  # multiply-adds count as two
    gexp: float  # 10⁹ exponentials per second
    gbytes: float  # 10⁹ bytes per second, read plus written, arrays larger than caches


def measure_peaks(device: Device, repeats: int = 5) -> Peaks:
    """Measure the rates of multiply-adds, exponentials and copies: the best of `repeats`."""
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

    rounds = 40_000 if device.info.kind == "CPU" else 1000  # long enough for the system to spread the threads
    fma = seconds(lambda: program.peak_fma(items=items, result=result, factor=0.5, rounds=rounds))
    exp = seconds(lambda: program.peak_exp(items=items, result=result, step=1e-3, rounds=rounds))
    length = min(64 << 20, device.info.allocation // 16 // 4) // (group * lanes) * (group * lanes)  # floats
    source, copied = device.zeros(length), device.zeros(length)
    copy = seconds(lambda: program.peak_copy(items=length // lanes, values=source, copied=copied))
    work = items * lanes * rounds
    return Peaks(16 * work / fma / 1e9, 2 * work / exp / 1e9, 8 * length / copy / 1e9)
