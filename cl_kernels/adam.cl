/* Adam (Kingma and Ba 2015) in the form that 3DGS uses: epsilon outside the root, bias correction by factors from the
 * host, moments of Gaussians without a gradient decay like all others.
 *
 * One item = LANES Gaussians of one plane; dimension 1 is the plane.  Deterministic. */
#include "lanes.h"

#define BETA1 0.9f
#define BETA2 0.999f
#define EPSILON 1.0e-15f

/* One update of one table. */
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
    const VF g = VLOAD(gradient + at);
    const VF m = BETA1 * VLOAD(moment1 + at) + (1.0f - BETA1) * g;
    const VF v = BETA2 * VLOAD(moment2 + at) + (1.0f - BETA2) * (g * g);
    VSTORE(m, moment1 + at);
    VSTORE(v, moment2 + at);
    VSTORE(VLOAD(values + at) - rate * m / (sqrt(v * correction2) + EPSILON), values + at);
}
