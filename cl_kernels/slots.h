/* The memory layout of the harmonics above band 0, of their moments and of their gradient.
 *
 * They are in planes [(K-1)*3,S], like the other tables; or, with SH_SLOTS, in slots [slots,(K-1)*3,LANES] for the
 * blocks of LANES Gaussians that a view shows, while the host keeps all other blocks.  Value k of row i is at
 * sh_first(..., i) + k * SH_STRIDE(stride). */
#ifndef CLSPLAT_SLOTS_H
#define CLSPLAT_SLOTS_H
#include "lanes.h"

#define NO_SLOT 0xffffffffu  // slot of a block in host memory

#if SH_SLOTS
#define SH_STRIDE(stride) ((uint)LANES)
#else
#define SH_STRIDE(stride) (stride)
#endif

/* Whether the block of row i is on the device. */
static inline int sh_held(__global const uint *sh_slot, const uint i)
{
#if SH_SLOTS
    return sh_slot[i / LANES] != NO_SLOT;
#else
    return 1;
#endif
}

/* Index of the first value of row i, the first row of its block. */
static inline uint sh_first(__global const uint *sh_slot, const uint sh_block, const uint i)
{
#if SH_SLOTS
    return sh_slot[i / LANES] * sh_block;
#else
    return i;
#endif
}

#endif
