/* k-means: the nearest vector of each point (Lloyd 1982), and sums of the points of each vector.
 *
 * Points and vectors are whole numbers in floats, so small that every sum of products is below 2^24: float32 holds each
 * exactly, and no order of additions changes a bit.  The squared distance by 2 is |p|^2 / 2 + (|v|^2 / 2 - p . v).
 * No local memory.  Deterministic. */
#include "lanes.h"

#define FARTHEST 3.0e38f  // beyond all distances
#define TOGETHER 8        // vectors that an item compares with its points together, in registers

/* Go on with some of the vectors: those from `first` on, few enough to stay in a cache.  Of vectors that are equally
 * near the first counts; 0 for a point that is not a number.  One item = LANES points. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void nearest_vectors(
    __global const float *restrict points,   // [components,S] whole numbers
    __global const float *restrict vectors,  // [entries,components] whole numbers; entries: a multiple of TOGETHER
    __global const float *restrict norm,     // [entries] |v|^2 / 2; FARTHEST where there is no vector
    __global float *restrict label,          // [S] below 2^24
    __global float *restrict apart,          // [S] |v|^2 / 2 - p . v of the nearest vector so far
    const uint components,
    const uint first,
    const uint end,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    VF nearest = first == 0 ? (VF)(FARTHEST) : VLOAD(apart + i);
    VF found = first == 0 ? (VF)(0.0f) : VLOAD(label + i);
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
            const VF difference = norm[e + j] - product[j];
            const VI nearer = difference < nearest;
            nearest = nearer ? difference : nearest;
            found = nearer ? (VF)((float)(e + j)) : found;
        }
    }
    VSTORE(nearest, apart + i);
    VSTORE(found, label + i);
}

/* sums += points by their label.  Integer atomics: the sums do not depend on the order of the items.  One item = one
 * value; dimension 1 is the component.  What is not a number counts as 0. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sum_members(
    __global const float *restrict points,  // [components,S] whole numbers
    __global const float *restrict label,   // [S] below entries
    __global int *restrict sums,            // [entries,components]
    const uint components,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0), k = get_global_id(1);
    if (i >= count)
        return;
    const float p = points[k * stride + i];
    if (p == p)
        atomic_add(sums + (uint)label[i] * components + k, (int)p);
}
