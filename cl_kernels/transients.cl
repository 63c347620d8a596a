/* Transients, objects in a photograph that are not part of the scene: residuals, their histogram, and the mask of
 * pixels without large residuals.
 *
 * A residual is the mean over the channels of |image - photograph|; -1 outside the image and in masked pixels.  A bin
 * is an eighth of an octave, from 2^-12 on: its index is the upper bits of the float itself.  Planes are
 * [channels,H',W'] with H', W' whole tiles, zero outside the image.  Counters are integer atomics, so counts do not
 * depend on the order of the items. */
#include "planes.h"

#define BINS 96        // twelve octaves, up to 1; the first and the last also count values beyond
#define BIN_SHIFT 20   // low bits of the mantissa that bins ignore; 3 of 23 remain
#define FIRST_BIN 920  // (127 - 12) * 8: the upper bits of 2^-12

/* Residuals and their histogram.  One group of TEAM items = one row.  Local memory: BINS * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void measure_residuals(
    __global const float *restrict image,       // [3,H',stride]
    __global const float *restrict photograph,  // [3,H',stride]
    __global const float *restrict mask,        // [H',stride] 0 or 1; read where `masked`
    __global float *restrict residuals,         // [H',stride]
    __global uint *restrict numbers,            // [BINS] initially zero
    const uint masked,
    const uint width,
    const uint height,
    const uint rows,                            // H'
    const uint stride)
{
    __local uint row_counts[BINS];
    const uint item = get_local_id(0), y = get_group_id(1), plane = rows * stride;
    for (uint k = item; k < BINS; k += TEAM)
        row_counts[k] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint x = item; x < stride; x += TEAM) {
        const uint at = y * stride + x;
        const bool counts = x < width && y < height && (!masked || mask[at] != 0.0f);
        const float red = fabs(image[at] - photograph[at]);
        const float green = fabs(image[plane + at] - photograph[plane + at]);
        const float blue = fabs(image[2 * plane + at] - photograph[2 * plane + at]);
        const float residual = (red + green + blue) * (1.0f / 3.0f);
        residuals[at] = counts ? residual : -1.0f;
        if (counts)
            atomic_inc(row_counts + clamp((as_int(residual) >> BIN_SHIFT) - FIRST_BIN, 0, BINS - 1));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < BINS; k += TEAM)
        if (row_counts[k] > 0)
            atomic_add(numbers + k, row_counts[k]);
}

/* Write the mask: 1 in pixels whose residual is below a threshold, or where at least 50 % of the residuals in the box
 * around the pixel are below it; else 0.  One item = one pixel; dimension 1 is the row. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void mask_transients(
    __global const float *restrict residuals,  // [H',stride]
    __global float *restrict mask,             // [H',stride]
    const float threshold,
    const uint reach,                          // px from the center of the box to its edges
    const uint width,
    const uint height,
    const uint stride)
{
    const uint x = get_global_id(0), y = get_global_id(1);
    if (x >= stride)
        return;
    const float center = residuals[y * stride + x];
    bool is_counted = !(center < 0.0f);  // NaN counts, so that the losses detect it
    if (is_counted && center >= threshold) {
        uint counted = 0, below = 0;
        for (uint row = y > reach ? y - reach : 0; row <= y + reach && row < height; row++)
            for (uint column = x > reach ? x - reach : 0; column <= x + reach && column < width; column++) {
                const float residual = residuals[row * stride + column];
                counted += residual >= 0.0f;
                below += residual >= 0.0f && residual < threshold;
            }
        is_counted = 2 * below >= counted;
    }
    mask[y * stride + x] = is_counted ? 1.0f : 0.0f;
}
