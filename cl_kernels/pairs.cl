/* Which tiles each splat touches, as a list of (tile, splat) pairs.
 *
 * A pair's address is its place in emission order, so the pairs of one Gaussian are contiguous.  Counting and emitting
 * share touches_tile, so they agree exactly.  Deterministic: each pair has one writer. */
#include "splat.h"

/* One item = one Gaussian.  No local memory. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_tiles(
    __global const float *restrict splats,  // [N,RECORD]
    __global uint *restrict tile_count,     // [N] tiles touched; 0 when culled
    const uint tiles_x,
    const uint tiles_y,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    __global const float *splat = splats + (size_t)i * RECORD;
    uint touched = 0;
    if (splat[SPLAT_OPACITY] > 0.0f) {
        const uint2 span_x = tile_span(splat[SPLAT_X_MIN], splat[SPLAT_X_MAX], tiles_x);
        const uint2 span_y = tile_span(splat[SPLAT_Y_MIN], splat[SPLAT_Y_MAX], tiles_y);
        for (uint y = span_y.x; y < span_y.y; y++)
            for (uint x = span_x.x; x < span_x.y; x++)
                touched += touches_tile(splat, x, y) ? 1 : 0;
    }
    tile_count[i] = touched;
}

/* One item = one place of `order`.  No local memory. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void emit_pairs(
    __global const float *restrict splats,       // [N,RECORD]
    __global const uint *restrict order,         // [N] Gaussian at each place
    __global const uint *restrict pair_offset,   // [N+1] first pair of each place
    __global uint *restrict pair_tile,           // [P]
    __global uint *restrict pair_splat,          // [P]
    __global uint *restrict first_pair,          // [N] first pair of each Gaussian
    const uint tiles_x,
    const uint tiles_y,
    const uint count)
{
    const uint place = get_global_id(0);
    if (place >= count)
        return;
    const uint i = order[place];
    uint pair = pair_offset[place];
    first_pair[i] = pair;
    if (pair_offset[place + 1] == pair)
        return;
    __global const float *splat = splats + (size_t)i * RECORD;
    const uint2 span_x = tile_span(splat[SPLAT_X_MIN], splat[SPLAT_X_MAX], tiles_x);
    const uint2 span_y = tile_span(splat[SPLAT_Y_MIN], splat[SPLAT_Y_MAX], tiles_y);
    for (uint y = span_y.x; y < span_y.y; y++)
        for (uint x = span_x.x; x < span_x.y; x++)
            if (touches_tile(splat, x, y)) {
                pair_tile[pair] = y * tiles_x + x;
                pair_splat[pair] = i;
                pair++;
            }
}

/* Where each tile's pairs begin in the list sorted by tile.  One item = one pair, and one past the last. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void find_tile_offsets(
    __global const uint *restrict sorted_tile,  // [P] ascending
    __global uint *restrict tile_offset,        // [T+1]
    const uint tiles,
    const uint count)
{
    const uint pair = get_global_id(0);
    if (pair > count)
        return;
    const uint first = pair > 0 ? sorted_tile[pair - 1] + 1 : 0;
    const uint last = pair < count ? sorted_tile[pair] : tiles;
    for (uint tile = first; tile <= last; tile++)
        tile_offset[tile] = pair;
}
