"""The memory that training needs on the device, computed before it is allocated.

Bytes are those of the tables for each Gaussian, and those of a frame for each Gaussian, each pair and each pixel.
"""

from dataclasses import dataclass

import numpy as np

from clsplat.errors import MemoryLimitError
from clsplat.gaussians.tables import GROWTH, PARAMETERS, Gaussians
from clsplat.opencl.discovery import DeviceInfo
from clsplat.render.rasterizer import PIXEL_SUMS, RECORD

PAIRS_PER_GAUSSIAN = 5  # (tile, Gaussian) pairs, an estimate; trained scenes have 1.5 to 4
FRAME_GAUSSIAN = 4 * (RECORD + 2 + 5 + 7)  # records, mean2d; keys and radius; sorting by depth
FRAME_PAIR = 4 * (RECORD + 6)  # gradient record; tile and Gaussian of the pair, sorting by tile
FRAME_PIXEL = 4 * (
    4 * 3 + 2 + 9
)  # image, photograph, gradient, second render; transmittance, texture; SSIM's derivatives


@dataclass(frozen=True)
class MemoryPlan:
    """Bytes on the device."""

    gaussian: int  # for each Gaussian, tables and frame
    pair: int
    fixed: int  # photographs and planes of pixels
    largest_table: int  # for each Gaussian, in the largest single buffer
    memory: int  # of the device
    allocation: int  # of a single buffer

    def needed(self, gaussians: int) -> int:
        """Return the bytes for a number of Gaussians, with room to grow and one table being moved."""
        grown = GROWTH * self.gaussian + self.largest_table + PAIRS_PER_GAUSSIAN * self.pair
        return self.fixed + int(gaussians * grown)

    @property
    def limit(self) -> int:
        """The largest number of Gaussians that fits, in all and in single buffers."""
        by_total = (self.memory - self.fixed) / (
            GROWTH * self.gaussian + self.largest_table + PAIRS_PER_GAUSSIAN * self.pair
        )
        by_buffer = self.allocation / max(GROWTH * self.largest_table, PAIRS_PER_GAUSSIAN * 4 * RECORD)
        return max(0, int(min(by_total, by_buffer)))

    def text(self, gaussians: int) -> str:
        """Return one line: the memory needed now, and the number of Gaussians that fit."""
        mib = 2**20
        return (
            f"memory: {self.needed(gaussians) / mib:,.0f} MiB for {gaussians:,} Gaussians ({self.gaussian} bytes each "
            f"and {self.pair} a pair, photographs and planes {self.fixed / mib:,.0f} MiB); {self.limit:,} fit in "
            f"{self.memory / mib:,.0f} MiB with buffers up to {self.allocation / mib:,.0f} MiB"
        )

    def check(self, gaussians: int) -> None:
        """Raise MemoryLimitError when that many Gaussians do not fit."""
        if gaussians > self.limit:
            raise MemoryLimitError(
                f"{self.text(gaussians)}: start from fewer points, use smaller images (scene.downscale) or fewer "
                "of them on the device (scene.image_budget)"
            )


def plan(gaussians: Gaussians, photographs: int, pixels: int, pixel_sums: int = PIXEL_SUMS) -> MemoryPlan:
    """Return the plan for Gaussians with their present tables.

    photographs: their bytes on the device; pixels: of the largest view, whole tiles; pixel_sums: sums over pixels that
    the backward pass computes for each Gaussian.
    """
    info: DeviceInfo = gaussians.device.info
    sizes = [4 * table.components for table in gaussians.tables.values()]
    gradients = sum(4 * gaussians.tables[name].components for name in PARAMETERS) + 8  # for penalties and edits
    gaussian = int(np.sum(sizes)) + FRAME_GAUSSIAN + 4 * pixel_sums + gradients
    fixed = photographs + FRAME_PIXEL * pixels
    return MemoryPlan(gaussian, FRAME_PAIR, fixed, max(sizes), info.memory, info.allocation)
