/* The splitting matrix of each Gaussian (SteepGS, Wang et al. 2025): how much a split would lower the loss.
 *
 * On the screen, with p = dL/dpower, the conic K and d = mean - pixel center:
 *
 *   S2 = sum_pixels dL/dalpha Hessian of alpha with respect to the mean = sum_pixels p (K d d^T K - K)
 *
 * and in the scene S = A^T S2 A with A = d(projected mean)/d(mean), [2,3]: perspective and the shape of the splat are
 * assumed constant over the distance of the children.  One item = one Gaussian.  No local memory.  Deterministic. */
#include "splat.h"

/* Add the splitting matrix of this view. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void accumulate_splitting(
    __global const float *restrict means,       // [3,S] scene units
    __global const float *restrict splats,      // [N,RECORD] see splat.h; all zero when culled
    __global const float *restrict pixel_sums,  // [>SUM_YY,S] see splat.h
    __constant camera_t *restrict camera,       // [1]
    __global float *restrict total,             // [6,S] xx, xy, xz, yy, yz, zz over views, scene units^-2
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || !(splats[(size_t)i * RECORD + SPLAT_OPACITY] > 0.0f))
        return;
    __global const float *splat = splats + (size_t)i * RECORD;
    const float a = splat[SPLAT_XX], b = splat[SPLAT_XY], c = splat[SPLAT_YY];
    const float xx = pixel_sums[SUM_XX * stride + i], xy = pixel_sums[SUM_XY * stride + i];
    const float yy = pixel_sums[SUM_YY * stride + i], power = pixel_sums[SUM_POWER * stride + i];
    const float s_xx = a * a * xx + 2.0f * a * b * xy + b * b * yy - power * a;
    const float s_xy = a * b * xx + (a * c + b * b) * xy + b * c * yy - power * b;
    const float s_yy = b * b * xx + 2.0f * b * c * xy + c * c * yy - power * c;

    __constant const float *w = camera->world_to_camera;
    const float x = means[i], y = means[stride + i], z = means[2 * stride + i];
    const float inverse_z = 1.0f / (w[8] * x + w[9] * y + w[10] * z + w[11]);
    const float ray_x = (w[0] * x + w[1] * y + w[2] * z + w[3]) * inverse_z;
    const float ray_y = (w[4] * x + w[5] * y + w[6] * z + w[7]) * inverse_z;
    float u[3], v[3];  // rows of A, px per scene unit
    for (uint k = 0; k < 3; k++) {
        u[k] = camera->fx * inverse_z * (w[k] - ray_x * w[8 + k]);
        v[k] = camera->fy * inverse_z * (w[4 + k] - ray_y * w[8 + k]);
    }
    uint index = i;
    for (uint k = 0; k < 3; k++)
        for (uint j = k; j < 3; j++, index += stride)
            total[index] += s_xx * u[k] * u[j] + s_xy * (u[k] * v[j] + v[k] * u[j]) + s_yy * v[k] * v[j];
}
