/* The derivatives of the losses with respect to the pose and focal length of a camera, as sums over Gaussians.
 *
 * Moving a camera is equivalent to moving all Gaussians the other way: rotating it by -w about its center c rotates
 * means, quaternions and viewing directions by w.  The view-dependent colors do not rotate with them, so the derivative
 * with respect to the direction d from c, which is part of dL/dp, is subtracted.  With a mean p and a quaternion (a,
 * v), whose derivatives are (g_a, g_v), in world axes
 *
 *   shift   sum dL/dp
 *   turn    sum (p - c) x dL/dp - d x dL/dd + 1/2 (a g_v - g_a v + v x g_v)
 *   focal   sum of dL/dln f, where both focal lengths are multiplied by f (backward.h)
 *
 * dL/dq has no part along q, so the length of q does not matter.  The world filter is isotropic, so it does not rotate.
 *
 * One item = LANES Gaussians; one group of POSE_GROUP items writes its sums, which the host adds in 64 bits in their
 * order.  Local memory: POSE_GROUP * POSE_SUMS * 4 bytes.  Deterministic. */
#include "backward.h"

#define POSE_GROUP 32  // items per work-group
#define POSE_SUMS 7    // shift, turn, focal

/* The terms of LANES Gaussians; zero where they were not rendered. */
static inline void pose_terms(
    __global const float *means, __global const float *quats, __constant camera_t *camera, const gradient_t *g,
    const VF *weights, const uint degree, const uint stride, const uint i, VF *terms)
{
    VF d[3], gd[3] = {0.0f, 0.0f, 0.0f}, offset[3], q[4];
    view_direction(means, camera, stride, i, d);
    harmonics_direction_gradient(degree, d[0], d[1], d[2], weights, gd, gd + 1, gd + 2);
    for (uint k = 0; k < 3; k++)
        offset[k] = VLOAD(means + k * stride + i) - camera->position[k];
    for (uint k = 0; k < 4; k++)
        q[k] = VLOAD(quats + k * stride + i);
    for (uint k = 0; k < 3; k++) {
        const uint m = (k + 1) % 3, n = (k + 2) % 3;
        const VF by_position = offset[m] * g->means[n] - offset[n] * g->means[m] - (d[m] * gd[n] - d[n] * gd[m]);
        const VF by_rotation = q[0] * g->quats[1 + k] - g->quats[0] * q[1 + k] +
                          (q[1 + m] * g->quats[1 + n] - q[1 + n] * g->quats[1 + m]);
        terms[k] = g->touched ? g->means[k] : (VF)(0.0f);
        terms[3 + k] = g->touched ? by_position + 0.5f * by_rotation : (VF)(0.0f);
    }
    terms[6] = g->touched ? g->focal : (VF)(0.0f);
}

/* The sums of each group, from the sums over pixels of each Gaussian. */
__kernel __attribute__((reqd_work_group_size(POSE_GROUP, 1, 1)))
void pose_gradient(
    __global const float *restrict means,            // [3,S] scene units
    __global const float *restrict quats,            // [4,S] unnormalized
    __global const float *restrict log_scales,       // [3,S] log of scene units
    __global const float *restrict logit_opacity,    // [S]
    __global const float *restrict sh_rest,          // [(K-1)*3,S] coefficient-major, or slots (slots.h)
    __global const uint *restrict sh_slot,           // [S/LANES] slots.h
    __global const float *restrict filter_variance,  // [S] scene units^2
    __constant camera_t *restrict camera,            // [1]
    __global const float *restrict splats,           // [N,RECORD] see splat.h
    __global const float *restrict pixel_sums,       // [PIXEL_SUMS,S] see splat.h
    __global float *restrict sums,                   // [POSE_SUMS,groups]
    const float near_plane,                          // scene units
    const float screen_variance,                     // px^2
    const float compensate,                          // 0 or 1
    const uint degree,
    const uint sh_block,                             // values of a block in a slot
    const uint stride,
    const uint count)
{
    __local float parts[POSE_SUMS][POSE_GROUP];
    const uint item = get_local_id(0), i = get_global_id(0) * LANES;
    for (uint k = 0; k < POSE_SUMS; k++)
        parts[k][item] = 0.0f;
    if (i < count) {
        gradient_t g;
        VF weights[1][16], m[PIXEL_SUMS], terms[POSE_SUMS];
        const uint sh_index = sh_first(sh_slot, sh_block, i);
        load_sums(pixel_sums, stride, i, m);
        color_backward(splats, m, count, i, &g);
        weigh_harmonics(sh_rest, &g, 1, !ANY(g.touched), degree, stride, &sh_index, weights);
        gradient_of(means, quats, log_scales, logit_opacity, filter_variance, camera, m, weights[0],
                    near_plane, screen_variance, compensate, degree, stride, i, &g);
        pose_terms(means, quats, camera, &g, weights[0], degree, stride, i, terms);
        for (uint k = 0; k < POSE_SUMS; k++)
            parts[k][item] = sum_lanes(terms[k]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < POSE_SUMS; k += POSE_GROUP) {
        float sum = 0.0f;
        for (uint other = 0; other < POSE_GROUP; other++)
            sum += parts[k][other];
        sums[k * get_num_groups(0) + get_group_id(0)] = sum;
    }
}
