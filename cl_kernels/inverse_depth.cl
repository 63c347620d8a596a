/* The loss of inverse depths at the pixels of a view where structure from motion or a file provides them.
 *
 * The fourth plane of the image is D = sum_i w_i / z_i (splat.h), with z the depth of a splat's mean; behind the
 * splats, the depth is infinite.  The loss is sum_k q_k |D(pixel k) - 1/z_k|, times a scale.  With m = sum over
 * pixels of w dL/dD, dL/dz = -m / z^2.
 *
 * No local memory.  Deterministic: no pixel is listed twice, and sums have a fixed order. */
#include "splat.h"

/* Add to the gradient of the fourth plane, and write the loss term of each pixel.  One item = one listed pixel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void inverse_depth_loss(
    __global const float *restrict image,     // [4,H',stride]
    __global float *restrict gradient,        // [4,H',stride]
    __global const uint *restrict pixels,     // [count] distinct indices in a plane
    __global const float *restrict targets,   // [count] 1/z, scene units^-1
    __global const float *restrict weights,   // [count] q
    __global float *restrict terms,           // [count] q |D - 1/z|
    const float scale,                        // scene units
    const uint plane,                         // H' stride
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint at = 3 * plane + pixels[i];
    const float difference = image[at] - targets[i];
    terms[i] = weights[i] * fabs(difference);
    gradient[at] += scale * weights[i] * (difference > 0.0f ? 1.0f : (difference < 0.0f ? -1.0f : 0.0f));
}

/* Sum the last field of each Gaussian's gradient records, m.  One item = one Gaussian. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sum_inverse_depths(
    __global const float *restrict pair_sums,  // [P,RECORD]
    __global const uint *restrict first_pair,  // [N]
    __global const uint *restrict tile_count,  // [N]
    __global float *restrict sums,             // [S]
    const uint accumulate,                     // 1: add to `sums`
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    float sum = accumulate ? sums[i] : 0.0f;
    const uint first = tile_count[i] > 0 ? first_pair[i] : 0;
    for (uint pair = first; pair < first + tile_count[i]; pair++)
        sum += pair_sums[(size_t)pair * RECORD + SUM_INVERSE_DEPTH];
    sums[i] = sum;
}

/* Add the gradient of the means through their depths.  One item = one Gaussian. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void inverse_depth_backward(
    __global const float *restrict splats,  // [N,RECORD]
    __global const float *restrict sums,    // [S] m
    __constant camera_t *restrict camera,   // [1]
    __global float *restrict grad_means,    // [3,S]
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const float inverse = splats[(size_t)i * RECORD + SPLAT_INVERSE_DEPTH];
    const float grad_depth = -sums[i] * inverse * inverse;
    for (uint k = 0; k < 3; k++)
        grad_means[k * stride + i] += camera->world_to_camera[8 + k] * grad_depth;
}
