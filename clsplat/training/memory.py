"""Plan the device memory of training before it is allocated.

The plan counts bytes per Gaussian for the tables, and bytes per Gaussian, per (tile, Gaussian) pair, and per pixel
for a frame.
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

VISIBLE_FRACTION = 0.5  # fraction of Gaussians visible in one view, an estimate; only their harmonics are on the device
PAIRS_PER_GAUSSIAN = 5  # (tile, Gaussian) pairs with tiles of 16 px, an estimate; trained scenes have 1.5 to 4
FRAME_GAUSSIAN = 4 * (RECORD + 2 + 5 + 7)  # bytes: records, mean2d; keys and radius; sorting by depth
MOVED_GAUSSIAN = 4 * (3 + 4 + 1)  # bytes: means, quaternions, and logits at the time of a view
FRAME_PAIR = 4 * (RECORD + 6)  # bytes: gradient record; tile and Gaussian of the pair; sorting by tile
FRAME_PIXEL = 4 * (4 * 3 + 3 + 9 + 4 + 2)
# bytes: image, photograph, gradient, second render; transmittance, texture, mask; SSIM's derivatives; sums of a blur;
# inverse depths and their gradient

Location = Literal["device", "host"]
Harmonics = Literal["auto", "device", "host"]  # memory of the bands above 0; auto: the host if the device is full


@dataclass(frozen=True)
class MemoryPlan:
    """The device memory that training needs, and the memory that the device has, in bytes."""

    gaussian: int  # bytes per Gaussian, in tables and the frame
    pair: int  # bytes per pair
    fixed: int  # bytes of photographs and planes of pixels
    largest_table: int  # bytes per Gaussian, in the largest single buffer
    memory: int  # total memory of the device
    allocation: int  # largest size of a single buffer
    host: int = 0  # bytes per Gaussian, in the memory of the host
    pairs: float = PAIRS_PER_GAUSSIAN  # per Gaussian

    def required_bytes(self, gaussians: int) -> int:
        """Return the bytes that Gaussians need, including spare capacity for growth and a copy of the largest table."""
        return self.fixed + int(gaussians * self._per_gaussian)

    @property
    def _per_gaussian(self) -> float:
        return GROWTH * self.gaussian + self.largest_table + self.pairs * self.pair

    @property
    def limit(self) -> int:
        """The largest number of Gaussians that fits in the total memory, with each table in one buffer."""
        by_total = (self.memory - self.fixed) / self._per_gaussian
        by_table = self.allocation // self.largest_table // ALIGNMENT * ALIGNMENT
        by_pairs = self.allocation / (self.pairs * 4 * RECORD)
        return max(0, int(min(by_total, by_table, by_pairs)))

    def text(self, gaussians: int) -> str:
        """Return a line with the required memory and the number of Gaussians that fit."""
        mib = 2**20
        host_text = f"; harmonics take {gaussians * self.host / mib:,.0f} MiB on the host" if self.host else ""
        return (
            f"memory: {self.required_bytes(gaussians) / mib:,.0f} MiB for {gaussians:,} Gaussians ({self.gaussian} "
            f"bytes each and {self.pair} per pair, photos and planes {self.fixed / mib:,.0f} MiB); {self.limit:,} "
            f"fit in {self.memory / mib:,.0f} MiB with buffers up to {self.allocation / mib:,.0f} MiB{host_text}"
        )

    def check(self, gaussians: int, more: str = "") -> None:
        """Raise MemoryLimitError if the Gaussians do not fit.  more: an additional remedy for the message."""
        if gaussians > self.limit:
            raise MemoryLimitError(
                f"{self.text(gaussians)}: start from fewer points, use smaller images (scene.downscale), or keep fewer "
                f"of them on the device (scene.image_budget){more}"
            )


class DeviceLimits(Protocol):
    """The memory of a device."""

    @property
    def memory(self) -> int:
        """Total bytes."""

    @property
    def allocation(self) -> int:
        """Largest size of a single buffer, bytes."""

    @property
    def unified(self) -> bool:
        """Whether the device shares the memory of the host."""


def offload_target(harmonics: Harmonics, limits: DeviceLimits) -> Location:
    """Return where harmonics may be stored.  `auto` does not offload them if the device shares the host's memory."""
    return "host" if harmonics == "host" or (harmonics == "auto" and not limits.unified) else "device"


def max_pixels(views: Sequence[View], tile: int) -> int:
    """Return the number of pixels of the largest view, rounded up to full tiles.  tile: side of a tile, px."""
    return max(-(-view.camera.width // tile) * -(-view.camera.height // tile) * tile**2 for view in views)


def module_bytes(stages: Iterable[Any], views: Sequence[View], tile: int) -> int:
    """Return the device memory of modules, in bytes, in the stage whose modules need the most."""
    lists = [getattr(stage, "modules", ()) for stage in stages]
    return max((sum(module.device_bytes(views, tile) for module in modules) for modules in lists), default=0)


def table_widths(degree: int, motion: int = 0) -> dict[str, int]:
    """Return the number of components of each parameter and moment.  motion: columns of the motion table."""
    widths = (3, 4, 3, 1, 3, 3 * (sh_coefficients(degree) - 1))
    parameters = dict(zip(PARAMETERS, widths, strict=True)) | ({MOTION: motion} if motion else {})
    return parameters | {table: width for name, width in parameters.items() for table in moment_tables(name)}


def plan(
    limits: DeviceLimits,
    components: Mapping[str, int],
    photographs: int,
    pixels: int,
    pixel_sums: int = PIXEL_SUMS,
    harmonics: Location = "device",
    visible: float = VISIBLE_FRACTION,
    tile: int = 16,
) -> MemoryPlan:
    """Return the memory plan for Gaussians.  components: number of components of each table, by name.

    photographs: bytes of photographs on the device; pixels: number of pixels of the largest view, in full tiles;
    pixel_sums: number of sums over pixels per Gaussian in the backward pass; harmonics: where the bands above 0 are
    stored; visible: fraction of Gaussians whose harmonics are on the device for a view, if they are offloaded; tile:
    side of a tile, px.
    """
    fractions = dict.fromkeys(HARMONICS, visible) if harmonics == "host" else {}
    bytes_by_table = {name: math.ceil(4 * width * fractions.get(name, 1)) for name, width in components.items()}
    sizes = list(bytes_by_table.values())
    gradients = sum(bytes_by_table[name] for name in PARAMETERS) + 8  # gradients, for penalties and edits
    motion_bytes = 4 * components[MOTION] + MOVED_GAUSSIAN if MOTION in components else 0
    gaussian_bytes = sum(sizes) + FRAME_GAUSSIAN + 4 * pixel_sums + gradients + motion_bytes
    fixed_bytes = photographs + FRAME_PIXEL * pixels
    host_bytes = sum(4 * components.get(name, 0) for name in fractions)
    memory = limits.memory, limits.allocation, host_bytes, PAIRS_PER_GAUSSIAN * 16 / tile
    return MemoryPlan(gaussian_bytes, FRAME_PAIR, fixed_bytes, max(sizes), *memory)
