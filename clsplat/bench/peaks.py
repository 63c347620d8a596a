"""Peak rates of a device, from which the floors of stages are computed."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from clsplat.opencl.device import Device

LEAST = 2e-3  # s of a measurement: the first launch and the wait for the last take some 0.02 ms of it


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
    is_cpu = device.info.kind == "CPU"
    items = 64 * group * max(1, device.info.units // (8 if is_cpu else 2))  # a unit of a GPU runs some 2048 at once
    result = device.empty(items * lanes)

    def spent(launch: Callable[[], None], times: int) -> float:
        device.finish()
        start = time.perf_counter()
        for _ in range(times):
            launch()
        device.finish()
        return time.perf_counter() - start

    def seconds(launch: Callable[[], None]) -> float:
        times = 1
        spent(launch, times)  # builds it
        while (taken := spent(launch, times)) < LEAST:
            times *= 4
        return min([taken, *(spent(launch, times) for _ in range(repeats - 1))]) / times

    piece, whole = max(lanes, 4), program.peak_copy.group[0]  # floats that an item copies, and items of a group
    rounds = 40_000 if is_cpu else 4000  # long enough for the system to spread the threads
    fma = seconds(lambda: program.peak_fma(items=items, result=result, factor=0.5, rounds=rounds))
    exp = seconds(lambda: program.peak_exp(items=items, result=result, step=1e-3, rounds=rounds))
    length = min(64 << 20, device.info.allocation // 16 // 4) // (piece * whole) * (piece * whole)  # floats
    source, copied = device.zeros(length), device.zeros(length)
    copy = seconds(lambda: program.peak_copy(items=length // piece, values=source, copied=copied))
    work = items * lanes * rounds
    return Peaks(16 * work / fma / 1e9, 2 * work / exp / 1e9, 8 * length / copy / 1e9)
