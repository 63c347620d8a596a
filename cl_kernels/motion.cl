/* Moving Gaussians at one time, and the gradient of their motion.
 *
 * A row of the table `motion` is (planes of [W,S])
 *
 *   0-2 velocity v = b_1 · 3 center tau · 4 log of the duration s · from 5 on b_2, then b_3 · last the turn c, 4 planes
 *
 * With dt = t - tau, times in [0, 1] over the scene (FreeTimeGS, Wang et al. 2025; Spacetime Gaussians, Li et al.
 * 2024):
 *
 *   mean(t) = mean + sum_k b_k dt^k     q(t) = q + c dt     alpha(t) = alpha g,  g = exp(-1/2 (dt / s)^2)
 *
 * As a logit, with o the logit of alpha: o + log g - log(1 + e^o (1 - g)), which is exactly o where g is 1: a static,
 * permanent Gaussian has the same bits as one without motion.  With D = 1 + e^o (1 - g), the derivatives of that logit
 * are 1 / D with respect to o, and (1 + e^o) / D with respect to log g.
 *
 * Where g < ALPHA_MIN, a Gaussian is invisible: its mean is infinite, so that the projection culls it, and no statistic
 * counts it as seen.
 *
 * One item = LANES Gaussians.  No local memory.  Deterministic: each value has one writer. */
#include "adam.h"
#include "motion.h"

#define LOGIT_MAX 80.0f  // largest o, so that e^o is finite in float32

/* Plane of the first component of coefficient b_k. */
static inline uint plane_of(const uint k) { return k == 1 ? 0u : 3u * k - 1u; }

typedef struct {
    VF dt, inverse_duration;
    VF log_presence, presence;  // log g and g
    VI present;
} moment_t;

/* The result is written to an address, as in gaussian.h. */
static inline void moment_of(__global const float *motion, const float time, const uint stride, const uint i,
                             moment_t *moment)
{
    moment_t m;
    m.dt = time - VLOAD(motion + MOTION_CENTER * stride + i);
    m.inverse_duration = exp_clamped(-VLOAD(motion + MOTION_DURATION * stride + i));
    const VF distance = m.dt * m.inverse_duration;
    m.log_presence = larger(-0.5f * distance * distance, (VF)(POWER_MIN));
    m.presence = exp_clamped(m.log_presence);
    m.present = m.presence >= ALPHA_MIN;  // false for NaN
    *moment = m;
}

