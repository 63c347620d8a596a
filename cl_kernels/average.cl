/* The average of every parameter over steps (Polyak and Juditsky 1992).  Each row counts its own steps, so that a new
 * Gaussian starts a new average.  One item = one row of one plane; dimension 1 is the plane.  No local memory.
 * Deterministic: each value has one writer. */
#include "splat.h"

/* Add the values to their averages; `number` is unchanged. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void add_to_average(
    __global const float *restrict values,  // [components,S]
    __global float *restrict average,       // [components,S]
    __global const float *restrict number,  // [S] steps before this one
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0), at = get_global_id(1) * stride + i;
    if (i >= count)
        return;
    average[at] += (values[at] - average[at]) / (number[i] + 1.0f);
}

/* Add one to the step counts. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_step(
    __global float *restrict number,  // [S] steps
    const uint count)
{
    const uint i = get_global_id(0);
    if (i < count)
        number[i] += 1.0f;
}

/* Replace values with their averages in rows that have an average. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void take_average(
    __global float *restrict values,         // [components,S]
    __global const float *restrict average,  // [components,S]
    __global const float *restrict number,   // [S] steps
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0), at = get_global_id(1) * stride + i;
    if (i < count && number[i] > 0.0f)
        values[at] = average[at];
}
