/* Select the Gaussians that a step drops (DropGaussian, Park et al. 2025), each with the same probability, and the
 * Gaussians that its view hides.
 *
 * One item = one Gaussian.  No local memory.  The random numbers depend only on (seed, step, Gaussian). */
#include "random.h"

/* Mark the Gaussians that are left out: at random, or because the view hides them. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void draw_left_out(
    __global const float *restrict hidden,  // [planes,S] integers: bits of the views that hide a Gaussian
    __global float *restrict left_out,      // [S] 0 or 1
    const uint below,                       // probability times 2^32
    const uint hidden_plane,                // plane of the view's bit in `hidden`
    const uint hidden_bit,                  // the view's bit; 0: no Gaussian is hidden
    const uint seed,
    const uint step,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint bits = hidden_bit ? (uint)hidden[hidden_plane * stride + i] & hidden_bit : 0;
    const bool drawn = philox((uint4)(i, step, 2, 0), (uint2)(seed, 0)).x < below;
    left_out[i] = drawn || bits ? 1.0f : 0.0f;
}
