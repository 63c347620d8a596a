/* The grids of all photographs (color_grid.cl): smoothness and update of one grid, and the mean of all.
 *
 * The smoothness of a grid is, for each axis, the mean of the squared differences of neighboring nodes, times a weight
 * (the total variation of Wang et al. 2024).  A grid is [ENTRIES,nz,ny,nx], whose length may not be a multiple of a
 * vector, so an item computes one value.  Deterministic. */
#undef LANES
#define LANES 1
#include "adam.h"
#include "color_grid.h"
#include "planes.h"

/* The gradient of the smoothness of a photograph's grid, and the term of each value: the differences to the next
 * nodes.  One item = one value. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void color_grid_smoothness(
    __global const float *restrict values,    // [photographs,ENTRIES,nz,ny,nx]
    __global float *restrict grad_smoothness,   // [ENTRIES,nz,ny,nx]
    __global float *restrict terms,           // [ENTRIES,nz,ny,nx]
    const uint first,                         // index of the photograph's first value
    const uint nx,
    const uint ny,
    const uint nz,
    const float weight_x,                     // weight / differences of the axis; 0 for one node
    const float weight_y,
    const float weight_z,
    const uint count)                         // ENTRIES * nz * ny * nx
{
    const uint e = get_global_id(0);
    if (e >= count)
        return;
    const uint nodes[3] = {nx, ny, nz}, steps[3] = {1, nx, nx * ny};
    const float weights[3] = {weight_x, weight_y, weight_z};
    float derivative = 0.0f, term = 0.0f;
    for (uint axis = 0; axis < 3; axis++) {
        const uint node = e / steps[axis] % nodes[axis];
        const float value = values[first + e];
        const float after = node + 1 < nodes[axis] ? values[first + e + steps[axis]] - value : 0.0f;
        const float before = node > 0 ? value - values[first + e - steps[axis]] : 0.0f;
        derivative += 2.0f * weights[axis] * (before - after);
        term += weights[axis] * after * after;
    }
    grad_smoothness[e] = derivative;
    terms[e] = term;
}

/* One update of a photograph's grid by Adam.  One item = one value. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void color_grid_update(
    __global const float *restrict grad_grid,        // [ENTRIES,nz,ny,nx] derivatives of the losses
    __global const float *restrict grad_smoothness,  // [ENTRIES,nz,ny,nx]
    __global float *restrict values,               // [photographs,ENTRIES,nz,ny,nx]
    __global float *restrict moment1,              // [photographs,ENTRIES,nz,ny,nx]
    __global float *restrict moment2,              // [photographs,ENTRIES,nz,ny,nx]
    const uint first,                              // index of the photograph's first value
    const float rate,                              // learning rate / (1 - BETA1^t)
    const float correction2,                       // 1 / (1 - BETA2^t)
    const uint count)                              // ENTRIES * nz * ny * nx
{
    const uint e = get_global_id(0), at = first + e;
    if (e >= count)
        return;
    adam_update(values + at, moment1 + at, moment2 + at, grad_grid[e] + grad_smoothness[e], ALL_LANES, rate,
                correction2,
                EPSILON);
}

/* Subtract from each entry at each level of luminance its mean over photographs and positions: a color change that all
 * photographs share everywhere belongs to the model.  One group of TEAM items = one entry at one level.
 * Local memory: TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void color_grid_center(
    __global float *restrict values,  // [photographs,ENTRIES * nz,positions]
    const uint positions,             // ny * nx
    const uint photographs)
{
    __local float sums[TEAM];
    const uint item = get_local_id(0), photograph_stride = get_num_groups(0) * positions;  // values of a photograph
    __global float *entries = values + get_group_id(0) * positions;
    float total = 0.0f;
    for (uint p = item; p < photographs; p += TEAM) {
        float sum = 0.0f;
        for (uint i = 0; i < positions; i++)
            sum += entries[p * photograph_stride + i];
        total += sum;
    }
    sums[item] = total;
    barrier(CLK_LOCAL_MEM_FENCE);
    const float mean = sum_items(sums) / ((float)positions * (float)photographs);
    for (uint p = item; p < photographs; p += TEAM)
        for (uint i = 0; i < positions; i++)
            entries[p * photograph_stride + i] -= mean;
}
