/* A separate layer of splats in front of an image: the composite, and the gradient of the image behind.
 *
 * A pixel has the color C + T b, with C the layer's color on black, T its transmittance and b the image's color.  A
 * loss on the cover, scale times the sum of 1 - T, keeps the layer transparent.  For the image behind, dL/db =
 * T dL/d(color); for the layer, the backward pass of blending starts from the composite.  Planes are [channels,H',W']
 * with H', W' whole tiles, zero outside the image.  A fourth plane of the image, which is not a color, is copied. */
#include "planes.h"

/* The composite, T dL/dT of the loss on the cover for blend_backward, and the sum of 1 - T of each row.
 * One group = one row.  Local memory: TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void lay_over(
    __global const float *restrict layer,          // [3,H',stride]
    __global const float *restrict transmittance,  // [H',stride] transmittance of the layer
    __global const float *restrict image,          // [channels,H',stride]
    __global float *restrict composite,            // [channels,H',stride]
    __global float *restrict behind,               // [H',stride] T dL/dT
    __global float *restrict row_sums,             // [H'] sums of 1 - T
    const float scale,                             // weight / (width height)
    const uint channels,                           // 3 or 4
    const uint width,
    const uint height,
    const uint rows,                               // H'
    const uint stride)
{
    __local float sums[TEAM];
    const uint item = get_local_id(0), y = get_group_id(1), columns = y < height ? width : 0, plane = rows * stride;
    VF total = (VF)(0.0f);
    for (uint x = item * LANES; x < stride; x += TEAM * LANES) {
        const uint at = y * stride + x;
        const VF inside = inside_row(x, columns), t = magnitude(VLOAD(transmittance + at));
        for (uint channel = 0; channel < 3; channel++) {
            const uint index = channel * plane + at;
            VSTORE(VLOAD(layer + index) + t * VLOAD(image + index), composite + index);
        }
        for (uint channel = 3; channel < channels; channel++)
            VSTORE(VLOAD(image + channel * plane + at), composite + channel * plane + at);
        VSTORE(-scale * (inside * t), behind + at);
        total += inside * (1.0f - t);
    }
    sums[item] = sum_lanes(total);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0)
        row_sums[y] = sum_items(sums);
}

/* Replace the gradient of the composite with that of the image behind.  One group = one row.  No local memory. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void look_behind(
    __global const float *restrict transmittance,  // [H',stride] transmittance of the layer
    __global float *restrict gradient,             // [3 or 4,H',stride] a fourth plane is unchanged
    const uint rows,                               // H'
    const uint stride)
{
    const uint y = get_group_id(1), plane = rows * stride;
    for (uint x = get_local_id(0) * LANES; x < stride; x += TEAM * LANES) {
        const uint at = y * stride + x;
        const VF t = magnitude(VLOAD(transmittance + at));
        for (uint channel = 0; channel < 3; channel++) {
            __global float *values = gradient + channel * plane + at;
            VSTORE(t * VLOAD(values), values);
        }
    }
}
