"""The memory that training needs on the device, computed before it is allocated.

Bytes are those of the tables for each Gaussian, and those of a frame for each Gaussian, each pair and each pixel.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from clsplat.core.errors import MemoryLimitError
from clsplat.formats.splats import MOTION, PARAMETERS, sh_coefficients
from clsplat.gaussians.gaussians import ALIGNMENT, GROWTH
from clsplat.gaussians.structs import HARMONICS, moment_tables
from clsplat.render.rasterizer import PIXEL_SUMS, RECORD
from clsplat.scene.view import View

SEEN_SHARE = 0.5  # of the Gaussians, in one view, an estimate; their harmonics come to the device
PAIRS_PER_GAUSSIAN = 5  # (tile, Gaussian) pairs, an estimate; trained scenes have 1.5 to 4
FRAME_GAUSSIAN = 4 * (RECORD + 2 + 5 + 7)  # records, mean2d; keys and radius; sorting by depth
MOVED = 4 * (3 + 4 + 1)  # means, quaternions and logits of a moment
FRAME_PAIR = 4 * (RECORD + 6)  # gradient record; tile and Gaussian of the pair, sorting by tile
FRAME_PIXEL = 4 * (4 * 3 + 3 + 9 + 4 + 2)
# image, photograph, gradient, second render; transmittance, texture, mask; SSIM's derivatives; the sums of a blur; the
# entropy of weights and its gradient

Where = Literal["device", "host"]
Harmonics = Literal["auto", "device", "host"]  # memory of those above band 0; auto: the host where the device is full


@dataclass(frozen=True)
class MemoryPlan:
    """Bytes on the device."""

    gaussian: int  # for each Gaussian, tables and frame
    pair: int
    fixed: int  # photographs and planes of pixels
    largest_table: int  # for each Gaussian, in the largest single buffer
    memory: int  # of the device
    allocation: int  # of a single buffer
    host: int = 0  # for each Gaussian, in the memory of the host

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
        by_table = self.allocation // self.largest_table // ALIGNMENT * ALIGNMENT
        by_pairs = self.allocation / (PAIRS_PER_GAUSSIAN * 4 * RECORD)
        return max(0, int(min(by_total, by_table, by_pairs)))

    def text(self, gaussians: int) -> str:
        """Return one line: the memory needed now, and the number of Gaussians that fit."""
        mib = 2**20
        on_host = f"; harmonics on the host, in {gaussians * self.host / mib:,.0f} MiB of it" if self.host else ""
        return (
            f"memory: {self.needed(gaussians) / mib:,.0f} MiB for {gaussians:,} Gaussians ({self.gaussian} bytes each "
            f"and {self.pair} a pair, photographs and planes {self.fixed / mib:,.0f} MiB); {self.limit:,} fit in "
            f"{self.memory / mib:,.0f} MiB with buffers up to {self.allocation / mib:,.0f} MiB{on_host}"
        )

    def check(self, gaussians: int, more: str = "") -> None:
        """Raise MemoryLimitError when that many Gaussians do not fit.  more: what else helps, behind the others."""
        if gaussians > self.limit:
            raise MemoryLimitError(
                f"{self.text(gaussians)}: start from fewer points, use smaller images (scene.downscale) or fewer "
                f"of them on the device (scene.image_budget){more}"
            )


class DeviceLimits(Protocol):
    """What a device holds."""

    @property
    def memory(self) -> int:
        """Bytes in all."""

    @property
    def allocation(self) -> int:
        """Bytes of a single buffer."""

    @property
    def unified(self) -> bool:
        """Whether it is the host's memory."""


def last_place(harmonics: Harmonics, limits: DeviceLimits) -> Where:
    """Return where harmonics may lie at last.  A device whose memory is the host's has nothing to move them to."""
    return "host" if harmonics == "host" or (harmonics == "auto" and not limits.unified) else "device"


def most_pixels(views: Sequence[View], tile: int) -> int:
    """Return the pixels of the largest view, whole tiles of so many px."""
    return max(-(-view.camera.width // tile) * -(-view.camera.height // tile) * tile**2 for view in views)


def bytes_of_modules(stages: Iterable[Any], views: Sequence[View], tile: int) -> int:
    """Return what the modules of trainings take on the device, of the one that takes most."""
    lists = [getattr(stage, "modules", ()) for stage in stages]
    return max((sum(one.device_bytes(views, tile) for one in modules) for modules in lists), default=0)


def first_tables(degree: int, motion: int = 0) -> dict[str, int]:
    """Return the components of the tables that training has at least, by name: parameters and their moments.

    motion: the columns of the motion; 0 where nothing moves.
    """
    widths = (3, 4, 3, 1, 3, 3 * (sh_coefficients(degree) - 1))
    parameters = dict(zip(PARAMETERS, widths, strict=True)) | ({MOTION: motion} if motion else {})
    return parameters | {table: width for name, width in parameters.items() for table in moment_tables(name)}


def plan(
    limits: DeviceLimits,
    components: Mapping[str, int],
    photographs: int,
    pixels: int,
    pixel_sums: int = PIXEL_SUMS,
    harmonics: Where = "device",
    seen: float = SEEN_SHARE,
) -> MemoryPlan:
    """Return the plan for Gaussians with tables of these components, by name.

    photographs: their bytes on the device; pixels: of the largest view, whole tiles; pixel_sums: sums over pixels that
    the backward pass computes for each Gaussian; harmonics: the memory in which those above band 0 lie; seen: share of
    the Gaussians whose harmonics a view brings to the device.
    """
    shares = dict.fromkeys(HARMONICS, seen) if harmonics == "host" else {}
    held = {name: math.ceil(4 * width * shares.get(name, 1)) for name, width in components.items()}
    sizes = list(held.values())
    gradients = sum(held[name] for name in PARAMETERS) + 8  # for penalties and edits
    moving = 4 * components[MOTION] + MOVED if MOTION in components else 0
    gaussian = sum(sizes) + FRAME_GAUSSIAN + 4 * pixel_sums + gradients + moving
    fixed = photographs + FRAME_PIXEL * pixels
    host = sum(4 * components.get(name, 0) for name in shares)
    return MemoryPlan(gaussian, FRAME_PAIR, fixed, max(sizes), limits.memory, limits.allocation, host)
