/* The tiles of large splats, whose rectangles have more tiles than a mask has bits (tiles.h).
 *
 * A work-group reads `run` splats and distributes the rows of each large rectangle among its TEAM items, LANES columns
 * at a time, so that no single item iterates over a whole image.  Deterministic: pairs are listed row by row, as for
 * other splats, and each has one writer. */
#include "tiles.h"

#define IS_LARGE(box) ((box) >> (2 * BOX_BITS) == BOX_LARGE)

typedef struct {
    uint begin, end;  // of the rectangle's rows
} rows_t;

/* The footprint of one splat in every lane; return the rows of its rectangle that this item computes. */
static inline rows_t split_rows(__global const float *splat, const uint tiles_x, const uint row_begin,
                                const uint row_end, footprint_t *f)
{
    VF fields[RECORD];
    for (uint k = 0; k < RECORD; k++)
        fields[k] = (VF)(splat[k]);
    *f = footprint_of(fields, (VI)(-1), tiles_x, row_begin, row_end);
    const uint rows = (uint)first_lane(f->rows), each = (rows + TEAM - 1) / TEAM, begin = get_local_id(0) * each;
    const rows_t part = {begin < rows ? begin : rows, begin + each < rows ? begin + each : rows};
    return part;
}

/* Whether the splat touches each of LANES tiles of a row, from a column on. */
static inline VI touched_from(const footprint_t *f, const uint column, const uint row)
{
    return touches_tile(f, (VF)((float)column) + to_VF(LANE_INDEX), (VF)((float)row));
}

static inline uint count_part(const footprint_t *f, const rows_t part)
{
    const uint columns = (uint)first_lane(f->columns);
    VF count = (VF)(0.0f);
    for (uint row = part.begin; row < part.end; row++)
        for (uint column = 0; column < columns; column += LANES)
            count += touched_from(f, column, row) ? (VF)(1.0f) : (VF)(0.0f);
    return (uint)sum_lanes(count);
}

/* tile_count[i] = tiles that a large splat touches; other counts are unchanged.  With COUNT_TILES, reset the number of
 * pairs of each tile.  Local memory: TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void count_large(
    __global const float *restrict splats,    // [N,RECORD] see splat.h
    __global const uint *restrict tile_box,   // [S] see tiles.h
    __global uint *restrict tile_count,       // [S]
    __global uint *restrict tile_pair_count,  // [T]
    const uint tiles,
    const uint tiles_x,
    const uint row_begin,                    // of the band of tiles
    const uint row_end,
    const uint run,
    const uint count)
{
    __local uint sums[TEAM];
    const uint item = get_local_id(0), first = get_group_id(0) * run;
    if (COUNT_TILES)
        for (uint tile = get_global_id(0); tile < tiles; tile += get_global_size(0))
            tile_pair_count[tile] = 0;
    for (uint i = first; i < first + run && i < count; i++)
        if (IS_LARGE(tile_box[i])) {
            footprint_t f;
            const rows_t part = split_rows(splats + (size_t)i * RECORD, tiles_x, row_begin, row_end, &f);
            sums[item] = count_part(&f, part);
            barrier(CLK_LOCAL_MEM_FENCE);
            if (item == 0) {
                uint total = 0;
                for (uint k = 0; k < TEAM; k++)
                    total += sums[k];
                tile_count[i] = total;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
}

/* List the touched tiles of an item's rows in the slots from `pair` up to `end`; fill remaining slots with other tiles,
 * in which blending finds no pixel of the splat. */
