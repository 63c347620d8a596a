/* Rows that share a vector: each row becomes the weighted mean of the rows of its cluster.
 *
 * x_i <- x_0 + sum_j w_j (x_j - x_0) / sum_j w_j over the members j of its cluster, with x_0 the first: equal
 * rows stay bit-identical.  If all weights are zero, the mean is x_0.
 *
 * No local memory.  Deterministic: the members are summed in the order of their rows, and each value has one writer. */
#include "common.h"

/* Replace the rows of a cluster with their mean.  One item = one cluster of one plane; dimension 1 is the plane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void share_mean(
    __global float *restrict values,        // [components,S]
    __global const float *restrict weight,  // [S] at least 0
    __global const uint *restrict member,   // [N] rows, cluster by cluster
    __global const uint *restrict first,    // [clusters + 1] indices into `member`; the last is N
    const uint stride,
    const uint clusters)
{
    const uint i = get_global_id(0);
    if (i >= clusters || first[i] == first[i + 1])
        return;
    __global float *plane = values + get_global_id(1) * stride;
    const float start = plane[member[first[i]]];
    float sum = 0.0f, total = 0.0f;
    for (uint m = first[i]; m < first[i + 1]; m++) {
        const float w = weight[member[m]];
        sum += w * (plane[member[m]] - start);
        total += w;
    }
    const float mean = total > 0.0f ? start + sum / total : start;
    for (uint m = first[i]; m < first[i + 1]; m++)
        plane[member[m]] = mean;
}
