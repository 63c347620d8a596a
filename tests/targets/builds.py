"""Every build of a kernel file that clsplat asks a device for: both schedules, with the options of the code."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from clsplat.core.resources import resource_dir
from clsplat.core.settings import variants
from clsplat.density.statistics import Statistic
from clsplat.opencl.device import BUILD_OPTIONS, flatten, parse_kernels
from clsplat.opencl.discovery import DeviceInfo, FixedSchedule, tuning_macros
from clsplat.render.rasterizer import PIXEL_SUMS

Schedule = Literal["simt", "wide"]
KERNELS = resource_dir("cl_kernels")
GPU = DeviceInfo(
    name="", platform="", kind="GPU", driver="", units=16, memory=2**33, allocation=2**31, local_memory=2**15,
    group=256, float_width=1, index=(0, 0),
)  # fmt: skip
WITH_TILES: dict[Schedule, tuple[FixedSchedule, ...]] = {"simt": ("simt", "simt16"), "wide": ("wide",)}
SCHEDULES: tuple[Schedule, ...] = ("simt", "wide")
SUMS = sorted({kind.pixel_sums for kind in variants(Statistic).values()} - {PIXEL_SUMS})
BOX = {"PIXEL_BOX": 1}
BEHIND = {"GRAD_BEHIND": 1}
COUNT = {"COUNT_TILES": 1}
SLOTS = {"SH_SLOTS": 1}
BLEND: list[dict[str, int]] = [*({"PIXEL_SUMS": n} for n in SUMS), BOX, {**BOX, "PIXEL_SUMS": SUMS[-1]}, BEHIND]
PASSED = {  # what call sites of Device.program add to the tuning; a test holds it against them
    "adam.cl": [BOX, SLOTS],
    "deferred.cl": [SLOTS],
    "large.cl": [BOX, COUNT, {**BOX, **COUNT}],
    "pairs.cl": [COUNT],
    "poses.cl": [BOX, SLOTS],
    "project.cl": [BOX, SLOTS],
    "blend_simt.cl": BLEND,
    "blend_wide.cl": BLEND,
    "gather.cl": [{"PIXEL_SUMS": count} for count in SUMS],
}


@dataclass(frozen=True)
class Build:
    """One .cl file with the values that clsplat passes by -D."""

    path: Path
    schedule: Schedule
    defines: tuple[tuple[str, int | str], ...]  # by name
    variant: str = ""  # what differs from the first build of the file and schedule: 'TILE 16'

    @property
    def options(self) -> list[str]:
        return [*BUILD_OPTIONS, *(f"-D{name}={value}" for name, value in self.defines)]

    @property
    def text(self) -> str:
        return f"{self.path.name} ({', '.join(filter(None, [self.schedule, self.variant]))})"

    @cached_property
    def source(self) -> str:
        return flatten(self.path)

    @cached_property
    def kernels(self) -> list[str]:
        return list(parse_kernels(self.source))


def builds(schedules: Iterable[Schedule] = SCHEDULES, files: Iterable[str] = ("*.cl",)) -> Iterator[Build]:
    """Yield each different build once; values that a file does not read make no difference."""
    for path in sorted({path for pattern in files for path in KERNELS.glob(pattern)}):
        for schedule in schedules:
            if path.stem.startswith("blend_") and not path.stem.endswith(schedule):
                continue
            yield from _of_file(path, schedule)


def _of_file(path: Path, schedule: Schedule) -> Iterator[Build]:
    words = set(re.findall(r"\w+", flatten(path, {KERNELS / "common.h"})))
    first: dict[str, int | str] = {}
    seen: set[tuple[tuple[str, int | str], ...]] = set()
    for with_tile in WITH_TILES[schedule]:
        for passed in [{}, *PASSED.get(path.name, [])]:
            defines = {**tuning_macros(GPU, with_tile), **passed}
            read = {name: value for name, value in sorted(defines.items()) if name in words}
            first = first or read
            if tuple(read.items()) not in seen:
                seen.add(tuple(read.items()))
                variant = ", ".join(f"{name} {value}" for name, value in read.items() if first.get(name) != value)
                yield Build(path, schedule, tuple(sorted(defines.items())), variant)
