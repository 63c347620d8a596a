/* Adam's update of every parameter.
 *
 * adam_step takes gradients that lie in memory.  update_gaussians computes those of projection on the way, which saves
 * writing and reading 59 of them for each Gaussian; it gives the same bits as project_backward and adam_step.
 *
 * One item = LANES Gaussians.  No local memory.  Deterministic: each value has one writer. */
#include "adam.h"
#include "backward.h"

/* One update of one table.  Dimension 1 is the plane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void adam_step(
    __global float *restrict values,          // [components,S]
    __global const float *restrict gradient,  // [components,S]
    __global float *restrict moment1,         // [components,S]
    __global float *restrict moment2,         // [components,S]
    const float rate,                         // learning rate / (1 - BETA1^t)
    const float correction2,                  // 1 / (1 - BETA2^t)
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const uint at = get_global_id(1) * stride + i;
    adam_update(values + at, moment1 + at, moment2 + at, VLOAD(gradient + at), rate, correction2);
}

static inline void update_planes(__global float *values, __global float *moment1, __global float *moment2,
                                 const VF *gradient, const VI touched, const float rate, const float correction2,
                                 const uint components, const uint stride, const uint i)
{
    for (uint k = 0; k < components; k++) {
        const uint at = k * stride + i;
        const VF g = touched ? gradient[k] : (VF)(0.0f);
        adam_update(values + at, moment1 + at, moment2 + at, g, rate, correction2);
    }
}

/* The update of all tables from the moments of the pixels.  Rates are divided by 1 - BETA1^t. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void update_gaussians(
    __global float *restrict means,                  // [3,S] scene units
    __global float *restrict quats,                  // [4,S] unnormalised
    __global float *restrict log_scales,             // [3,S] log of scene units
    __global float *restrict logit_opacity,          // [S]
    __global float *restrict sh_base,                // [3,S]
    __global float *restrict sh_rest,                // [(K-1)*3,S] coefficient-major
    __global float *restrict means_moment1,          // [3,S]
    __global float *restrict means_moment2,          // [3,S]
    __global float *restrict quats_moment1,          // [4,S]
    __global float *restrict quats_moment2,          // [4,S]
    __global float *restrict log_scales_moment1,     // [3,S]
    __global float *restrict log_scales_moment2,     // [3,S]
    __global float *restrict logit_opacity_moment1,  // [S]
    __global float *restrict logit_opacity_moment2,  // [S]
    __global float *restrict sh_base_moment1,        // [3,S]
    __global float *restrict sh_base_moment2,        // [3,S]
    __global float *restrict sh_rest_moment1,        // [(K-1)*3,S]
    __global float *restrict sh_rest_moment2,        // [(K-1)*3,S]
    __global const float *restrict filter_variance,  // [S] scene units^2
    __constant camera_t *restrict camera,            // [1]
    __global const float *restrict splats,           // [N,RECORD] see splat.h
    __global const float *restrict moments,          // [MOMENTS,S] see splat.h
    __global float *restrict grad_mean2d,            // [2,S] px^-1
    const float near_plane,                          // scene units
    const float screen_variance,                     // px^2
    const float compensate,                          // 0 or 1
    const float means_rate,
    const float quats_rate,
    const float log_scales_rate,
    const float logit_opacity_rate,
    const float sh_base_rate,
    const float sh_rest_rate,
    const float means_correction2,
    const float quats_correction2,
    const float log_scales_correction2,
    const float logit_opacity_correction2,
    const float sh_base_correction2,
    const float sh_rest_correction2,
    const uint degree,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const gradient_t g = gradient_of(means, quats, log_scales, logit_opacity, sh_rest, filter_variance, camera, splats,
                                     moments, near_plane, screen_variance, compensate, degree, stride, count, i);
    for (uint k = 0; k < 2; k++)
        VSTORE((g.touched ? g.mean2d[k] : (VF)(0.0f)), grad_mean2d + k * stride + i);
    update_planes(means, means_moment1, means_moment2, g.means, g.touched, means_rate,
                  means_correction2, 3, stride, i);
    update_planes(quats, quats_moment1, quats_moment2, g.quats, g.touched, quats_rate,
                  quats_correction2, 4, stride, i);
    update_planes(log_scales, log_scales_moment1, log_scales_moment2, g.log_scales, g.touched, log_scales_rate,
                  log_scales_correction2, 3, stride, i);
    update_planes(logit_opacity, logit_opacity_moment1, logit_opacity_moment2, &g.logit_opacity, g.touched,
                  logit_opacity_rate, logit_opacity_correction2, 1, stride, i);
    for (uint k = 0; k < (degree + 1) * (degree + 1); k++) {
        const uint at = k > 0 ? (k - 1) * 3 * stride : 0;
        const VF gradient[3] = {g.basis[k] * g.colour[0], g.basis[k] * g.colour[1], g.basis[k] * g.colour[2]};
        if (k == 0)
            update_planes(sh_base, sh_base_moment1, sh_base_moment2, gradient, g.touched, sh_base_rate,
                          sh_base_correction2, 3, stride, i);
        else
            update_planes(sh_rest + at, sh_rest_moment1 + at, sh_rest_moment2 + at, gradient, g.touched, sh_rest_rate,
                          sh_rest_correction2, 3, stride, i);
    }
}
