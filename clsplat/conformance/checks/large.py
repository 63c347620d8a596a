"""Splats that reach more tiles than a mask has bits: their rectangles are shared among the items of a group."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks import tiles
from clsplat.conformance.comparison import Figure, equal, wrong
from clsplat.conformance.scenes import Case, random_case
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer

CHECKS = Checks()
TALL = (3, 130)  # tiles: two or three rows for each of 64 items, none for the last
WHOLE = ((8, 4), (11, 3))  # tiles: as many as a mask has bits, and one more
SURPLUS = (-7, -1, 5)  # of a count that another compiler makes
UNTOUCHED = 0xDEADBEEF


def case_of(device: Device, rng: np.random.Generator, columns: int, rows: int, count: int = 6) -> Case:
    """Gaussians of half the picture's longer side, and some a tenth of it, in a picture of so many tiles."""
    tile = int(device.tuning["TILE"])
    width, height, side = columns * tile, rows * tile, max(columns, rows) * tile
    case = random_case(rng, count, side, side)
    case.parameters["log_scales"] += np.log(side / 6 / np.where(np.arange(count) % 3 == 2, 5, 1))[:, None]
    camera = replace(case.view.camera, width=width, height=height, cx=0.5 * width, cy=0.5 * height)
    return replace(case, view=replace(case.view, camera=camera))


@CHECKS.add("count_large", "emit_large", "project_forward")
def lists_of_large_splats(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    yield from all_figures(device, rng)


def all_figures(device: Device, rng: np.random.Generator) -> Iterator[Figure]:
    """Compare lists of pictures with many rows, of rectangles around a mask's size, and of wrong counts."""
    for columns, rows in (TALL, *WHOLE):
        case, what = case_of(device, rng, columns, rows), f"large Gaussians, {columns} x {rows} tiles"
        yield from tiles.list_figures(device, case, "radix", what)
    yield from miscounted_figures(device, case_of(device, rng, *TALL))


def miscounted_figures(device: Device, case: Case) -> Iterator[Figure]:
    """Each splat lists as many tiles of the image as were counted, whatever that is, each once."""
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    number, camera = len(case.parameters["means"]), frame.camera
    box = rasterizer.workspace.array("tile_box", number, np.uint32)
    found = frame.lists.tile_count.get()[:number].astype(int)
    large = (box.get() >> 24 == 33) & (found > 0)
    for surplus in SURPLUS:
        count = np.where(large, np.maximum(1, found + surplus), 0)
        first = np.concatenate([[0], np.cumsum(count)])
        arrays = [device.upload(np.full(first[-1] + 64, UNTOUCHED, np.uint32)) for _ in range(2)]
        device.program("large.cl").emit_large(
            groups=1,
            splats=frame.splats,
            tile_box=box,
            tile_count=device.upload(count.astype(np.uint32)),
            first_pair=device.upload(first[:-1].astype(np.uint32)),
            pair_tile=arrays[0],
            pair_splat=arrays[1],
            tiles_x=camera.tiles_x,
            row_begin=0,
            row_end=camera.tiles_y,
            run=number,
            count=number,
        )
        tile, splat = (array.get() for array in arrays)
        what = f"large Gaussians counted with {surplus:+d} tiles"
        owner = np.repeat(np.arange(number), count)
        yield equal("emit_large", f"places of {what}", splat, _and_untouched(owner))
        yield wrong("emit_large", f"tiles outside, {what}", tile[: len(owner)] >= camera.tiles)
        yield equal("emit_large", f"places behind {what}", tile[len(owner) :], UNTOUCHED)
        pairs = np.stack([owner, tile[: len(owner)]], axis=1)
        twice = len(pairs) - len(np.unique(pairs, axis=0)) - int(np.maximum(0, count - camera.tiles).sum())
        yield Figure("emit_large", f"tiles listed twice, {what}", max(0, twice), 0, counts=True)


def _and_untouched(owner: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([owner, np.full(64, UNTOUCHED)])
