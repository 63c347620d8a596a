/* Noise on the means of Gaussians, more for lower opacities (3DGS-MCMC, Kheradmand et al. 2024):
 *
 *   mean += rate / (1 + exp(-100 (opacity_below - opacity))) Sigma n,  Sigma = R diag(s^2) R^T,  n: normal, [3]
 *
 * Gaussians with an opacity above opacity_below + REACH get no noise.  One item = one Gaussian.  No local memory.
 * Random numbers depend only on (seed, step, Gaussian). */
#include "random.h"

__constant float SHARPNESS = 100.0f;  // per unit of opacity: how fast the noise falls at opacity_below
__constant float REACH = 0.1f;        // beyond it, the noise is below 5e-5 of its maximum

/* Move every mean. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void add_noise(
    __global float *restrict means,                // [3,S] scene units
    __global const float *restrict quats,          // [4,S] unnormalized
    __global const float *restrict log_scales,     // [3,S] log of scene units
    __global const float *restrict logit_opacity,  // [S]
    const float rate,                              // scene units^-1
    const float opacity_below,                     // opacity with 50 % of the noise
    const uint seed,
    const uint step,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const float opacity = 1.0f / (1.0f + exp(-logit_opacity[i]));
    if (opacity > opacity_below + REACH)
        return;
    const float4 q = normalize((float4)(quats[i], quats[stride + i], quats[2 * stride + i], quats[3 * stride + i]));
    const float w = q.x, x = q.y, y = q.z, z = q.w;
    const float3 rows[3] = {
        (float3)(1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y)),
        (float3)(2.0f * (x * y + w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x)),
        (float3)(2.0f * (x * z - w * y), 2.0f * (y * z + w * x), 1.0f - 2.0f * (x * x + y * y))};
    const float3 normal = normal3((uint4)(i, step, 1, 0), (uint2)(seed, 0));
    const float gate = rate / (1.0f + exp(-SHARPNESS * (opacity_below - opacity)));
    const float3 scale = exp((float3)(log_scales[i], log_scales[stride + i], log_scales[2 * stride + i]));
    const float3 turned = rows[0] * normal.x + rows[1] * normal.y + rows[2] * normal.z;  // R^T n
    const float3 scaled = scale * scale * turned;  // Sigma n in the axes of the Gaussian
    for (uint k = 0; k < 3; k++)
        means[k * stride + i] += gate * dot(rows[k], scaled);
}
