/* Penalties on the scales s, in scene units, and the opacities o of Gaussians: value and gradient.
 *
 *   covariance trace   P = max(sum_j s_j^2 - tau, 0): bounds the size, and the shape only indirectly
 *   anisotropy         A = max(s_max / s_min - r, 0): bounds the shape, independently of the size
 *   scale, opacity     sum_j s_j, and o: a pressure on all Gaussians, which only Gaussians that images need resist
 *   smallest scale     s_min: flattens Gaussians
 *
 * One item = LANES Gaussians; each adds to the gradient and writes one sum.  No local memory.  Deterministic. */
#include "lanes.h"

/* grad_log_scales += weight dP/d(log s).  The bound of a Gaussian is above + pixels^2 nearest^2. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void covariance_trace(
    __global const float *restrict log_scales,  // [3,S] log of scene units
    __global const float *restrict nearest2,    // [S] squared size of a pixel at the nearest view, scene units^2
    __global float *restrict grad_log_scales,   // [3,S]
    __global float *restrict sums,              // [items] sums of P, scene units^2
    const float above,                          // scene units^2
    const float pixels2,                        // px^2; 0: the bound is the same everywhere
    const float weight,                         // scene units^-2
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    VF scale2[3], trace = (VF)(0.0f);
    for (uint k = 0; k < 3; k++) {
        scale2[k] = exp_clamped(2.0f * VLOAD(log_scales + k * stride + i));
        trace += scale2[k];
    }
    const VF excess = trace - (above + pixels2 * VLOAD(nearest2 + i));
    const VI penalized = ((LANE_INDEX + (int)i) < (int)count) & (excess > 0.0f);
    const VF factor = penalized ? (VF)(2.0f * weight) : (VF)(0.0f);
    for (uint k = 0; k < 3; k++)
        VSTORE(VLOAD(grad_log_scales + k * stride + i) + factor * scale2[k], grad_log_scales + k * stride + i);
    sums[get_global_id(0)] = sum_lanes(penalized ? excess : (VF)(0.0f));
}

/* grad_log_scales += weight dA/d(log s): the ratio itself, up for the longest axis and down for the shortest. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void anisotropy(
    __global const float *restrict log_scales,  // [3,S] log of scene units
    __global float *restrict grad_log_scales,   // [3,S]
    __global float *restrict sums,              // [items] sums of A
    const float above,
    const float weight,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    VF scales[3];
    for (uint k = 0; k < 3; k++)
        scales[k] = VLOAD(log_scales + k * stride + i);
    const VF longest = larger(larger(scales[0], scales[1]), scales[2]);
    const VF shortest = smaller(smaller(scales[0], scales[1]), scales[2]);
    const VF ratio = exp_clamped(longest - shortest);
    const VI penalized = ((LANE_INDEX + (int)i) < (int)count) & (ratio > above);
    const VF slope = penalized ? weight * ratio : (VF)(0.0f), zero = (VF)(0.0f);
    for (uint k = 0; k < 3; k++) {
        const VF up = scales[k] == longest ? slope : zero, down = scales[k] == shortest ? slope : zero;
        VSTORE(VLOAD(grad_log_scales + k * stride + i) + (up - down), grad_log_scales + k * stride + i);
    }
    sums[get_global_id(0)] = sum_lanes(penalized ? ratio - above : zero);
}

/* grad_log_scales += weight s. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void mean_scale(
    __global const float *restrict log_scales,  // [3,S] log of scene units
    __global float *restrict grad_log_scales,   // [3,S]
    __global float *restrict sums,              // [items] scene units
    const float weight,                         // scene units^-1
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VI inside = (LANE_INDEX + (int)i) < (int)count;
    VF total = (VF)(0.0f);
    for (uint k = 0; k < 3; k++) {
        const VF scale = inside ? exp_clamped(VLOAD(log_scales + k * stride + i)) : (VF)(0.0f);
        VSTORE(VLOAD(grad_log_scales + k * stride + i) + weight * scale, grad_log_scales + k * stride + i);
        total += scale;
    }
    sums[get_global_id(0)] = sum_lanes(total);
}

/* grad_log_scales += weight s_min, for each axis with the smallest scale. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void min_scale(
    __global const float *restrict log_scales,  // [3,S] log of scene units
    __global float *restrict grad_log_scales,   // [3,S]
    __global float *restrict sums,              // [items] sums of s_min, scene units
    const float weight,                         // scene units^-1
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    VF scales[3];
    for (uint k = 0; k < 3; k++)
        scales[k] = VLOAD(log_scales + k * stride + i);
    const VF shortest = smaller(smaller(scales[0], scales[1]), scales[2]), zero = (VF)(0.0f);
    const VF thickness = (LANE_INDEX + (int)i) < (int)count ? exp_clamped(shortest) : zero;
    for (uint k = 0; k < 3; k++) {
        const VF slope = scales[k] == shortest ? weight * thickness : zero;
        VSTORE(VLOAD(grad_log_scales + k * stride + i) + slope, grad_log_scales + k * stride + i);
    }
    sums[get_global_id(0)] = sum_lanes(thickness);
}

/* grad_logit_opacity += weight o (1 - o). */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void mean_opacity(
    __global const float *restrict logit_opacity,  // [S]
    __global float *restrict grad_logit_opacity,   // [S]
    __global float *restrict sums,                 // [items]
    const float weight,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VF zero = (VF)(0.0f);
    const VI inside = (LANE_INDEX + (int)i) < (int)count;
    const VF opacity = inside ? sigmoid(VLOAD(logit_opacity + i)) : zero;
    VSTORE(VLOAD(grad_logit_opacity + i) + weight * opacity * (1.0f - opacity), grad_logit_opacity + i);
    sums[get_global_id(0)] = sum_lanes(opacity);
}

/* grad_logit_opacity += weight where the logit is above `low`; the sum is that of max(logit - low, 0). */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void opacity_pressure(
    __global const float *restrict logit_opacity,  // [S]
    __global float *restrict grad_logit_opacity,   // [S]
    __global float *restrict sums,                 // [items]
    const float low,                               // logit
    const float weight,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VF zero = (VF)(0.0f);
    const VF excess = VLOAD(logit_opacity + i) - low;
    const VI above = ((LANE_INDEX + (int)i) < (int)count) & (excess > zero);
    VSTORE(VLOAD(grad_logit_opacity + i) + (above ? (VF)(weight) : zero), grad_logit_opacity + i);
    sums[get_global_id(0)] = sum_lanes(above ? excess : zero);
}
