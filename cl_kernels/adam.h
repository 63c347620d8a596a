/* Adam (Kingma and Ba 2015) in the form that 3DGS uses: epsilon outside the root; the host computes the factors of the
 * bias correction; moments of Gaussians without a gradient decay as all others do. */
#ifndef CLSPLAT_ADAM_H
#define CLSPLAT_ADAM_H
#include "lanes.h"

#define BETA1 0.9f
#define BETA2 0.999f
#define EPSILON 1.0e-15f

/* One update of LANES values.  rate: learning rate / (1 - BETA1^t); correction2: 1 / (1 - BETA2^t). */
static inline void adam_update(__global float *values, __global float *moment1, __global float *moment2, const VF g,
                               const float rate, const float correction2)
{
    const VF m = BETA1 * VLOAD(moment1) + (1.0f - BETA1) * g;
    const VF v = BETA2 * VLOAD(moment2) + (1.0f - BETA2) * (g * g);
    VSTORE(m, moment1);
    VSTORE(v, moment2);
    VSTORE(VLOAD(values) - rate * m / (sqrt(v * correction2) + EPSILON), values);
}

#endif
