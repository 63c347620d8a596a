/* A Gaussian blur of an image: the weighted mean of the valid pixels, so that neither edges nor a mask darken the
 * result.
 *
 *   blurred(x) = sum_k w(k) m(x + k) v(x + k) / sum_k w(k) m(x + k),  w(k) = exp(-k^2 / (2 sigma^2)),  |k| <= reach
 *
 * along rows and then along columns, with m the mask, or 1 inside the image.  The first pass writes numerator and
 * denominator.  One item = one pixel; dimensions x, y.  No local memory.  Deterministic. */
#include "common.h"

/* The weight w of the distance between two rows or columns. */
static inline float weight_of(const uint a, const uint b, const float falloff)
{
    const float distance = (float)a - (float)b;
    return exp(-falloff * distance * distance);
}

/* Weighted sums along rows: of three channels times the mask, and of the mask. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void blur_rows(
    __global const float *restrict image,  // [3,H',stride]
    __global const float *restrict mask,   // [H',stride] 0 or 1; read where `masked`
    __global float *restrict sums,         // [4,H',stride] channels, then the mask
    const uint masked,
    const float falloff,                   // 1 / (2 sigma^2), px^-2
    const uint reach,                      // px
    const uint width,
    const uint height,
    const uint rows,                       // H'
    const uint stride)
{
    const uint x = get_global_id(0), y = get_global_id(1), plane = rows * stride;
    if (x >= width || y >= height)
        return;
    const uint first = max((int)x - (int)reach, 0), last = min(x + reach, width - 1);
    float total[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (uint column = first; column <= last; column++) {
        const uint at = y * stride + column;
        const float weight = weight_of(column, x, falloff) * (masked ? mask[at] : 1.0f);
        for (uint channel = 0; channel < 3; channel++)
            total[channel] += weight * image[channel * plane + at];
        total[3] += weight;
    }
    for (uint channel = 0; channel < 4; channel++)
        sums[channel * plane + y * stride + x] = total[channel];
}

/* Weighted sums along columns, and their quotient; pixels without a valid neighbor do not change. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void blur_columns(
    __global const float *restrict sums,  // [4,H',stride]
    __global float *restrict image,       // [3,H',stride]
    const float falloff,                  // 1 / (2 sigma^2), px^-2
    const uint reach,                     // px
    const uint width,
    const uint height,
    const uint rows,                      // H'
    const uint stride)
{
    const uint x = get_global_id(0), y = get_global_id(1), plane = rows * stride;
    if (x >= width || y >= height)
        return;
    const uint first = max((int)y - (int)reach, 0), last = min(y + reach, height - 1);
    float total[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (uint row = first; row <= last; row++) {
        const float weight = weight_of(row, y, falloff);
        for (uint channel = 0; channel < 4; channel++)
            total[channel] += weight * sums[channel * plane + row * stride + x];
    }
    for (uint channel = 0; channel < 3 && total[3] > 0.0f; channel++)
        image[channel * plane + y * stride + x] = total[channel] / total[3];
}
