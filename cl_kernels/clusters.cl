/* The vector of a palette that is most similar to each point: the one with the largest dot product.
 *
 * The products of a point are summed in the order of its components.  No local memory.  Deterministic. */
#include "lanes.h"

#define FARTHEST 3.0e38f  // larger than all products
#define TOGETHER 8        // vectors that an item compares with its points at once, in registers

/* Compare points with the vectors from `first` to `end`, which must fit in a cache.  Among vectors with equal products,
 * the first is chosen; the label of a point that is NaN is 0.  One item = LANES points. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void most_alike(
    __global const float *restrict points,   // [components,S]
    __global const float *restrict vectors,  // [entries,components]; entries: a multiple of TOGETHER
    __global float *restrict label,          // [S] below 2^24
    __global float *restrict largest,        // [S] the largest product so far
    const uint components,
    const uint first,
    const uint end,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    VF best = first == 0 ? (VF)(-FARTHEST) : VLOAD(largest + i);
    VF best_label = first == 0 ? (VF)(0.0f) : VLOAD(label + i);
    for (uint e = first; e < end; e += TOGETHER) {
        __global const float *v = vectors + (size_t)e * components;
        VF product[TOGETHER];
        for (uint j = 0; j < TOGETHER; j++)
            product[j] = (VF)(0.0f);
        for (uint k = 0; k < components; k++) {
            const VF p = VLOAD(points + k * stride + i);
            for (uint j = 0; j < TOGETHER; j++)
                product[j] += p * v[j * components + k];
        }
        for (uint j = 0; j < TOGETHER; j++) {
            const VI larger = product[j] > best;
            best = larger ? product[j] : best;
            best_label = larger ? (VF)((float)(e + j)) : best_label;
        }
    }
    VSTORE(best, largest + i);
    VSTORE(best_label, label + i);
}
