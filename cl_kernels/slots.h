/* Where the harmonics above band 0 of a block of LANES Gaussians lie, with their moments and their gradient.
 *
 * In planes [(K-1)*3,S] beside the other tables; or, with SH_SLOTS, in the slots [slots,(K-1)*3,LANES] that the blocks
 * of a view have got, all others being in the memory of the host.  Value k of row i is at
 * sh_first(..., i) + k * SH_STRIDE(stride). */
#ifndef CLSPLAT_SLOTS_H
#define CLSPLAT_SLOTS_H
#include "lanes.h"

#define NO_SLOT 0xffffffffu  // of a block that lies in the memory of the host

#if SH_SLOTS
#define SH_STRIDE(stride) ((uint)LANES)
#else
#define SH_STRIDE(stride) (stride)
#endif

/* Whether the block of row i lies on the device. */
static inline int sh_held(__global const uint *sh_slot, const uint i)
{
#if SH_SLOTS
    return sh_slot[i / LANES] != NO_SLOT;
#else
    return 1;
#endif
}

/* Place of the first value of row i, the first of its block. */
static inline uint sh_first(__global const uint *sh_slot, const uint sh_block, const uint i)
{
#if SH_SLOTS
    return sh_slot[i / LANES] * sh_block;
#else
    return i;
#endif
}

#endif
