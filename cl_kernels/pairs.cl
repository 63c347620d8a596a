/* List the (tile, splat) pairs: the tiles that each splat touches.
 *
 * A pair's address is its position in emission order, so the pairs of one Gaussian are contiguous.  Deterministic: each
 * pair has one writer. */
#include "tiles.h"

/* The pairs of splats with a mask; large.cl adds those of large splats.  If there are more pairs than `capacity`, none
 * are listed, and all counts are 0.  One item = one position in `order`, and at least one item. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void emit_pairs(
    __global const uint *restrict tile_box,     // [S] see tiles.h
    __global const uint *restrict tile_mask,    // [S] see tiles.h
    __global const uint *restrict order,        // [N] Gaussian at each position
    __global const uint *restrict pair_offset,  // [N+1] first pair of each position
    __global uint *restrict pair_tile,          // [capacity]
    __global uint *restrict pair_splat,         // [capacity]
    __global uint *restrict tile_count,         // [S] pairs of each Gaussian
    __global uint *restrict first_pair,         // [N] first pair of each Gaussian
    __global uint *restrict pair_count,         // [2] listed pairs; 1 if there are more than `capacity`
    __global uint *restrict tile_pair_count,    // [T] starts at 0
    const uint tiles_x,
    const uint capacity,
    const uint count)
{
    const uint position = get_global_id(0), pairs = pair_offset[count];
    if (position == 0) {
        pair_count[0] = pairs <= capacity ? pairs : 0;
        pair_count[1] = pairs > capacity;
    }
    if (position >= count)
        return;
    const uint i = order[position];
    if (pairs > capacity) {
        tile_count[i] = 0;
        return;
    }
    uint pair = pair_offset[position];
    first_pair[i] = pair;
    const uint box = tile_box[i], width = box >> (2 * BOX_BITS), low = (1u << BOX_BITS) - 1;
    if (width == BOX_LARGE)
        return;
    uint tile = (box >> BOX_BITS & low) * tiles_x + (box & low), column = 0;
    for (uint mask = tile_mask[i]; mask != 0; mask >>= 1) {
        if (mask & 1u) {
            pair_tile[pair] = tile + column;
            pair_splat[pair] = i;
            pair++;
            if (COUNT_TILES)
                atomic_inc(tile_pair_count + tile + column);
        }
        column++;
        if (column == width) {
            column = 0;
            tile += tiles_x;
        }
    }
}

/* The first pair of each tile in the list sorted by tile.  One item = one slot for a pair, and one more. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void find_tile_offsets(
    __global const uint *restrict sorted_tile,  // [capacity] ascending
    __global const uint *restrict pair_count,   // [1]
    __global uint *restrict tile_offset,        // [T+1]
    const uint tiles)
{
    const uint pair = get_global_id(0), count = pair_count[0];
    if (pair > count)
        return;
    const uint first = pair > 0 ? sorted_tile[pair - 1] + 1 : 0;
    const uint last = pair < count ? sorted_tile[pair] : tiles;
    for (uint tile = first; tile <= last; tile++)
        tile_offset[tile] = pair;
}
