/* Photometric losses between a rendered image and a photograph: L1 and L2, value and gradient (D-SSIM: ssim.cl).
 *
 * Planes are [channels,H',W'] with H', W' whole tiles, zero outside the image; gradients too.  One group of TEAM items
 * = one row of one channel; each sum is written once.  Deterministic. */
#include "planes.h"

/* Convert 8-bit pixels, times a factor, to float planes.  One item = LANES pixels of one channel; dimensions x, y,
 * channel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void unpack_pixels(
    __global const uchar *restrict pixels,  // [channels,height,width]
    __global float *restrict planes,        // [channels,H',stride]
    const float factor,                     // 1/255 for colors, 1 for a mask
    const uint width,
    const uint height,
    const uint stride)
{
    const uint x = get_global_id(0) * LANES, y = get_global_id(1), channel = get_global_id(2);
    if (x >= stride)
        return;
    __global const uchar *first = pixels + (channel * height + y) * width + x;
    __global float *values = planes + (channel * get_global_size(1) + y) * stride + x;
    if (y < height && x + LANES <= width)
        VSTORE(to_VF(VLOAD_BYTES(first)) * factor, values);
    else
        for (uint lane = 0; lane < LANES; lane++)
            values[lane] = y < height && x + lane < width ? first[lane] * factor : 0.0f;
}

/* Set masked pixels to zero.  One item = one pixel of one channel; dimensions pixel, channel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void apply_mask(
    __global float *restrict planes,      // [channels,H',stride]
    __global const float *restrict mask,  // [H',stride] 0 or 1
    const uint pixels)                    // H' * stride
{
    const uint pixel = get_global_id(0), channel = get_global_id(1);
    if (pixel < pixels && mask[pixel] == 0.0f)
        planes[channel * pixels + pixel] = 0.0f;
}

/* Change the color behind transparent pixels: colors += transparency (behind - background).
 * One item = one pixel of one channel; dimensions pixel, channel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void change_background(
    __global float *restrict colors,             // [3,H',stride] over `background`
    __global const float *restrict transparency,  // [H',stride] 0 to 1, 0 outside the image
    __global const float *restrict background,    // [3]
    __global const float *restrict behind,        // [3]
    const uint pixels)                            // H' * stride
{
    const uint pixel = get_global_id(0), channel = get_global_id(1);
    if (pixel < pixels)
        colors[channel * pixels + pixel] += transparency[pixel] * (behind[channel] - background[channel]);
}

/* gradient (+)= l1 sign(x - y) + l2 2 (x - y).  Local memory: TEAM * 8 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void pixel_loss(
    __global const float *restrict image,       // [3,H',stride]
    __global const float *restrict photograph,  // [3,H',stride]
    __global float *restrict gradient,          // [3,H',stride]
    __global float *restrict row_sums,          // [3,H',2] sums of |x - y| and (x - y)^2
    const float l1,                             // weight / values in the image
    const float l2,                             // weight / values in the image
    const uint accumulate,                      // 0: overwrite the gradient
    const uint width,
    const uint height,
    const uint rows,                            // H'
    const uint stride)
{
    __local float sums[TEAM][2];
    const uint item = get_local_id(0), y = get_group_id(1), channel = get_group_id(2);
    const uint row = (channel * rows + y) * stride, columns = y < height ? width : 0;
    const VF zero = (VF)(0.0f);
    VF absolute = zero, squared = zero;
    for (uint x = item * LANES; x < stride; x += TEAM * LANES) {
        const VF inside = inside_row(x, columns);
        const VF difference = VLOAD(image + row + x) - VLOAD(photograph + row + x);
        const VF sign = difference > 0.0f ? inside : (difference < 0.0f ? -inside : zero);
        const VF g = l1 * sign + (2.0f * l2) * (difference * inside);
        VSTORE((accumulate ? VLOAD(gradient + row + x) + g : g), gradient + row + x);
        absolute += difference * sign;
        squared += difference * difference * inside;
    }
    sums[item][0] = sum_lanes(absolute);
    sums[item][1] = sum_lanes(squared);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        float total_absolute = 0.0f, total_squared = 0.0f;
        for (uint i = 0; i < TEAM; i++) {
            total_absolute += sums[i][0];
            total_squared += sums[i][1];
        }
        row_sums[(channel * rows + y) * 2] = total_absolute;
        row_sums[(channel * rows + y) * 2 + 1] = total_squared;
    }
}

/* The error of a view, weighted by the gradient of its loss: sums of |gradient (x - y)|, by row.
 * Local memory: TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void view_error(
    __global const float *restrict image,       // [3,H',stride]
    __global const float *restrict photograph,  // [3,H',stride]
    __global const float *restrict gradient,    // [3,H',stride] dL/d(image)
    __global float *restrict row_errors,        // [3,H']
    const uint width,
    const uint height,
    const uint rows,                            // H'
    const uint stride)
{
    __local float sums[TEAM];
    const uint item = get_local_id(0), y = get_group_id(1), channel = get_group_id(2);
    const uint row = (channel * rows + y) * stride, columns = y < height ? width : 0;
    VF error = (VF)(0.0f);
    for (uint x = item * LANES; x < stride; x += TEAM * LANES) {
        const VF difference = VLOAD(image + row + x) - VLOAD(photograph + row + x);
        error += fabs(VLOAD(gradient + row + x) * difference) * inside_row(x, columns);
    }
    sums[item] = sum_lanes(error);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0)
        row_errors[channel * rows + y] = sum_items(sums);
}

/* Sum the errors of a view's rows, in order.  A single item. */
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void sum_errors(
    __global const float *restrict row_errors,  // [count]
    __global float *restrict error,             // [1]
    const uint count)
{
    float total = 0.0f;
    for (uint i = 0; i < count; i++)
        total += row_errors[i];
    error[0] = total;
}
