/* Sums over the pixels of LANES Gaussians from the gradient records of their pairs with tiles, which are contiguous and
 * are added in order, so that the sums have a fixed order. */
#ifndef CLSPLAT_PAIR_SUMS_H
#define CLSPLAT_PAIR_SUMS_H
#include "splat.h"

/* accumulate: 1 to start with the sums in `pixel_sums`; m: [PIXEL_SUMS] */
static inline void sum_pairs(
    __global const float *pair_sums,   // [P,RECORD]
    __global const uint *first_pair,   // [N]
    __global const uint *tile_count,   // [N]
    __global const float *pixel_sums,  // [PIXEL_SUMS,S]
    const uint accumulate, const uint stride, const uint count, const uint i, VF *m)
{
    __global const sums_part_t *records = (__global const sums_part_t *)pair_sums;
    const size_t parts = RECORD * sizeof(float) / sizeof(sums_part_t);
    sums_part_t table[LANES][SUMS_PARTS];
    for (uint lane = 0; lane < LANES; lane++) {
        float *sums = (float *)table[lane];
        for (uint k = 0; k < SUMS_PARTS; k++)
            table[lane][k] = (sums_part_t)(0.0f);
        if (accumulate)
            for (uint k = 0; k < PIXEL_SUMS; k++)
                sums[k] = pixel_sums[k * stride + i + lane];
        const uint pairs = i + lane < count ? tile_count[i + lane] : 0;
        const uint first = pairs > 0 ? first_pair[i + lane] : 0;
        for (uint pair = first; pair < first + pairs; pair++)
            for (uint k = 0; k < SUMS_PARTS; k++)
                table[lane][k] += records[pair * parts + k];
    }
    for (uint k = 0; k < PIXEL_SUMS; k++) {
        float lanes[LANES];
        for (uint lane = 0; lane < LANES; lane++)
            lanes[lane] = ((const float *)table[lane])[k];
        m[k] = VLOAD_PRIVATE(lanes);
    }
}

#endif
