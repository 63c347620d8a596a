/* Bitonic tile sort: the pairs of each tile front to back, ties by Gaussian.
 *
 * Pairs are first written to their tile in any order (the cursor is an integer atomic), then each tile is sorted by
 * (depth bits, pair).  This order is total, since pairs are unique, so the result does not depend on the order of
 * writes: deterministic.
 *
 * One work-group = one tile of any length: the ascending ("flip") form of the network, in which a partner beyond the
 * end counts as +infinity and is skipped.  Local memory: SORT_CAPACITY * 8 bytes; longer tiles are sorted in place. */
#include "common.h"

/* tile_count[tile] = pairs of the tile.  One item = one slot for a pair. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_pairs(
    __global const uint *restrict pair_tile,   // [capacity]
    __global const uint *restrict pair_count,  // [1]
    __global uint *restrict tile_pair_count)   // [T] starts at 0
{
    const uint pair = get_global_id(0), count = pair_count[0];
    if (pair < count)
        atomic_inc(tile_pair_count + pair_tile[pair]);
}

/* Write each pair, with its depth, to its tile.  One item = one slot for a pair. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void fill_tiles(
    __global const uint *restrict pair_tile,   // [capacity]
    __global const uint *restrict pair_splat,  // [capacity]
    __global const uint *restrict pair_count,  // [1]
    __global const uint *restrict depth_key,   // [N] bits of z
    __global const uint *restrict tile_offset, // [T+1]
    __global uint *restrict tile_fill,         // [T] starts at 0
    __global uint *restrict tile_depth,        // [capacity]
    __global uint *restrict tile_pairs)        // [capacity]
{
    const uint pair = get_global_id(0), count = pair_count[0];
    if (pair >= count)
        return;
    const uint tile = pair_tile[pair];
    const uint position = tile_offset[tile] + atomic_inc(tile_fill + tile);
    tile_depth[position] = depth_key[pair_splat[pair]];
    tile_pairs[position] = pair;
}

/* The sorting network, for keys and pairs in either address space. */
#define SORT_NETWORK(keys, pairs, count, fence)                                                  \
    for (uint block = 2; (block >> 1) < (count); block <<= 1)                                    \
        for (uint step = block >> 1, flip = 1; step > 0; step >>= 1, flip = 0) {                 \
            barrier(fence);                                                                      \
            for (uint t = get_local_id(0); ; t += BITONIC_GROUP) {                               \
                const uint low = 2 * t - (t & (step - 1));                                       \
                if (low >= (count))                                                              \
                    break;                                                                       \
                const uint high = flip ? (low ^ (block - 1)) : (low + step);                     \
                if (high >= (count))                                                             \
                    continue;                                                                    \
                const uint key = (keys)[low], other = (keys)[high];                              \
                const uint pair = (pairs)[low], other_pair = (pairs)[high];                      \
                if (key > other || (key == other && pair > other_pair)) {                        \
                    (keys)[low] = other;                                                         \
                    (keys)[high] = key;                                                          \
                    (pairs)[low] = other_pair;                                                   \
                    (pairs)[high] = pair;                                                        \
                }                                                                                \
            }                                                                                    \
        }                                                                                        \
    barrier(fence);

/* Sort each tile's pairs front to back. */
__kernel __attribute__((reqd_work_group_size(BITONIC_GROUP, 1, 1)))
void sort_tiles(
    __global const uint *restrict tile_offset,  // [T+1]
    __global uint *restrict tile_depth,         // [P]
    __global uint *restrict tile_pairs)         // [P]
{
    __local uint keys[SORT_CAPACITY];
    __local uint pairs[SORT_CAPACITY];
    const uint first = tile_offset[get_group_id(0)];
    const uint length = tile_offset[get_group_id(0) + 1] - first;
    if (length <= SORT_CAPACITY) {
        for (uint i = get_local_id(0); i < length; i += BITONIC_GROUP) {
            keys[i] = tile_depth[first + i];
            pairs[i] = tile_pairs[first + i];
        }
        SORT_NETWORK(keys, pairs, length, CLK_LOCAL_MEM_FENCE)
        for (uint i = get_local_id(0); i < length; i += BITONIC_GROUP)
            tile_pairs[first + i] = pairs[i];
    } else {
        SORT_NETWORK(tile_depth + first, tile_pairs + first, length, CLK_GLOBAL_MEM_FENCE)
    }
}
