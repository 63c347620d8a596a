/* Deferred updates of harmonics by Adam, which are postponed until a view shows the Gaussian (adam.h).
 *
 * A Gaussian that a view does not show has a gradient of zero, so that its update depends only on its own value and
 * moments.  These updates are applied later, in order, each with its own factors, and give the same bits as immediate
 * updates.  A block of LANES Gaussians is updated together; `done` counts the updates of the list `factors` that the
 * block has had.  Each update in the list is (rate, correction2), as in adam.h.
 *
 * One item = a block of LANES Gaussians.  No local memory.  Deterministic: each value has one writer. */
#include "adam.h"
#include "slots.h"

/* Apply the pending updates of the list to the blocks with a Gaussian that the view shows.  `every`: all ones to update
 * all blocks. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void replay_updates(
    __global float *restrict values,          // [components,S], or slots (slots.h)
    __global float *restrict moment1,         // [components,S] as values
    __global float *restrict moment2,         // [components,S] as values
    __global const uint *restrict sh_slot,    // [S/LANES] slots.h
    __global const uint *restrict depth_key,  // [S] the view's: all ones when culled; one vector where `every`
    __global const float *restrict factors,   // [updates,2]
    __global uint *restrict done,             // [S/LANES] number of updates of the list that a block has had
    const uint every,
    const uint updates,
    const uint components,
    const uint sh_block,                      // values of a block in a slot
    const uint stride,
    const uint count)
{
    const uint block = get_global_id(0), i = block * LANES;
    if (i >= count)
        return;
    const VI seen = (VLOAD_INT(depth_key + (i & ~every)) != -1) | (VI)((int)every);
    if (!ANY(seen) || !sh_held(sh_slot, i))
        return;
    const uint first = done[block], sh_index = sh_first(sh_slot, sh_block, i);
    if (first >= updates)
        return;
    for (uint k = 0; k < components; k++) {
        const uint at = k * SH_STRIDE(stride) + sh_index;
        VF value = VLOAD(values + at), m = VLOAD(moment1 + at), v = VLOAD(moment2 + at);
        for (uint u = first; u < updates; u++)
            adam_values(&value, &m, &v, (VF)(0.0f), factors[2 * u], factors[2 * u + 1], EPSILON);
        VSTORE(value, values + at);
        VSTORE(m, moment1 + at);
        VSTORE(v, moment2 + at);
    }
    done[block] = updates;
}

/* Append an update to the list, and mark it as done for the blocks with a Gaussian that the view shows. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void note_update(
    __global const uint *restrict depth_key,  // [S] the view's: all ones when culled
    __global float *restrict factors,         // [updates,2]
    __global uint *restrict done,             // [S/LANES]
    const float rate,                         // learning rate / (1 - BETA1^t)
    const float correction2,                  // 1 / (1 - BETA2^t)
    const uint update,                        // its index in the list
    const uint count)
{
    const uint block = get_global_id(0);
    if (block * LANES >= count)
        return;
    if (block == 0) {
        factors[2 * update] = rate;
        factors[2 * update + 1] = correction2;
    }
    if (ANY(VLOAD_INT(depth_key + block * LANES) != -1))
        done[block] = update + 1;
}
