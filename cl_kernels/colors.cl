/* The colors of one photograph: y = min(1, E c + b) for every pixel c, with a matrix [E | b] per photograph, and its
 * gradient.
 *
 * Values are clamped at white, as in a photograph, but not at black, since darker pixels would have no gradient.
 * Clamped values pass no gradient.  A fourth plane of the image is copied.  Planes are [channels,H',W'] with H', W'
 * whole tiles, zero outside the image.  One group of TEAM items = one row; each sum is written once.  Deterministic. */
#include "planes.h"

#define SUMS 12  // gradients of the matrix [E | b], row by row

/* Transform the colors.  No local memory. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void colors_forward(
    __global const float *restrict image,  // [channels,H',stride] 3 or 4 channels
    __global float *restrict colored,      // [channels,H',stride]
    const float rr, const float rg, const float rb, const float r1,  // the matrix: y_red = rr red + rg green + ...
    const float gr, const float gg, const float gb, const float g1,
    const float br, const float bg, const float bb, const float b1,
    const uint channels,
    const uint width,
    const uint height,
    const uint rows,                       // H'
    const uint stride)
{
    const uint y = get_group_id(1), plane = rows * stride, columns = y < height ? width : 0;
    const VF one = (VF)(1.0f);
    for (uint x = get_local_id(0) * LANES; x < stride; x += TEAM * LANES) {
        const uint at = y * stride + x;
        const VF inside = inside_row(x, columns);
        const VF r = VLOAD(image + at), g = VLOAD(image + plane + at), b = VLOAD(image + 2 * plane + at);
        VSTORE(inside * smaller(rr * r + rg * g + rb * b + r1, one), colored + at);
        VSTORE(inside * smaller(gr * r + gg * g + gb * b + g1, one), colored + plane + at);
        VSTORE(inside * smaller(br * r + bg * g + bb * b + b1, one), colored + 2 * plane + at);
        if (channels > 3)
            VSTORE(VLOAD(image + 3 * plane + at), colored + 3 * plane + at);
    }
}

/* The gradient of the image, and the sums of a row that give the gradient of the matrix.
 * Local memory: TEAM * SUMS * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void colors_backward(
    __global const float *restrict image,     // [channels,H',stride] before the transform
    __global const float *restrict gradient,  // [channels,H',stride] dL/d(transformed image), zero outside
    __global float *restrict grad_image,      // [channels,H',stride]
    __global float *restrict row_sums,        // [SUMS,H']
    const float rr, const float rg, const float rb, const float r1,
    const float gr, const float gg, const float gb, const float g1,
    const float br, const float bg, const float bb, const float b1,
    const uint channels,
    const uint width,
    const uint height,
    const uint rows,                          // H'
    const uint stride)
{
    __local float sums[SUMS][TEAM];
    const uint item = get_local_id(0), y = get_group_id(1), plane = rows * stride, columns = y < height ? width : 0;
    const VF zero = (VF)(0.0f);
    VF total[SUMS];
    for (uint k = 0; k < SUMS; k++)
        total[k] = zero;
    for (uint x = item * LANES; x < stride; x += TEAM * LANES) {
        const uint at = y * stride + x;
        const VF inside = inside_row(x, columns);
        const VF r = VLOAD(image + at), g = VLOAD(image + plane + at), b = VLOAD(image + 2 * plane + at);
        const VF through_r = rr * r + rg * g + rb * b + r1 < 1.0f ? inside : zero;
        const VF through_g = gr * r + gg * g + gb * b + g1 < 1.0f ? inside : zero;
        const VF through_b = br * r + bg * g + bb * b + b1 < 1.0f ? inside : zero;
        const VF passed_r = through_r * VLOAD(gradient + at);
        const VF passed_g = through_g * VLOAD(gradient + plane + at);
        const VF passed_b = through_b * VLOAD(gradient + 2 * plane + at);
        VSTORE(rr * passed_r + gr * passed_g + br * passed_b, grad_image + at);
        VSTORE(rg * passed_r + gg * passed_g + bg * passed_b, grad_image + plane + at);
        VSTORE(rb * passed_r + gb * passed_g + bb * passed_b, grad_image + 2 * plane + at);
        if (channels > 3)
            VSTORE(VLOAD(gradient + 3 * plane + at), grad_image + 3 * plane + at);
        total[0] += passed_r * r;
        total[1] += passed_r * g;
        total[2] += passed_r * b;
        total[3] += passed_r;
        total[4] += passed_g * r;
        total[5] += passed_g * g;
        total[6] += passed_g * b;
        total[7] += passed_g;
        total[8] += passed_b * r;
        total[9] += passed_b * g;
        total[10] += passed_b * b;
        total[11] += passed_b;
    }
    for (uint k = 0; k < SUMS; k++)
        sums[k][item] = sum_lanes(total[k]);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < SUMS; k += TEAM)
        row_sums[k * rows + y] = sum_items(sums[k]);
}
