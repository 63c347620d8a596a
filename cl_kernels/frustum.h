/* The part of a cone between two distances, approximated by a normal distribution (Barron et al. 2021, equations 7 and
 * 8): with m = (t0 + t1) / 2, h = (t1 - t0) / 2 and s = 3 m^2 + h^2
 *
 *   mean along the ray   m + 2 m h^2 / s
 *   variance along it    h^2 / 3 - 4/15 h^4 (12 m^2 - h^2) / s^2
 *   variance across it   r^2 (m^2 / 4 + 5/12 h^2 - 4/15 h^4 / s)
 *
 * Distances are those of a direction with depth 1 in the camera. */
#ifndef CLSPLAT_FRUSTUM_H
#define CLSPLAT_FRUSTUM_H
#include "lanes.h"

#define RAY_VALUES_READ 8  // values of a ray, as rays.cl writes them: o, d, radius of the cone, |d|

typedef struct {
    VF distance;  // distance of the mean
    VF along;     // variance along the ray, in squares of the distance
    VF across;    // variance across the ray, in squares of scene units
} frustum_t;

/* The distribution of LANES samples of one ray between the edges t0 and t1. */
static inline frustum_t frustum_of(__global const float *cone, const VF t0, const VF t1)
{
    frustum_t f;
    const VF m = 0.5f * (t0 + t1), h = 0.5f * (t1 - t0), m2 = m * m, h2 = h * h, s = 3.0f * m2 + h2;
    f.distance = m + 2.0f * m * h2 / s;
    f.along = h2 / 3.0f - (4.0f / 15.0f) * (h2 * h2) * (12.0f * m2 - h2) / (s * s);
    f.across = cone[6] * cone[6] * (0.25f * m2 + (5.0f / 12.0f) * h2 - (4.0f / 15.0f) * (h2 * h2) / s);
    return f;
}

#endif
