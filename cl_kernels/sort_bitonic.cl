/* Bitonic tile sort: the pairs of each tile front to back, ties by Gaussian.
 *
 * Pairs are first written to their tile in any order (the cursor is an integer atomic), then each tile is sorted by
 * (depth bits, pair).  This order is total, since pairs are unique, so the result does not depend on the order of
 * writes: deterministic.
 *
 * A list is sorted in runs of SORT_CAPACITY pairs, each by one work-group in local memory.  Most lists are one run; the
 * runs of longer ones are merged by counting, for each pair, the smaller pairs in the other runs. */
#include "common.h"

/* Write each pair, with its depth, to its tile.  One item = one slot for a pair. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void fill_tiles(
    __global const uint *restrict pair_tile,   // [capacity]
    __global const uint *restrict pair_splat,  // [capacity]
    __global const uint *restrict pair_count,  // [1]
    __global const uint *restrict depth_key,   // [N] bits of z
    __global const uint *restrict tile_offset, // [T+1]
    __global uint *restrict tile_pair_count,   // [T] pairs of each tile; ends at 0
    __global uint *restrict tile_depth,        // [capacity]
    __global uint *restrict tile_pairs)        // [capacity]
{
    const uint pair = get_global_id(0), count = pair_count[0];
    if (pair >= count)
        return;
    const uint tile = pair_tile[pair];
    const uint position = tile_offset[tile] + atomic_dec(tile_pair_count + tile) - 1;
    tile_depth[position] = depth_key[pair_splat[pair]];
    tile_pairs[position] = pair;
}

typedef struct {
    uint first, last;  // pairs of the tile
    uint begin, end;   // pairs of the run; none if end <= begin
} run_t;

/* The run of this group.  The groups up to T have the first run of each tile.  Each multiple of SORT_CAPACITY is the
 * position of a pair whose list may have a further run: a list has at least as many such positions as further runs. */
static inline run_t run_of_group(__global const uint *tile_offset, const uint tiles)
{
    const uint group = get_group_id(0);
    uint tile = group, number = 0;
    if (group >= tiles) {
        const uint position = (group - tiles) * SORT_CAPACITY;
        uint end = tiles;
        tile = 0;
        while (end - tile > 1) {  // the last tile whose list starts at the position or before
            const uint middle = (tile + end) / 2;
            if (tile_offset[middle] <= position)
                tile = middle;
            else
                end = middle;
        }
        number = group - tiles + 1 - (tile_offset[tile] + SORT_CAPACITY - 1) / SORT_CAPACITY;
    }
    const uint first = tile_offset[tile], last = tile_offset[tile + 1], begin = first + number * SORT_CAPACITY;
    const run_t run = {first, last, begin, min(begin + SORT_CAPACITY, last)};
    return run;
}

static inline bool is_before(const uint key, const uint pair, const uint other_key, const uint other_pair)
{
    return key < other_key || (key == other_key && pair < other_pair);
}

/* Sort each run front to back: lists of one run in their place, others for merge_runs.  The network is the ascending
 * ("flip") form, in which a partner beyond the end counts as +infinity and is skipped.
 * Local memory: SORT_CAPACITY * 8 bytes. */
__kernel __attribute__((reqd_work_group_size(BITONIC_GROUP, 1, 1)))
void sort_tiles(
    __global const uint *restrict tile_offset,  // [T+1]
    __global uint *restrict tile_depth,         // [capacity]; sorted in lists of several runs
    __global uint *restrict tile_pairs,         // [capacity]
    __global uint *restrict run_pairs,          // [capacity] lists of several runs
    const uint tiles)
{
    __local uint keys[SORT_CAPACITY];
    __local uint pairs[SORT_CAPACITY];
    const run_t run = run_of_group(tile_offset, tiles);
    const uint length = run.end > run.begin ? run.end - run.begin : 0;
    for (uint i = get_local_id(0); i < length; i += BITONIC_GROUP) {
        keys[i] = tile_depth[run.begin + i];
        pairs[i] = tile_pairs[run.begin + i];
    }
    for (uint block = 2; block >> 1 < length; block <<= 1)
        for (uint step = block >> 1, flip = 1; step > 0; step >>= 1, flip = 0) {
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint t = get_local_id(0);; t += BITONIC_GROUP) {
                const uint low = 2 * t - (t & (step - 1));
                if (low >= length)
                    break;
                const uint high = flip ? (low ^ (block - 1)) : (low + step);
                if (high >= length)
                    continue;
                const uint key = keys[low], other_key = keys[high], pair = pairs[low], other_pair = pairs[high];
                if (is_before(other_key, other_pair, key, pair)) {
                    keys[low] = other_key;
                    keys[high] = key;
                    pairs[low] = other_pair;
                    pairs[high] = pair;
                }
            }
        }
    barrier(CLK_LOCAL_MEM_FENCE);
    const bool is_long = run.last - run.first > SORT_CAPACITY;
    for (uint i = get_local_id(0); i < length; i += BITONIC_GROUP)
        if (is_long) {
            tile_depth[run.begin + i] = keys[i];
            run_pairs[run.begin + i] = pairs[i];
        } else {
            tile_pairs[run.begin + i] = pairs[i];
        }
}

/* Merge the runs of long lists: move each pair to its position in the list.  One group = one run. */
__kernel __attribute__((reqd_work_group_size(BITONIC_GROUP, 1, 1)))
void merge_runs(
    __global const uint *restrict tile_offset,  // [T+1]
    __global const uint *restrict tile_depth,   // [capacity]
    __global const uint *restrict run_pairs,    // [capacity]
    __global uint *restrict tile_pairs,         // [capacity]
    const uint tiles)
{
    const run_t run = run_of_group(tile_offset, tiles);
    if (run.last - run.first <= SORT_CAPACITY)
        return;
    for (uint i = run.begin + get_local_id(0); i < run.end; i += BITONIC_GROUP) {
        const uint key = tile_depth[i], pair = run_pairs[i];
        uint position = run.first + i - run.begin;
        for (uint other = run.first; other < run.last; other += SORT_CAPACITY) {
            uint low = other, high = other == run.begin ? other : min(other + SORT_CAPACITY, run.last);
            while (low < high) {  // the number of smaller pairs
                const uint middle = (low + high) / 2;
                if (is_before(tile_depth[middle], run_pairs[middle], key, pair))
                    low = middle + 1;
                else
                    high = middle;
            }
            position += low - other;
        }
        tile_pairs[position] = pair;
    }
}