/* Means and logits of opacity at a time. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void move_forward(
    __global const float *restrict motion,         // [W,S] see above
    __global const float *restrict means,          // [3,S] scene units, at the centers
    __global const float *restrict logit_opacity,  // [S] at the centers
    __global float *restrict moved_means,          // [3,S] scene units; infinite where a Gaussian is not present
    __global float *restrict moved_logit,          // [S]
    const float time,                              // time of the view, in [0, 1]
    const uint degree,                             // degree of the polynomial, 1 to 3
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    moment_t m;
    moment_of(motion, time, stride, i, &m);
    for (uint k = 0; k < 3; k++) {
        VF moved = VLOAD(means + k * stride + i), power = m.dt;
        for (uint order = 1; order <= degree; order++) {
            moved = moved + VLOAD(motion + (plane_of(order) + k) * stride + i) * power;
            power = power * m.dt;
        }
        VSTORE((m.present ? moved : (VF)(INFINITY)), moved_means + k * stride + i);
    }
    const VF logit = VLOAD(logit_opacity + i), bounded = smaller(logit, (VF)(LOGIT_MAX));
    const VF faded = bounded + m.log_presence - log_positive(1.0f + exp_clamped(bounded) * (1.0f - m.presence));
    VSTORE((m.presence < 1.0f ? faded : logit), moved_logit + i);
}

/* Quaternions at a time. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void turn_forward(
    __global const float *restrict motion,  // [W,S] see above
    __global const float *restrict quats,   // [4,S] unnormalized, at the centers
    __global float *restrict moved_quats,   // [4,S]
    const float time,                       // time of the view, in [0, 1]
    const uint first,                       // plane of the turn
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VF dt = time - VLOAD(motion + MOTION_CENTER * stride + i);
    for (uint k = 0; k < 4; k++)
        VSTORE(VLOAD(quats + k * stride + i) + VLOAD(motion + (first + k) * stride + i) * dt,
               moved_quats + k * stride + i);
}

/* Gradients of the motion and of the opacity at the center; the gradients of means and quaternions do not change. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void move_backward(
    __global const float *restrict motion,         // [W,S] see above
    __global const float *restrict logit_opacity,  // [S] at the centers
    __global const float *restrict grad_means,     // [3,S] at the time
    __global float *restrict grad_logit_opacity,   // [S] at the time; becomes that at the center
    __global float *restrict grad_motion,          // [W,S]; its turn is unchanged
    const float time,                              // time of the view, in [0, 1]
    const uint degree,                             // degree of the polynomial, 1 to 3
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    moment_t m;
    moment_of(motion, time, stride, i, &m);
    const VF zero = (VF)(0.0f);
    const VF odds = exp_clamped(VLOAD(logit_opacity + i));  // alpha / (1 - alpha)
    const VF divisor = 1.0f + odds * (1.0f - m.presence);
    const VF grad_logit = VLOAD(grad_logit_opacity + i);
    VSTORE((m.present ? grad_logit / divisor : zero), grad_logit_opacity + i);

    VF grad_center = zero;
    for (uint k = 0; k < 3; k++) {
        const VF grad_mean = VLOAD(grad_means + k * stride + i);
        VF power = (VF)(1.0f);
        for (uint order = 1; order <= degree; order++) {
            const uint at = (plane_of(order) + k) * stride + i;
            grad_center = grad_center - grad_mean * VLOAD(motion + at) * (power * (float)order);
            power = power * m.dt;
            VSTORE((m.present ? grad_mean * power : zero), grad_motion + at);
        }
    }
    const VF grad_presence = grad_logit * ((1.0f + odds) / divisor);  // dL/d(log g)
    const VF distance = m.dt * m.inverse_duration;
    grad_center = grad_center + grad_presence * (distance * m.inverse_duration);
    VSTORE((m.present ? grad_center : zero), grad_motion + MOTION_CENTER * stride + i);
    VSTORE((m.present ? grad_presence * (distance * distance) : zero), grad_motion + MOTION_DURATION * stride + i);
}

/* Gradients of the turn, added to those of the center; the gradient of the quaternions does not change.
 * After move_backward. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void turn_backward(
    __global const float *restrict motion,      // [W,S] see above
    __global const float *restrict grad_quats,  // [4,S] at the time
    __global float *restrict grad_motion,       // [W,S]
    const float time,                           // time of the view, in [0, 1]
    const uint first,                           // plane of the turn
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VF dt = time - VLOAD(motion + MOTION_CENTER * stride + i);
    VF grad_center = VLOAD(grad_motion + MOTION_CENTER * stride + i);
    for (uint k = 0; k < 4; k++) {
        const uint at = (first + k) * stride + i;
        const VF grad_quat = VLOAD(grad_quats + k * stride + i);
        VSTORE(grad_quat * dt, grad_motion + at);
        grad_center = grad_center - grad_quat * VLOAD(motion + at);
    }
    VSTORE(grad_center, grad_motion + MOTION_CENTER * stride + i);
}

/* One update of some planes of the motion; values stay within bounds.  Dimension 1 is the plane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void motion_step(
    __global float *restrict motion,          // [W,S] see above
    __global const float *restrict gradient,  // [W,S]
    __global float *restrict moment1,         // [W,S]
    __global float *restrict moment2,         // [W,S]
    __global const uint *restrict depth_key,  // [S] the view's: all ones when culled
    const float rate,                         // learning rate / (1 - BETA1^t)
    const float correction2,                  // 1 / (1 - BETA2^t)
    const float lowest,                       // bounds of the values after an update
    const float highest,
    const uint every,                         // all ones: each Gaussian is updated; 0: only Gaussians not culled
    const uint first,                         // first plane
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VI updated = (VLOAD_INT(depth_key + (i & ~every)) != -1) | (VI)((int)every);
    if (!ANY(updated))
        return;
    const uint at = (first + get_global_id(1)) * stride + i;
    adam_update(motion + at, moment1 + at, moment2 + at, VLOAD(gradient + at), updated, rate, correction2, EPSILON);
    const VF value = VLOAD(motion + at);
    VSTORE((updated ? smaller(larger(value, (VF)(lowest)), (VF)(highest)) : value), motion + at);
}
