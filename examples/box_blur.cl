/* The mean of a window of pixels, [2 reach + 1, 2 reach + 1], as far as it lies inside the image.
 *
 * One item = one pixel of one channel; dimensions x, y, channel.  No local memory.  Deterministic. */
#include "common.h"

/* Write the means. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void box_blur(
    __global const float *restrict image,  // [3,H',stride]
    __global float *restrict blurred,      // [3,H',stride]
    const int reach,                       // px
    const uint width,
    const uint height,
    const uint rows,                       // H'
    const uint stride)
{
    const int x = get_global_id(0), y = get_global_id(1), plane = get_global_id(2) * rows * stride;
    if (x >= (int)stride || y >= (int)rows)
        return;
    float sum = 0.0f, count = 0.0f;
    const bool inside = x < (int)width && y < (int)height;
    for (int row = max(0, y - reach); inside && row <= min((int)height - 1, y + reach); row++)
        for (int column = max(0, x - reach); column <= min((int)width - 1, x + reach); column++) {
            sum += image[plane + row * (int)stride + column];
            count += 1.0f;
        }
    blurred[plane + y * (int)stride + x] = inside ? sum / count : 0.0f;
}
