/* Operations on rows of tables: sum the gradient records of each Gaussian, reorder tables, write rows from the host.
 * No local memory.  Deterministic: every value has one writer, and sums have a fixed order. */
#include "pair_sums.h"

/* One item = LANES Gaussians. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sum_records(
    __global const float *restrict pair_sums,  // [P,RECORD]
    __global const uint *restrict first_pair,  // [N]
    __global const uint *restrict tile_count,  // [N]
    __global float *restrict pixel_sums,       // [PIXEL_SUMS,S]
    const uint accumulate,                     // 1: add to the sums in `pixel_sums`
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    VF m[PIXEL_SUMS];
    sum_pairs(pair_sums, first_pair, tile_count, pixel_sums, accumulate, stride, count, i, m);
    for (uint k = 0; k < PIXEL_SUMS; k++)
        VSTORE(m[k], pixel_sums + k * stride + i);
}

/* Row i of `moved` is row source[i] of `table`; fresh rows are zero where `zero_fresh` is 1.
 * One item = one row of one plane; dimension 1 is the plane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void gather_rows(
    __global const float *restrict table,  // [components,table_stride]
    __global const uint *restrict source,  // [count]
    __global const uint *restrict fresh,   // [count] 0 or 1
    __global float *restrict moved,        // [components,moved_stride]
    const uint zero_fresh,
    const uint table_stride,
    const uint moved_stride,
    const uint count)
{
    const uint i = get_global_id(0), plane = get_global_id(1);
    if (i >= count)
        return;
    moved[plane * moved_stride + i] = zero_fresh && fresh[i] ? 0.0f : table[plane * table_stride + source[i]];
}

/* Write rows from the host; no row occurs twice.  One item = one value; dimensions row, plane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void set_rows(
    __global const uint *restrict rows,     // [count]
    __global const float *restrict values,  // [count,components]
    __global float *restrict table,         // [components,stride]
    const uint components,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0), plane = get_global_id(1);
    if (i < count)
        table[plane * stride + rows[i]] = values[i * components + plane];
}

/* Set rows to zero.  One item = one value; dimensions row, plane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void zero_rows(
    __global const uint *restrict rows,  // [count]
    __global float *restrict table,      // [components,stride]
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0), plane = get_global_id(1);
    if (i < count)
        table[plane * stride + rows[i]] = 0.0f;
}
