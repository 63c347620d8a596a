/* Exclusive prefix sum of unsigned integers: sum each block, then scan inside each block from the sum of the earlier
 * blocks.
 *
 * A block is one work-group; each of its TEAM items owns `run` consecutive values, many on CPUs (one item per
 * group) and few on GPUs.  Integer sums: deterministic.  No group depends on another.  Sums saturate at
 * UINT_MAX, in any order of additions, so that the total is never a small number by mistake. */
#include "common.h"

static inline uint saturating_add(const uint a, const uint b)
{
    const uint sum = a + b;
    // Oclgrind 21.10 lacks the saturating addition into which compilers turn `sum < a ? UINT_MAX : sum`.
    const uint carry = ((a & b) | ((a | b) & ~sum)) >> 31;
    return sum | (0u - carry);
}

/* Sum of each block.  Local memory: TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void scan_blocks(
    __global const uint *restrict values,  // [count]
    __global uint *restrict block_sum,     // [blocks]
    const uint run,
    const uint count)
{
    __local uint sums[TEAM];
    const uint item = get_local_id(0);
    const uint first = (get_group_id(0) * TEAM + item) * run;
    uint sum = 0;
    for (uint i = first; i < first + run && i < count; i++)
        sum = saturating_add(sum, values[i]);
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        uint total = 0;
        for (uint i = 0; i < TEAM; i++)
            total = saturating_add(total, sums[i]);
        block_sum[get_group_id(0)] = total;
    }
}

/* offset[i] = sum of the values before i; offset[count] = their total.  Each group adds the sums of all blocks before
 * its own; the host limits their number.  Local memory: TEAM * 8 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void scan_offsets(
    __global const uint *restrict values,     // [count]
    __global const uint *restrict block_sum,  // [blocks] sums of the blocks; not read if there is one block
    __global uint *restrict offset,           // [count+1]
    const uint run,
    const uint count)
{
    __local uint sums[TEAM], sums_before[TEAM];  // of the item's values, and of its part of the earlier blocks
    const uint item = get_local_id(0);
    const uint first = (get_group_id(0) * TEAM + item) * run;
    uint sum = 0;
    for (uint i = first; TEAM > 1 && i < first + run && i < count; i++)  // for the later items
        sum = saturating_add(sum, values[i]);
    uint before = 0;
    for (uint block = item; block < get_group_id(0); block += TEAM)
        before = saturating_add(before, block_sum[block]);
    sums[item] = sum;
    sums_before[item] = before;
    barrier(CLK_LOCAL_MEM_FENCE);
    sum = 0;
    for (uint i = 0; i < TEAM; i++)
        sum = saturating_add(sum, saturating_add(sums_before[i], i < item ? sums[i] : 0));
    for (uint i = first; i < first + run && i < count; i++) {
        offset[i] = sum;
        sum = saturating_add(sum, values[i]);
        if (i + 1 == count)
            offset[count] = sum;
    }
}

/* Reorder values, before the scan of a permuted table.  One item = one position. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void permute(
    __global const uint *restrict values,  // [N]
    __global const uint *restrict order,   // [count] index of the value at each position
    __global uint *restrict permuted,      // [count]
    const uint count)
{
    const uint position = get_global_id(0);
    if (position < count)
        permuted[position] = values[order[position]];
}
