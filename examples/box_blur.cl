/* The mean of a window of pixels, [2 reach + 1, 2 reach + 1], limited to the image.
 *
 * One item = one pixel of one channel; dimensions x, y, channel.  No local memory.  Deterministic. */
#include "common.h"

/* Write the means; 0 outside the image. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void box_blur(
    __global const float *restrict image, __global float *restrict blurred,  // [3,H',stride]
    const int reach, const int width, const int height, const int rows, const int stride)  // px; rows is H'
{
    const int x = get_global_id(0), y = get_global_id(1), plane = get_global_id(2) * rows * stride;
    float sum = 0.0f, count = 0.0f;
    for (int row = max(0, y - reach); row <= min(height - 1, y + reach); row++)
        for (int column = max(0, x - reach); column <= min(width - 1, x + reach); column++, count += 1.0f)
            sum += image[plane + row * stride + column];
    if (x < stride && y < rows)
        blurred[plane + y * stride + x] = x < width && y < height ? sum / count : 0.0f;
}
