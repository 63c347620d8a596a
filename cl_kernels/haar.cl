/* One level of the Haar transform of a photograph and its inverse, with a trained high-pass analysis filter
 * h = (h0, h1) (AutoOpti3DGS, Nguyen et al. 2025).  Each block X of 2 x 2 pixels becomes
 *
 *   M X M^T,  M = 1/2 [1 + u, 1 + v; 1 - u, 1 - v],  (u, v) = sqrt(2) h
 *
 * which is X for Haar's h = (1, -1) / sqrt(2), and the block's mean for h = 0.  Where a block extends beyond the image,
 * it repeats the last row or column.  Masked pixels are replaced with the mean of the other pixels of their block.
 * A block is a float4: upper left, upper right, lower left, lower right.  No local memory.  Deterministic. */
#include "common.h"

#define STRIP 16  // rows of blocks that one item sums

/* The block whose upper left pixel is (x, y). */
static inline float4 block_at(
    __global const float *image, __global const float *mask, const uint masked, const uint x, const uint y,
    const uint width, const uint height, const uint stride)
{
    const uint right = min(x + 1, width - 1), upper = y * stride, lower = min(y + 1, height - 1) * stride;
    const float4 pixels = (float4)(image[upper + x], image[upper + right], image[lower + x], image[lower + right]);
    if (!masked)
        return pixels;
    const float4 counts = (float4)(mask[upper + x], mask[upper + right], mask[lower + x], mask[lower + right]);
    const float number = counts.x + counts.y + counts.z + counts.w;
    if (number == 0.0f)
        return pixels;
    const float4 sum = counts * pixels;
    return counts > 0.0f ? pixels : (float4)((sum.x + sum.y + sum.z + sum.w) / number);
}

/* M applied to columns, and transposed; applied twice, this is M X M^T. */
static inline float4 changed(const float4 block, const float u, const float v)
{
    const float2 low = 0.5f * (block.xz + block.yw), high = 0.5f * (u * block.xz + v * block.yw);
    return (float4)(low + high, low - high);
}

/* Transform every block; pixels outside the image become zero.  One item = one block; dimensions x, y. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void haar_forward(
    __global const float *restrict image,  // [3,H',stride]
    __global const float *restrict mask,   // [H',stride] 0 or 1; read where `masked`
    __global float *restrict result,       // [3,H',stride]
    const uint masked,
    const float u,
    const float v,
    const uint width,
    const uint height,
    const uint rows,                       // H', even like the stride
    const uint stride)
{
    const uint x = 2 * get_global_id(0), y = 2 * get_global_id(1);
    if (x >= stride || y >= rows)
        return;
    const uint inside = x < width && y < height, right = x + 1 < width, lower = y + 1 < height;
    for (uint channel = 0; channel < 3; channel++) {
        const uint plane = channel * rows * stride, at = plane + y * stride + x;
        float4 block = (float4)(0.0f);
        if (inside)
            block = changed(changed(block_at(image + plane, mask, masked, x, y, width, height, stride), u, v), u, v);
        result[at] = block.x;
        result[at + 1] = right ? block.y : 0.0f;
        result[at + stride] = lower ? block.z : 0.0f;
        result[at + stride + 1] = right && lower ? block.w : 0.0f;
    }
}

/* Sums that give the gradients of u and v.  One item = one column of blocks in STRIP rows; dimensions column, strip. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void haar_backward(
    __global const float *restrict image,     // [3,H',stride] before the transform
    __global const float *restrict mask,      // [H',stride] 0 or 1; read where `masked`
    __global const float *restrict gradient,  // [3,H',stride] dL/d(transformed image), zero outside
    __global float *restrict sums,            // [2,strips,stride/2] for u, v
    const uint masked,
    const float u,
    const float v,
    const uint width,
    const uint height,
    const uint rows,                          // H', even like the stride
    const uint stride)
{
    const uint column = get_global_id(0), strip = get_global_id(1), x = 2 * column, columns = stride / 2;
    if (column >= columns)
        return;
    const uint first = 2 * STRIP * strip, end = x < width ? min(first + 2 * STRIP, height) : first;
    float2 total_u = (float2)(0.0f), total_v = (float2)(0.0f);
    for (uint channel = 0; channel < 3; channel++) {
        const uint plane = channel * rows * stride;
        for (uint y = first; y < end; y += 2) {
            const uint at = plane + y * stride + x;
            const float4 block = block_at(image + plane, mask, masked, x, y, width, height, stride);
            const float4 once = changed(block, u, v);
            const float2 upper = (float2)(gradient[at], gradient[at + 1]);
            const float2 lower = (float2)(gradient[at + stride], gradient[at + stride + 1]);
            const float2 low = upper + lower, high = upper - lower;
            const float2 before = low + u * high, after = low + v * high;  // columns of 2 dL/d(once)
            const float2 first_high = (float2)(before.x - before.y, after.x - after.y);
            total_u += high * once.xz + 0.5f * first_high * block.xz;
            total_v += high * once.yw + 0.5f * first_high * block.yw;
        }
    }
    const uint index = strip * columns + column, all = get_global_size(1) * columns;
    sums[index] = 0.5f * (total_u.x + total_u.y);
    sums[all + index] = 0.5f * (total_v.x + total_v.y);
}
