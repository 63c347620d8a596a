/* Operations on rows of tables: sum the gradient records of each Gaussian, reorder tables, write rows from the host.
 * No local memory.  Deterministic: every value has one writer, and sums have a fixed order. */
#include "splat.h"

/* One item = LANES Gaussians; the pairs of a Gaussian are contiguous and summed in order: deterministic. */
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
    __global const sums_part_t *records = (__global const sums_part_t *)pair_sums;
    const size_t parts = RECORD * sizeof(float) / sizeof(sums_part_t);
    sums_part_t table[LANES][SUMS_PARTS];
    for (uint lane = 0; lane < LANES; lane++) {
        float *sums = (float *)table[lane];
        for (uint k = 0; k < SUMS_PARTS; k++)
            table[lane][k] = (sums_part_t)(0.0f);
        if (accumulate)
            for (uint k = 0; k < PIXEL_SUMS; k++)
                sums[k] = pixel_sums[k * stride + i + lane];
        const uint pairs = i + lane < count ? tile_count[i + lane] : 0;
        const uint first = pairs > 0 ? first_pair[i + lane] : 0;
        for (uint pair = first; pair < first + pairs; pair++)
            for (uint k = 0; k < SUMS_PARTS; k++)
                table[lane][k] += records[pair * parts + k];
    }
    for (uint k = 0; k < PIXEL_SUMS; k++) {
        float lanes[LANES];
        for (uint lane = 0; lane < LANES; lane++)
            lanes[lane] = ((const float *)table[lane])[k];
        VSTORE(VLOAD_PRIVATE(lanes), pixel_sums + k * stride + i);
    }
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
