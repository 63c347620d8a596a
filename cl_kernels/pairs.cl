/* List the (tile, splat) pairs: the tiles that each splat touches.
 *
 * A pair's address is its place in emission order, so the pairs of one Gaussian are contiguous.  Deterministic: each
 * pair has one writer. */
#include "tiles.h"

/* Fill the places up to `end`, behind the pairs of a splat from `first` to `pair`, with tiles of the band that those do
 * not name, so that no tile lists the splat twice.  Blending finds no pixel of it there. */
static inline void fill_up(const uint first, const uint pair, const uint end, const uint i,
                           __global uint *pair_tile, __global uint *pair_splat, const uint tiles_x,
                           const uint row_begin, const uint row_end)
{
    const uint last = row_end * tiles_x - 1;
    uint listed = first, place = pair;
    for (uint tile = row_begin * tiles_x; place < end; tile++)
        if (listed < pair && pair_tile[listed] == tile) {
            listed++;
        } else {
            pair_tile[place] = tile < last ? tile : last;  // a count beyond the band stays inside it
            pair_splat[place] = i;
            place++;
        }
}

/* Emit the pairs up to `end` of a rectangle too large for a mask: its tiles are tested again, as in count_tiles.  That
 * is another program, whose compiler may round differently at a tile's edge and count a tile more or less. */
static inline void emit_large(__global const float *splat, const uint first, const uint end, const uint i,
                              __global uint *pair_tile, __global uint *pair_splat, const uint tiles_x,
                              const uint row_begin, const uint row_end)
{
    VF fields[RECORD];
    for (uint k = 0; k < RECORD; k++)
        fields[k] = (VF)(splat[k]);
    const footprint_t f = footprint_of(fields, (VI)(-1), tiles_x, row_begin, row_end);
    float first_x[LANES], first_y[LANES], columns[LANES], rows[LANES];
    VSTORE(f.first_x, first_x);
    VSTORE(f.first_y, first_y);
    VSTORE(f.columns, columns);
    VSTORE(f.rows, rows);
    uint pair = first;
    for (uint row = 0; row < (uint)rows[0]; row++)
        for (uint column = 0; column < (uint)columns[0] && pair < end; column++)
            if (ANY(touches_tile(&f, (float)column, (float)row))) {
                pair_tile[pair] = ((uint)first_y[0] + row) * tiles_x + (uint)first_x[0] + column;
                pair_splat[pair] = i;
                pair++;
            }
    fill_up(first, pair, end, i, pair_tile, pair_splat, tiles_x, row_begin, row_end);
}

/* One item = one place of `order`.  No local memory. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void emit_pairs(
    __global const float *restrict splats,      // [N,RECORD]
    __global const uint *restrict tile_box,     // [S] see tiles.h
    __global const uint *restrict tile_mask,    // [S] see tiles.h
    __global const uint *restrict order,        // [N] Gaussian at each place
    __global const uint *restrict pair_offset,  // [N+1] first pair of each place
    __global uint *restrict pair_tile,          // [P]
    __global uint *restrict pair_splat,         // [P]
    __global uint *restrict first_pair,         // [N] first pair of each Gaussian
    const uint tiles_x,
    const uint row_begin,                       // of the band of tiles
    const uint row_end,
    const uint count)
{
    const uint place = get_global_id(0);
    if (place >= count)
        return;
    const uint i = order[place];
    uint pair = pair_offset[place];
    const uint end = pair_offset[place + 1];
    first_pair[i] = pair;
    if (pair == end)
        return;
    const uint box = tile_box[i], width = box >> (2 * BOX_BITS), low = (1u << BOX_BITS) - 1;
    if (width == 0) {
        emit_large(splats + (size_t)i * RECORD, pair, end, i, pair_tile, pair_splat, tiles_x, row_begin, row_end);
        return;
    }
    uint tile = (box >> BOX_BITS & low) * tiles_x + (box & low), column = 0;
    for (uint mask = tile_mask[i]; mask != 0; mask >>= 1) {
        if (mask & 1u) {
            pair_tile[pair] = tile + column;
            pair_splat[pair] = i;
            pair++;
        }
        column++;
        if (column == width) {
            column = 0;
            tile += tiles_x;
        }
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