static inline void list_part(const footprint_t *f, const rows_t part, uint pair, const uint end, const uint i,
                             const uint tiles_x, __global uint *pair_tile, __global uint *pair_splat)
{
    const uint columns = (uint)first_lane(f->columns);
    const uint corner = (uint)first_lane(f->first_y) * tiles_x + (uint)first_lane(f->first_x);
    uint left = columns * (part.end - part.begin);
    for (uint row = part.begin; row < part.end; row++)
        for (uint column = 0; column < columns; column += LANES) {
            int touched[LANES];
            VSTORE_INT_PRIVATE(touched_from(f, column, row), touched);
            for (uint lane = 0; lane < LANES && column + lane < columns && pair < end; lane++) {
                if (touched[lane] || end - pair >= left) {
                    pair_tile[pair] = corner + row * tiles_x + column + lane;
                    pair_splat[pair] = i;
                    pair++;
                }
                left--;
            }
        }
}

/* Fill the slots from `slot` up to `end` with tiles from `tile` to `last`, except the tiles in the slots from `cursor`
 * to `slot`, which are sorted, so that no tile lists the splat twice.  Return the first slot that is not filled. */
static inline uint fill_up(uint slot, const uint end, uint cursor, uint tile, const uint last, const uint i,
                           __global uint *pair_tile, __global uint *pair_splat)
{
    const uint listed = slot;
    for (; slot < end && tile <= last; tile++) {
        while (cursor < listed && pair_tile[cursor] < tile)
            cursor++;
        if (cursor == listed || pair_tile[cursor] != tile) {
            pair_tile[slot] = tile;
            pair_splat[slot] = i;
            slot++;
        }
    }
    return slot;
}

/* Emit the pairs of large splats.  Tiles are tested again, and compilers may round differently here at the edge of a
 * tile: so no item writes more pairs than it counted or beyond the splat's slots, and all slots are filled.
 * Local memory: TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void emit_large(
    __global const float *restrict splats,     // [N,RECORD] see splat.h
    __global const uint *restrict tile_box,    // [S] see tiles.h
    __global const uint *restrict tile_count,  // [S]
    __global const uint *restrict first_pair,  // [N] first pair of each Gaussian
    __global const uint *restrict pair_count,  // [1] 0 if the pairs exceed the capacity
    __global uint *restrict pair_tile,         // [capacity]
    __global uint *restrict pair_splat,        // [capacity]
    __global uint *restrict tile_pair_count,   // [T] pairs of other splats
    const uint tiles_x,
    const uint row_begin,                      // of the band of tiles
    const uint row_end,
    const uint run,
    const uint count)
{
    __local uint sums[TEAM];
    const uint item = get_local_id(0), first = get_group_id(0) * run;
    const uint listed = pair_count[0] > 0 ? count : 0;
    for (uint i = first; i < first + run && i < listed; i++)
        if (IS_LARGE(tile_box[i])) {
            footprint_t f;
            const rows_t part = split_rows(splats + (size_t)i * RECORD, tiles_x, row_begin, row_end, &f);
            sums[item] = count_part(&f, part);
            barrier(CLK_LOCAL_MEM_FENCE);
            const uint begin = first_pair[i], end = begin + tile_count[i];
            uint item_begin = begin;
            for (uint k = 0; k < item; k++)
                item_begin += sums[k];
            const uint item_end = item_begin + sums[item] < end ? item_begin + sums[item] : end;
            list_part(&f, part, item_begin, item_end, i, tiles_x, pair_tile, pair_splat);
            barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
            const uint last = row_end * tiles_x - 1;
            if (item + 1 == TEAM)
                sums[0] = fill_up(item_end, end, begin, row_begin * tiles_x, last, i, pair_tile, pair_splat);
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint slot = sums[0] + item; slot < end; slot += TEAM) {  // a count above the number of tiles
                pair_tile[slot] = last;
                pair_splat[slot] = i;
            }
#if COUNT_TILES
            barrier(CLK_GLOBAL_MEM_FENCE);
            for (uint slot = begin + item; slot < end; slot += TEAM)
                atomic_inc(tile_pair_count + pair_tile[slot]);
#endif
            barrier(CLK_LOCAL_MEM_FENCE);  // keeps the group together: a runtime may split the loop after a branch
        }
}
