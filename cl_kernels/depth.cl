/* Depth instead of color: blending then sums weight times depth, and weight, over splats.
 *
 * One item = one Gaussian.  No local memory.  Deterministic. */
#include "splat.h"

/* Set red to the depth of the mean, green to 1, blue to 0; blended on black, red is the mean depth times alpha and
 * green is alpha, and with MEDIAN_DEPTH (splat.h) blue is the median depth. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void paint_depth(
    __global const float *restrict means,      // [3,S] scene units
    __constant camera_t *restrict camera,       // [1]
    __global float *restrict splats,           // [N,RECORD] see splat.h
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    __constant float *row = camera->world_to_camera + 8;
    __global float *splat = splats + (size_t)i * RECORD;
    splat[SPLAT_RED] = row[0] * means[i] + row[1] * means[stride + i] + row[2] * means[2 * stride + i] + row[3];
    splat[SPLAT_RED + 1] = 1.0f;
    splat[SPLAT_RED + 2] = 0.0f;
}
