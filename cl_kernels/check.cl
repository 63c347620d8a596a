/* Count the values of a table that are not finite.
 *
 * One item = one Gaussian of one plane; dimension 1 is the plane.  No local memory.  The counter is an integer atomic,
 * so the count does not depend on the order of the items. */
#include "common.h"

/* Add the number of values that are NaN or infinite to the counter. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_not_finite(
    __global const float *restrict values,  // [components,S]
    __global uint *restrict counter,        // [1]
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i < count && !(fabs(values[get_global_id(1) * stride + i]) <= FLT_MAX))
        atomic_inc(counter);
}
