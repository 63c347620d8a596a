/* Adam (Kingma and Ba 2015) in the form that 3DGS uses: epsilon outside the root; the host computes the factors of the
 * bias correction; moments of Gaussians without a gradient decay too, unless only Gaussians in the view are updated. */
#ifndef CLSPLAT_ADAM_H
#define CLSPLAT_ADAM_H
#include "lanes.h"

#define BETA1 0.9f
#define BETA2 0.999f
#define EPSILON 1.0e-15f  // as in 3DGS
#define ALL_LANES ((VI)(-1))

/* One update of LANES values and their moments.  rate: learning rate / (1 - BETA1^t);
 * correction2: 1 / (1 - BETA2^t); epsilon: added to the root. */
static inline void adam_values(VF *value, VF *moment1, VF *moment2, const VF g, const float rate,
                               const float correction2, const float epsilon)
{
    const VF m = BETA1 * *moment1 + (1.0f - BETA1) * g;
    const VF v = BETA2 * *moment2 + (1.0f - BETA2) * (g * g);
    *moment1 = m;
    *moment2 = v;
    *value = *value - rate * m / (sqrt(v * correction2) + epsilon);
}

/* One update of LANES values in memory; values that are not `updated` do not change. */
static inline void adam_update(__global float *values, __global float *moment1, __global float *moment2, const VF g,
                               const VI updated, const float rate, const float correction2, const float epsilon)
{
    const VF before = VLOAD(values), m_before = VLOAD(moment1), v_before = VLOAD(moment2);
    VF value = before, m = m_before, v = v_before;
    adam_values(&value, &m, &v, g, rate, correction2, epsilon);
    VSTORE((updated ? m : m_before), moment1);
    VSTORE((updated ? v : v_before), moment2);
    VSTORE((updated ? value : before), values);
}

#endif
