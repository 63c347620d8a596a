/* Rows of planes [channels,H',W'], with H', W' whole tiles and zero outside the image; a work-group of TEAM items
 * computes one row.  These functions test whether columns are in the image, and sum over the items. */
#ifndef CLSPLAT_PLANES_H
#define CLSPLAT_PLANES_H
#include "lanes.h"

/* 1 where the column is in the image, else 0. */
static inline VF inside_row(const uint column, const uint width)
{
    return (LANE_INDEX + (int)column) < (int)width ? (VF)(1.0f) : (VF)(0.0f);
}

static inline float sum_items(__local const float *sums)  // [TEAM]
{
    float sum = 0.0f;
    for (uint i = 0; i < TEAM; i++)
        sum += sums[i];
    return sum;
}

#endif
