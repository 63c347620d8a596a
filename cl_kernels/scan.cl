/* Exclusive prefix sum of unsigned integers: sum each block, then scan inside each block from the sum of the earlier
 * blocks.
 *
 * A block is one work-group; each of its TEAM items owns `run` consecutive values, many on CPUs (one item per
 * group) and few on GPUs.  Integer sums: deterministic.  No group depends on another.  Sums of 64 bits are
 * limited to UINT_MAX where they are written, so that the total is never a small number by mistake. */
#include "common.h"

static inline uint limited(const ulong sum) { return (uint)min(sum, (ulong)UINT_MAX); }

/* Sum of each block.  Local memory: TEAM * 8 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void scan_blocks(
    __global const uint *restrict values,  // [count]
    __global uint *restrict block_sum,     // [blocks]
    const uint run,
    const uint count)
{
    __local ulong sums[TEAM];
    const uint item = get_local_id(0);
    const uint first = (get_group_id(0) * TEAM + item) * run;
    ulong sum = 0;
    for (uint i = first; i < first + run && i < count; i++)
        sum += values[i];
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        ulong total = 0;
        for (uint i = 0; i < TEAM; i++)
            total += sums[i];
        block_sum[get_group_id(0)] = limited(total);
    }
}

/* offset[i] = sum of the values before i; offset[count] = their total.  Each group adds the sums of all blocks before
 * its own; the host limits their number.  Local memory: TEAM * 16 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void scan_offsets(
    __global const uint *restrict values,     // [count]
    __global const uint *restrict block_sum,  // [blocks] sums of the blocks; not read if there is one block
    __global uint *restrict offset,           // [count+1]
    const uint run,
    const uint count)
{
    __local ulong sums[TEAM], sums_before[TEAM];  // sums of the item's values, and of its part of the earlier blocks
    const uint item = get_local_id(0);
    const uint first = (get_group_id(0) * TEAM + item) * run;
    ulong sum = 0;
    for (uint i = first; TEAM > 1 && i < first + run && i < count; i++)  // for the later items
        sum += values[i];
    ulong before = 0;
    for (uint block = item; block < get_group_id(0); block += TEAM)
        before += block_sum[block];
    sums[item] = sum;
    sums_before[item] = before;
    barrier(CLK_LOCAL_MEM_FENCE);
    sum = 0;
    for (uint i = 0; i < TEAM; i++)
        sum += sums_before[i] + (i < item ? sums[i] : 0);
    for (uint i = first; i < first + run && i < count; i++) {
        offset[i] = limited(sum);
        sum += values[i];
        if (i + 1 == count)
            offset[count] = limited(sum);
    }
}
