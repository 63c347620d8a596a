/* A penalty on opacities o between 0 and 1: the binary entropy H = -o ln o - (1 - o) ln (1 - o) = ln(1 + e^a) - a o,
 * with the logit a = ln o - ln (1 - o); dH/da = -a o (1 - o).
 *
 * One item = LANES Gaussians; each adds to the gradient and writes its own sum.  No local memory.  Deterministic. */
#include "lanes.h"

/* grad_logit_opacity += weight dH/da. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void opacity_entropy(
    __global const float *restrict logit_opacity,  // [S]
    __global float *restrict grad_logit_opacity,   // [S]
    __global float *restrict sums,                 // [items] sums of H
    const float weight,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VF a = VLOAD(logit_opacity + i), o = sigmoid(a), zero = (VF)(0.0f);
    const VF entropy = larger(a, zero) + log(1.0f + exp_clamped(-fabs(a))) - a * o;
    const VI inside = (LANE_INDEX + (int)i) < (int)count;
    const VF slope = inside ? weight * a * o * (1.0f - o) : zero;
    VSTORE(VLOAD(grad_logit_opacity + i) - slope, grad_logit_opacity + i);
    sums[get_global_id(0)] = sum_lanes(inside ? entropy : zero);
}
