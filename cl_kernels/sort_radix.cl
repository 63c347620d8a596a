/* One pass of a stable radix sort of (key, value) pairs: count digits, scan the counts (scan.cl), scatter.
 *
 * A block is one work-group; each of its TEAM items owns a run of consecutive pairs, so that the order in a block is
 * the order of items, and stability needs no atomics.  On CPUs one item per group sorts a long run with wide digits; on
 * GPUs the items of a group sort short runs with narrow digits.  The number of keys may be known only on the device:
 * `key_count`, at most `capacity`, for which the host chooses the number of blocks.
 * Local memory: 4 << DIGIT_BITS bytes * TEAM.  Deterministic. */
#include "common.h"

#define OUTPUT_KEYS 0
#define OUTPUT_CARRIED 1
#define OUTPUT_NONE 2

static inline void count_digits(__global const uint *keys, __local uint *counts, const uint first,
                                const uint run, const uint shift, const uint digits, const uint count)
{
    const uint item = get_local_id(0);
    for (uint digit = 0; digit < digits; digit++)
        counts[digit * TEAM + item] = 0;
    for (uint i = first; i < first + run && i < count; i++)
        counts[((keys[i] >> shift) & (digits - 1)) * TEAM + item]++;
}

/* The number of keys of each item. */
static inline uint run_length(const uint count)
{
    const uint items = get_num_groups(0) * TEAM;
    return count / items + (count % items != 0);
}

/* digit_count[digit][block] = keys of the block with that digit. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void radix_count(
    __global const uint *restrict keys,       // [capacity]
    __global const uint *restrict key_count,  // [1]
    __global uint *restrict digit_count,      // [digits,blocks]
    const uint shift,
    const uint digits,
    const uint capacity)
{
    __local uint counts[TEAM << DIGIT_BITS];
    const uint item = get_local_id(0), block = get_group_id(0), blocks = get_num_groups(0);
    const uint count = min(key_count[0], capacity), run = run_length(count);
    count_digits(keys, counts, (block * TEAM + item) * run, run, shift, digits, count);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint digit = item; digit < digits; digit += TEAM) {
        uint sum = 0;
        for (uint i = 0; i < TEAM; i++)
            sum += counts[digit * TEAM + i];
        digit_count[digit * blocks + block] = sum;
    }
}

/* Move every pair to its position.  In the first pass the values are the indices of the keys: 0, 1, 2, ...  The last
 * pass may write something else instead of the keys. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void radix_scatter(
    __global const uint *restrict keys,          // [capacity]
    __global const uint *restrict values,        // [capacity], not read in the first pass
    __global const uint *restrict key_count,     // [1]
    __global const uint *restrict digit_offset,  // [digits*blocks+1] scanned digit_count
    __global const uint *restrict carried,       // [capacity] by value; read only if they are written
    __global uint *restrict sorted_keys,         // [capacity]
    __global uint *restrict sorted_values,       // [capacity]
    __global uint *restrict digit_first,         // [digits+1] first pair of each digit
    const uint first_pass,
    const uint output,                           // instead of the keys
    const uint shift,
    const uint digits,
    const uint capacity)
{
    __local uint positions[TEAM << DIGIT_BITS];
    const uint item = get_local_id(0), block = get_group_id(0), blocks = get_num_groups(0);
    const uint count = min(key_count[0], capacity), run = run_length(count);
    const uint first = (block * TEAM + item) * run;
    if (TEAM > 1)  // a single item starts at the start of its block
        count_digits(keys, positions, first, run, shift, digits, count);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint digit = item; digit < digits; digit += TEAM) {
        uint position = digit_offset[digit * blocks + block];
        for (uint i = 0; i < TEAM; i++) {
            const uint digits_here = TEAM > 1 ? positions[digit * TEAM + i] : 0;
            positions[digit * TEAM + i] = position;
            position += digits_here;
        }
    }
    for (uint digit = item; block == 0 && digit <= digits; digit += TEAM)
        digit_first[digit] = digit_offset[digit * blocks];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = first; i < first + run && i < count; i++) {
        const uint key = keys[i], value = first_pass ? i : values[i];
        const uint position = positions[((key >> shift) & (digits - 1)) * TEAM + item]++;
        if (output != OUTPUT_NONE)
            sorted_keys[position] = output == OUTPUT_CARRIED ? carried[value] : key;
        sorted_values[position] = value;
    }
}
