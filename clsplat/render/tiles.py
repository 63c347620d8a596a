"""List the splats of each tile, front to back.

Two algorithms produce the same result.  `radix` sorts the Gaussians by depth, emits their (tile, Gaussian) pairs in
that order, and then sorts them stably by tile.  `bitonic` emits the pairs in the order of indices, and sorts each tile
by (depth, index).  Both break ties by index.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from clsplat.opencl.device import Array, Device, constants
from clsplat.render.workspace import GROWTH_FACTOR, Workspace

Sort = Literal["auto", "radix", "bitonic"]
Defines = dict[str, int] | None  # macros of the projection
COUNTING: dict[Sort, dict[str, int]] = {"radix": {}, "bitonic": {"COUNT_TILES": 1}}  # macros of the kernels that list
OUTPUTS = {name: int(constants("sort_radix.cl")[f"OUTPUT_{name}"]) for name in ("KEYS", "CARRIED", "NONE")}
SORT_CAPACITY = int(constants()["SORT_CAPACITY"])
LONG_LIST = 32 * SORT_CAPACITY  # pairs; the bitonic sort compares each run of a list with all others
MAX_SINGLE_GROUP_RUN = 32  # values per item up to which one group scans everything
MAX_SCAN_BLOCKS = 1024  # each block adds up the sums of all previous blocks


@dataclass(frozen=True)
class Footprints:
    """The depth and the tiles of each splat, [S] uint32 each; see cl_kernels/tiles.h."""

    depth_key: Array
    tile_count: Array
    tile_box: Array
    tile_mask: Array


@dataclass(frozen=True)
class TileLists:
    """Pairs in emission order, contiguous for each Gaussian, and the depth order of each tile.

    The lists and `tile_count` are empty if there are more pairs than `capacity`; see `Tiler.has_room`.
    """

    read_pairs: Callable[[], int]  # returns the number of pairs; waits for the device
    capacity: int  # pairs that fit
    limit: int  # largest `capacity`
    pair_splat: Array  # [capacity] Gaussian of each pair
    first_pair: Array  # [N] first pair of each Gaussian
    tile_count: Array  # [S] pairs of each Gaussian
    tile_offset: Array  # [T+1]
    tile_pairs: Array  # [capacity] pairs ordered by tile, front to back
    pair_count: Array  # [2] listed pairs; 1 if there are more than `capacity`

    @property
    def key(self) -> tuple[int, ...]:
        """Numbers that identify the memory of the lists, as a part of the keys of plans."""
        arrays = self.pair_splat, self.first_pair, self.tile_count, self.tile_offset, self.tile_pairs, self.pair_count
        return tuple(array.buffer.serial for array in arrays)

    @cached_property
    def pairs(self) -> int:
        """The number of pairs.  Reading it waits until the device has counted them, but not for later work."""
        return self.read_pairs()


@dataclass(frozen=True)
class Band:
    """The rows of tiles, from `row_begin` to `row_end` (exclusive), that are rendered together."""

    tiles_x: int
    tiles_y: int
    row_begin: int
    row_end: int

    @property
    def tiles(self) -> int:
        """Number of tiles in the full grid."""
        return self.tiles_x * self.tiles_y

    @property
    def first_tile(self) -> int:
        return self.row_begin * self.tiles_x

    @property
    def tiles_inside(self) -> int:
        return (self.row_end - self.row_begin) * self.tiles_x


class TooManyPairs(Exception):
    """A band has more pairs than the limit; use bands with fewer rows of tiles."""


def resolve_sort(device: Device, sort: Sort) -> Sort:
    """Resolve `auto` to radix on devices without barriers, which bitonic needs; otherwise, return `sort`."""
    return "radix" if sort == "auto" and int(device.tuning["TEAM"]) == 1 else sort


class Tiler:
    """Builds tile lists.  sort: `auto` is `radix` on CPUs, and where the mean list is longer than LONG_LIST."""

    def __init__(self, device: Device, workspace: Workspace, sort: Sort = "auto") -> None:
        self.device, self.workspace = device, workspace
        self._team = int(device.tuning["TEAM"])
        self.sort: Sort = resolve_sort(device, sort)
        self._pairs = device.program("pairs.cl")
        self._scan = device.program("scan.cl")
        self._radix = device.program("sort_radix.cl")
        self._digit_bits = int(device.tuning["DIGIT_BITS"])
        self._zero = device.zeros(1, np.uint32)
        self._capacity = 0  # pairs for which kernels are launched
        self._max_key_count = device.upload(np.array([2**32 - 1], np.uint32))  # more keys than any capacity

    def build(
        self, splats: Array, footprints: Footprints, band: Band, count: int, limit: int, defines: Defines = None
    ) -> TileLists:
        """Build the tile lists of `count` splats in a band.  Waits only if there is no memory for pairs yet.

        The lists are valid if `has_room` is true.  limit: maximum number of pairs.  Raises TooManyPairs
        like `has_room`.
        """
        sort = self.sort
        if sort == "auto":
            sort = "radix" if self._capacity > LONG_LIST * band.tiles_inside else "bitonic"
        plans, inputs = self.workspace.plans, (splats, footprints, band, count, sort, defines)
        serials = (array.buffer.serial for array in (splats, *vars(footprints).values(), self._zero))
        key = sort, band, count, *(defines or {}).items(), *serials
        order, pair_offset = plans.run(("order", key), {}, self._order, *inputs)
        read_pairs = pair_offset.get_item_later(count)
        if not self._capacity:
            self._grow(read_pairs(), limit)
        capacity = min(self._capacity, limit)
        lists = plans.run(("lists", key, capacity), {}, self._list_pairs, capacity, order, pair_offset, *inputs)
        return TileLists(read_pairs, capacity, limit, *lists)

    def _order(
        self, splats: Array, footprints: Footprints, band: Band, count: int, sort: Sort, defines: Defines
    ) -> tuple[Array, Array]:
        """Return the order in which pairs are emitted, [N], and the first pair of each position in it, [N+1]."""
        large = self._large_arguments(splats, footprints, band, count)
        self.device.program("large.cl", **(defines or {}), **COUNTING[sort]).count_large(tiles=band.tiles, **large)
        if sort == "bitonic":
            return self._index_order(count), self.scan(footprints.tile_count, count, "pair_offset")
        carried = footprints.tile_count
        ordered_count, order, _ = self.sort_pairs(footprints.depth_key, 32, count, "depth", carried=carried)
        return order, self.scan(ordered_count, count, "pair_offset")

    def _list_pairs(
        self,
        capacity: int,
        order: Array,
        pair_offset: Array,
        splats: Array,
        footprints: Footprints,
        band: Band,
        count: int,
        sort: Sort,
        defines: Defines,
    ) -> tuple[Array, ...]:
        """List up to `capacity` pairs; return the arrays of TileLists."""
        pair_tile, pair_splat = self._pair_array("pair_tile", capacity), self._pair_array("pair_splat", capacity)
        first_pair = self.workspace.array("first_pair", count, np.uint32)
        pair_count = self.workspace.array("pair_count", 2, np.uint32)
        large = self._large_arguments(splats, footprints, band, count)
        self.device.program("pairs.cl", **COUNTING[sort]).emit_pairs(
            items=max(count, 1),
            tile_box=footprints.tile_box,
            tile_mask=footprints.tile_mask,
            order=order,
            pair_offset=pair_offset,
            pair_tile=pair_tile,
            pair_splat=pair_splat,
            tile_count=footprints.tile_count,
            first_pair=first_pair,
            pair_count=pair_count,
            tile_pair_count=large["tile_pair_count"],
            tiles_x=band.tiles_x,
            capacity=capacity,
            count=count,
        )
        self.device.program("large.cl", **(defines or {}), **COUNTING[sort]).emit_large(
            **large,
            first_pair=first_pair,
            pair_count=pair_count,
            pair_tile=pair_tile,
            pair_splat=pair_splat,
        )
        if sort == "radix":
            tile_offset, tile_pairs = self._sort_by_tile(pair_tile, pair_count, capacity, band.tiles)
        else:
            tile_offset, tile_pairs = self._sort_in_tiles(
                pair_tile, pair_splat, footprints.depth_key, pair_count, large["tile_pair_count"], capacity, band.tiles
            )
        return pair_splat, first_pair, footprints.tile_count, tile_offset, tile_pairs, pair_count

    def has_room(self, lists: TileLists) -> bool:
        """Wait for the number of pairs, and return whether they fit; if not, raise the capacity for the next `build`.

        The splats must then be projected again.  Raises TooManyPairs if there are more pairs than the limit.
        """
        if lists.pairs <= lists.capacity:
            return True
        self._grow(lists.pairs, lists.limit)
        return False

    def _grow(self, pairs: int, limit: int) -> None:
        if pairs > limit:
            raise TooManyPairs
        self._capacity = min(int(pairs * GROWTH_FACTOR), limit) if self._capacity else pairs

    def reset_capacity(self) -> None:
        """Forget the capacity for pairs, so that the next lists get exactly the memory that they need."""
        self._capacity = 0

    def _pair_array(self, name: str, capacity: int) -> Array:
        return self.workspace.array(name, capacity, np.uint32, slack=1.0)

    def _large_arguments(self, splats: Array, footprints: Footprints, band: Band, count: int) -> dict[str, Any]:
        """Return the arguments of both kernels for large splats.  On GPUs, each work-item checks one splat."""
        run = self._team if self._team > 1 else self._runs(count, min_run=1 << 8)[0]
        return {
            "groups": max(1, -(-count // run)),
            "run": run,
            "count": count,
            "tiles_x": band.tiles_x,
            "row_begin": band.row_begin,
            "row_end": band.row_end,
            "splats": splats,
            "tile_box": footprints.tile_box,
            "tile_count": footprints.tile_count,
            "tile_pair_count": self.workspace.array("tile_pair_count", band.tiles, np.uint32),
        }

    def scan(self, values: Array, count: int, name: str) -> Array:
        """Return the exclusive prefix sum of `count` values, [count + 1] with the total at the end."""
        offset = self.workspace.array(name, count + 1, np.uint32)
        if count == 0:
            offset.fill(0)
            return offset
        run, _ = self._runs(count, min_run=1 << 14)
        if count <= MAX_SINGLE_GROUP_RUN * self._team:  # on GPUs, one launch with long runs is faster than two
            run = max(run, -(-count // self._team))
        run = max(run, -(-count // (MAX_SCAN_BLOCKS * self._team)))
        blocks = -(-count // (run * self._team))
        block_sum = self._zero
        if blocks > 1:
            block_sum = self.workspace.array("block_sum", blocks, np.uint32)
            self._scan.scan_blocks(groups=blocks, values=values, block_sum=block_sum, run=run, count=count)
        self._scan.scan_offsets(groups=blocks, values=values, block_sum=block_sum, offset=offset, run=run, count=count)
        return offset

    def sort_pairs(
        self,
        keys: Array,
        bits: int,
        capacity: int,
        name: str,
        key_count: Array | None = None,
        carried: Array | None = None,
        has_keys: bool = True,
    ) -> tuple[Array, Array, Array]:
        """Sort keys below 2^bits stably; return the sorted keys and their original indices, both [capacity].

        The third result is the position of the first key of each digit of the last pass; after one pass, of each key.
        key_count: [1] number of keys, by default `capacity`.  carried: [capacity] values that are returned in the order
        of the keys, instead of the keys.  has_keys: whether the keys are returned.
        """
        passes = self._passes(bits)
        width = -(-bits // passes)
        blocks = max(1, self._runs(capacity, min_run=1 << 10)[1])
        values = keys  # the first pass does not read them
        last_output = OUTPUTS["CARRIED" if carried else "KEYS" if has_keys else "NONE"]
        for number in range(passes):
            digits = 1 << min(width, bits - number * width)
            arguments: dict[str, Any] = {
                "groups": blocks,
                "shift": number * width,
                "digits": digits,
                "capacity": capacity,
            }
            arguments |= {"keys": keys, "key_count": key_count or self._max_key_count}
            digit_count = self.workspace.array("digit_count", digits * blocks, np.uint32)
            self._radix.radix_count(digit_count=digit_count, **arguments)
            digit_offset = self.scan(digit_count, digits * blocks, "digit_offset")
            growth = 1.0 if key_count else GROWTH_FACTOR
            digit_first = self.workspace.array(f"{name}_first", digits + 1, np.uint32)
            sorted_keys, sorted_values = (
                self.workspace.array(f"{name}_{part}{number % 2}", capacity, np.uint32, growth)
                for part in ("keys", "values")
            )
            self._radix.radix_scatter(
                values=values,
                digit_offset=digit_offset,
                digit_first=digit_first,
                carried=carried or keys,
                output=last_output if number == passes - 1 else OUTPUTS["KEYS"],
                sorted_keys=sorted_keys,
                sorted_values=sorted_values,
                first_pass=int(number == 0),
                **arguments,
            )
            keys, values = sorted_keys, sorted_values
        return keys, values, digit_first

    def _passes(self, bits: int) -> int:
        return -(-bits // self._digit_bits)

    def _runs(self, count: int, min_run: int) -> tuple[int, int]:
        """Return the number of values per item, and the number of groups."""
        balanced_run = -(-count // (4 * self.device.info.units))  # four runs per core balance the load
        run = 8 if self._team > 1 else max(min_run, balanced_run)
        return run, -(-count // (run * self._team))

    def _index_order(self, count: int) -> Array:
        if self.workspace.length("index_order") < count:
            self.workspace.array("index_order", count, np.uint32)
            length = self.workspace.length("index_order")
            self.workspace.array("index_order", length, np.uint32).set(np.arange(length, dtype=np.uint32))
        return self.workspace.array("index_order", count, np.uint32)

    def _sort_by_tile(self, pair_tile: Array, pair_count: Array, capacity: int, tiles: int) -> tuple[Array, Array]:
        bits = max(1, (tiles - 1).bit_length())
        has_keys = self._passes(bits) > 1
        sorted_tile, tile_pairs, first = self.sort_pairs(
            pair_tile, bits, capacity, "tile", pair_count, has_keys=has_keys
        )
        if not has_keys:
            return Array(self.device, first.buffer, (tiles + 1,), first.dtype), tile_pairs
        tile_offset = self.workspace.array("tile_offset", tiles + 1, np.uint32)
        self._pairs.find_tile_offsets(
            items=capacity + 1, sorted_tile=sorted_tile, pair_count=pair_count, tile_offset=tile_offset, tiles=tiles
        )
        return tile_offset, tile_pairs

    def _sort_in_tiles(
        self,
        pair_tile: Array,
        pair_splat: Array,
        depth_key: Array,
        pair_count: Array,
        tile_pair_count: Array,
        capacity: int,
        tiles: int,
    ) -> tuple[Array, Array]:
        tile_offset = self.scan(tile_pair_count, tiles, "tile_offset")
        tile_depth, tile_pairs = self._pair_array("tile_depth", capacity), self._pair_array("tile_pairs", capacity)
        bitonic = self.device.program("sort_bitonic.cl")
        arrays: dict[str, Any] = {"tile_offset": tile_offset, "tile_depth": tile_depth, "tile_pairs": tile_pairs}
        bitonic.fill_tiles(
            items=capacity,
            pair_tile=pair_tile,
            pair_splat=pair_splat,
            pair_count=pair_count,
            depth_key=depth_key,
            tile_pair_count=tile_pair_count,
            **arrays,
        )
        groups = tiles + -(-capacity // SORT_CAPACITY)
        bitonic.sort_tiles(groups=groups, run_pairs=pair_tile, tiles=tiles, **arrays)
        if capacity > SORT_CAPACITY:
            bitonic.merge_runs(groups=groups, run_pairs=pair_tile, tiles=tiles, **arrays)
        return tile_offset, tile_pairs
