/* Penalties on the motion of Gaussians: value and gradient.  Planes of `motion` as in motion.cl; s is the duration.
 *
 *   motion_l2       min(s, 1) |v|: the distance traveled during s, at most the scene's duration; s is a constant
 *   short_duration  max(log(s_0 / s), 0): how much shorter s is than s_0
 *
 * One item = LANES Gaussians; each adds to the gradient and writes one sum.  No local memory.  Deterministic. */
#include "motion.h"

#define SPEED2_MIN 1.0e-20f  // (scene units by the scene's duration)^2, below which nothing moves

/* grad_motion += weight d(motion_l2)/d(v). */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void motion_l2(
    __global const float *restrict motion,  // [W,S]
    __global float *restrict grad_motion,   // [W,S]
    __global float *restrict sums,          // [items] sums of min(s, 1) |v|, scene units
    const float weight,                     // scene units^-1
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VI inside = (LANE_INDEX + (int)i) < (int)count;
    VF v[3], speed2 = (VF)(0.0f);
    for (uint k = 0; k < 3; k++) {
        v[k] = VLOAD(motion + k * stride + i);
        speed2 = speed2 + v[k] * v[k];
    }
    const VI moves = inside & (speed2 > SPEED2_MIN);
    const VF speed = sqrt(moves ? speed2 : (VF)(1.0f));
    const VF time = exp_clamped(smaller(VLOAD(motion + MOTION_DURATION * stride + i), (VF)(0.0f)));
    const VF factor = moves ? weight * time / speed : (VF)(0.0f);
    for (uint k = 0; k < 3; k++)
        VSTORE(VLOAD(grad_motion + k * stride + i) + factor * v[k], grad_motion + k * stride + i);
    sums[get_global_id(0)] = sum_lanes(moves ? time * speed : (VF)(0.0f));
}

/* grad_motion += weight d(short_duration)/d(log s). */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void short_duration(
    __global const float *restrict motion,  // [W,S]
    __global float *restrict grad_motion,   // [W,S]
    __global float *restrict sums,          // [items] sums of max(log(s_0 / s), 0)
    const float log_below,                  // log of s_0
    const float weight,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const uint at = MOTION_DURATION * stride + i;
    const VF shorter = log_below - VLOAD(motion + at);
    const VI penalized = ((LANE_INDEX + (int)i) < (int)count) & (shorter > 0.0f);
    VSTORE(VLOAD(grad_motion + at) - (penalized ? (VF)(weight) : (VF)(0.0f)), grad_motion + at);
    sums[get_global_id(0)] = sum_lanes(penalized ? shorter : (VF)(0.0f));
}
