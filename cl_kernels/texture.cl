/* Gradient magnitude of an image: |Sobel| / 8 of its luminance (Rec. 601 weights), per px; edge pixels are repeated
 * outward.
 *
 * One item = LANES pixels of a row.  No local memory.  Deterministic. */
#include "splat.h"

static inline VF luminance_at(__global const float *image, const uint plane, const uint at)
{
    return 0.299f * VLOAD(image + at) + 0.587f * VLOAD(image + plane + at) + 0.114f * VLOAD(image + 2 * plane + at);
}

static inline float luminance_of(__global const float *image, const uint plane, const uint at)
{
    return 0.299f * image[at] + 0.587f * image[plane + at] + 0.114f * image[2 * plane + at];
}

/* Luminance of LANES pixels of a row with a neighbor on either side, [LANES + 2]; `x` is in the image. */
static inline void load_line(__global const float *image, const uint plane, const uint row, const uint x,
                             const uint width, float *line)
{
    const float last = luminance_of(image, plane, row + width - 1);
    line[0] = luminance_of(image, plane, row + (x > 0 ? x - 1 : 0));
    VSTORE_PRIVATE(luminance_at(image, plane, row + x), line + 1);
    line[LANES + 1] = x + LANES < width ? luminance_of(image, plane, row + x + LANES) : last;
    for (uint k = width - x; k < LANES; k++)
        line[1 + k] = last;
}

/* Gradient magnitudes, per px; zero outside the image.  Dimension 1 is the row. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void image_gradient(
    __global const float *restrict image,  // [3,H',stride] in [0, 1]
    __global float *restrict magnitude,    // [H',stride]
    const uint width,
    const uint height,
    const uint rows,                       // H'
    const uint stride)
{
    const uint x = get_global_id(0) * LANES, y = get_global_id(1), plane = rows * stride;
    if (x >= stride)
        return;
    if (x >= width || y >= height) {
        VSTORE((VF)(0.0f), magnitude + y * stride + x);
        return;
    }
    float above[LANES + 2], here[LANES + 2], below[LANES + 2];
    load_line(image, plane, (y > 0 ? y - 1 : 0) * stride, x, width, above);
    load_line(image, plane, y * stride, x, width, here);
    load_line(image, plane, (y + 1 < height ? y + 1 : y) * stride, x, width, below);
    const VF above_left = VLOAD_PRIVATE(above), above_right = VLOAD_PRIVATE(above + 2);
    const VF below_left = VLOAD_PRIVATE(below), below_right = VLOAD_PRIVATE(below + 2);
    const VF across = (above_right - above_left) + 2.0f * (VLOAD_PRIVATE(here + 2) - VLOAD_PRIVATE(here)) +
                      (below_right - below_left);
    const VF down = (below_left - above_left) + 2.0f * (VLOAD_PRIVATE(below + 1) - VLOAD_PRIVATE(above + 1)) +
                    (below_right - above_right);
    const VF inside = (LANE_INDEX + (int)x) < (int)width ? (VF)(1.0f) : (VF)(0.0f);
    VSTORE(inside * 0.125f * sqrt(across * across + down * down), magnitude + y * stride + x);
}

/* Set the magnitude of masked pixels and of their neighbors to -1, which means unknown.  One item = one pixel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void hide_masked(
    __global const float *restrict mask,  // [H',stride] 0 or 1
    __global float *restrict magnitude,   // [H',stride] per px
    const uint width,
    const uint height,
    const uint stride)
{
    const uint x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height)
        return;
    const uint left = x > 0 ? x - 1 : 0, right = x + 1 < width ? x + 1 : x;
    bool known = true;
    for (uint row = y > 0 ? y - 1 : 0; row <= y + 1 && row < height; row++)
        known &= (mask[row * stride + left] > 0.0f) & (mask[row * stride + x] > 0.0f) &
                 (mask[row * stride + right] > 0.0f);
    if (!known)
        magnitude[y * stride + x] = -1.0f;
}

/* Add to each visible Gaussian the magnitude at its projected mean, from the nearest pixel of the image; 0 where it is
 * unknown. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sample_magnitude(
    __global const float *restrict magnitude,  // [H',stride] per px, negative: unknown
    __global const float *restrict splats,     // [N,RECORD] see splat.h
    __global const float *restrict radius,     // [S] px, 0 = not visible
    __global float *restrict total,            // [S]
    const uint width,
    const uint height,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || !(radius[i] > 0.0f))
        return;
    __global const float *splat = splats + (size_t)i * RECORD;
    const float x = splat[SPLAT_X], y = splat[SPLAT_Y], right = (float)(width - 1), bottom = (float)(height - 1);
    const uint column = (uint)(x > 0.0f ? (x < right ? x : right) : 0.0f);
    const uint row = (uint)(y > 0.0f ? (y < bottom ? y : bottom) : 0.0f);
    const float sample = magnitude[row * stride + column];
    total[i] += sample > 0.0f ? sample : 0.0f;
}
