/* Peak rates of the device, for `clsplat bench`.  Training and rendering use no kernel of this file.
 *
 * One item = LANES lanes.  No local memory.  Deterministic. */
#include "lanes.h"

/* 8 independent chains of multiply-add: 16 * rounds operations per lane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void peak_fma(
    __global float *restrict result,  // [items*LANES]
    const float factor,
    const uint rounds)
{
    const uint i = get_global_id(0);
    const VF step = (VF)(0.5f * factor), m = (VF)(factor);
    VF a = (VF)((float)i), b = a + 1.0f, c = a + 2.0f, d = a + 3.0f;
    VF e = a + 4.0f, f = a + 5.0f, g = a + 6.0f, h = a + 7.0f;
    for (uint k = 0; k < rounds; k++) {
        a = a * m + step;
        b = b * m + step;
        c = c * m + step;
        d = d * m + step;
        e = e * m + step;
        f = f * m + step;
        g = g * m + step;
        h = h * m + step;
    }
    VSTORE(((a + b) + (c + d)) + ((e + f) + (g + h)), result + i * LANES);
}

/* The exponential that blending uses: 2 * rounds per lane. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void peak_exp(
    __global float *restrict result,  // [items*LANES]
    const float step,
    const uint rounds)
{
    const uint i = get_global_id(0);
    VF x = (VF)(-0.01f * (float)(i & 7)), y = x - 0.5f, sum = (VF)(0.0f), other = (VF)(0.0f);
    for (uint k = 0; k < rounds; k++) {
        sum += exp_power(x);
        other += exp_power(y);
        x -= step;
        y -= step;
    }
    VSTORE(sum + other, result + i * LANES);
}

/* An item copies a vector of LANES values; or, with one lane, of four values and in the largest groups, since GPUs
 * start small groups too slowly. */
#if LANES == 1
#define PIECE 4
#define COPY_GROUP (TILE * TILE)
typedef float4 piece_t;
#else
#define PIECE LANES
#define COPY_GROUP GROUP
typedef VF_in_memory piece_t;
#endif

/* Copy one PIECE per item. */
__kernel __attribute__((reqd_work_group_size(COPY_GROUP, 1, 1)))
void peak_copy(
    __global const float *restrict values,  // [items*PIECE]
    __global float *restrict copied)        // [items*PIECE]
{
    const size_t i = get_global_id(0) * (size_t)PIECE;
    *(__global piece_t *)(copied + i) = *(__global const piece_t *)(values + i);
}
