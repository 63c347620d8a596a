/* The bilateral grid of one photograph: colors by position and luminance (Chen et al. 2007; Wang et al. 2024).
 *
 * Each of nx ny nz nodes over the width, the height and the luminance of an image holds the difference of a matrix
 * [E | b] from the identity.  A pixel c is at X = (x + 1/2) / width (nx - 1), Y likewise, and Z = clamp(l . c, 0, 1)
 * (nz - 1), l the weights of the luminance.  A is the trilinear interpolation of the nodes around it, with weights
 * max(0, 1 - |X - i|) for each axis, and y = min(1, c + A [c; 1]).  Clamped values pass no gradient.  A fourth plane
 * is copied.
 *
 * Planes are [channels,H',W'] with H', W' whole tiles, zero outside the image.  A grid is [ENTRIES,nz,ny,nx].  Its
 * gradient is summed over the pixels of a row for each column of nodes, then over the rows around each node, in order;
 * each sum is written once.  Deterministic. */
#include "color_grid.h"
#include "planes.h"

#define LUMINANCE_RED 0.299f    // BT.601
#define LUMINANCE_GREEN 0.587f
#define LUMINANCE_BLUE 0.114f

/* Weight of a node at a distance, in nodes. */
static inline VF hat(const VF distance)
{
    const VF near = 1.0f - magnitude(distance);
    return near > 0.0f ? near : (VF)(0.0f);
}

/* The derivative of `hat`; at a node, the derivative in the next interval. */
static inline VF hat_slope(const VF distance)
{
    const VF one = (VF)(1.0f), zero = (VF)(0.0f);
    return distance >= -1.0f ? (distance < 0.0f ? one : (distance < 1.0f ? -one : zero)) : zero;
}

static inline VF luminance_of(const VF r, const VF g, const VF b)
{
    return LUMINANCE_RED * r + LUMINANCE_GREEN * g + LUMINANCE_BLUE * b;
}

static inline VF level_of(const VF luminance, const uint nz)
{
    return smaller(larger(luminance, (VF)(0.0f)), (VF)(1.0f)) * (float)(nz - 1);
}

/* The positions of LANES pixels from `first` on, in nodes; per_pixel: (n - 1) / pixels of the axis. */
static inline VF node_positions(const uint first, const float per_pixel)
{
    return (to_VF(LANE_INDEX + (int)first) + 0.5f) * per_pixel;
}

/* The first pixel that a node of an axis affects, and one past the last. */
static inline uint begin_of_node(const uint node, const uint nodes, const uint pixels)
{
    return node > 0 ? (node - 1) * pixels / (nodes - 1) : 0;
}

static inline uint end_of_node(const uint node, const uint nodes, const uint pixels)
{
    return (node + 1) * pixels / max(nodes - 1, 1u) + 1;
}

/* The grid interpolated at a row of pixels, [ENTRIES,nz,nx]; all items of a group write it together. */
static inline void grid_of_row(
    __global const float *grid, __local float *row_grid, const uint nx, const uint ny, const uint nz, const uint y,
    const float per_row)
{
    const float position = ((float)y + 0.5f) * per_row;
    const uint above = min((uint)position, ny - 1), below = min(above + 1, ny - 1);
    const float fraction = position - (float)above;
    for (uint e = get_local_id(0); e < ENTRIES * nz * nx; e += TEAM) {
        const uint level = e / nx;
        __global const float *column = grid + level * (ny - 1) * nx + e;
        row_grid[e] = (1.0f - fraction) * column[above * nx] + fraction * column[below * nx];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

/* The matrices `a` of LANES pixels from x on, from the grid of their row, and, unless `slopes` is a null pointer, their
 * derivatives with respect to the level. */
static inline void matrices_of(
    __local const float *grid, const uint nx, const uint nz, const uint x, const float per_column, const VF level,
    VF *a, VF *slopes)
{
    const VF position = node_positions(x, per_column);
    const uint last = min((uint)(((float)(x + LANES) - 0.5f) * per_column) + 1, nx - 1);
    for (uint n = 0; n < ENTRIES; n++) {
        a[n] = (VF)(0.0f);
        if (slopes)
            slopes[n] = (VF)(0.0f);
    }
    for (uint i = (uint)(((float)x + 0.5f) * per_column); i <= last; i++)
        for (uint k = 0; k < nz; k++) {
            const VF near = hat(position - (float)i);
            const VF weight = near * hat(level - (float)k), slope = near * hat_slope(level - (float)k);
            for (uint n = 0; n < ENTRIES; n++) {
                a[n] += weight * grid[(n * nz + k) * nx + i];
                if (slopes)
                    slopes[n] += slope * grid[(n * nz + k) * nx + i];
            }
        }
}

/* Transform the colors.  One group of TEAM items = one row.  Local memory: ENTRIES * MOST_NODES^2 * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void color_grid_forward(
    __global const float *restrict image,   // [channels,H',stride] 3 or 4 channels
    __global const float *restrict values,  // [photographs,ENTRIES,nz,ny,nx]
    __global float *restrict colored,       // [channels,H',stride]
    const uint first,                       // index of the photograph's first value
    const uint nx,
    const uint ny,
    const uint nz,
    const float per_column,                 // (nx - 1) / width
    const float per_row,                    // (ny - 1) / height
    const uint channels,
    const uint width,
    const uint height,
    const uint rows,                        // H'
    const uint stride)
{
    __local float grid[ENTRIES * MOST_NODES * MOST_NODES];
    const uint y = get_group_id(1), plane = rows * stride, columns = y < height ? width : 0;
    grid_of_row(values + first, grid, nx, ny, nz, min(y, height - 1), per_row);
    for (uint x = get_local_id(0) * LANES; x < stride; x += TEAM * LANES) {
        const uint at = y * stride + x;
        const VF r = VLOAD(image + at), g = VLOAD(image + plane + at), b = VLOAD(image + 2 * plane + at);
        const VF inside = inside_row(x, columns), level = level_of(luminance_of(r, g, b), nz), one = (VF)(1.0f);
        VF a[ENTRIES];
        matrices_of(grid, nx, nz, x, per_column, level, a, 0);
        VSTORE(inside * smaller(r + (a[0] * r + a[1] * g + a[2] * b + a[3]), one), colored + at);
        VSTORE(inside * smaller(g + (a[4] * r + a[5] * g + a[6] * b + a[7]), one), colored + plane + at);
        VSTORE(inside * smaller(b + (a[8] * r + a[9] * g + a[10] * b + a[11]), one), colored + 2 * plane + at);
        if (channels > 3)
            VSTORE(VLOAD(image + 3 * plane + at), colored + 3 * plane + at);
    }
}

/* The gradient of the image, through the matrix and through the luminance at which it is interpolated, and the part
 * of the gradient that passes the clamp.  Groups and memory are as in color_grid_forward. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void color_grid_backward(
    __global const float *restrict image,     // [channels,H',stride] before the transform
    __global const float *restrict values,    // [photographs,ENTRIES,nz,ny,nx]
    __global const float *restrict gradient,  // [channels,H',stride] dL/d(transformed image), zero outside
    __global float *restrict grad_image,      // [channels,H',stride]
    __global float *restrict passed,          // [3,H',stride] the gradient where nothing is clamped
    const uint first,                         // index of the photograph's first value
    const uint nx,
    const uint ny,
    const uint nz,
    const float per_column,                   // (nx - 1) / width
    const float per_row,                      // (ny - 1) / height
    const uint channels,
    const uint width,
    const uint height,
    const uint rows,                          // H'
    const uint stride)
{
    __local float grid[ENTRIES * MOST_NODES * MOST_NODES];
    const uint y = get_group_id(1), plane = rows * stride, columns = y < height ? width : 0;
    grid_of_row(values + first, grid, nx, ny, nz, min(y, height - 1), per_row);
    for (uint x = get_local_id(0) * LANES; x < stride; x += TEAM * LANES) {
        const uint at = y * stride + x;
        const VF r = VLOAD(image + at), g = VLOAD(image + plane + at), b = VLOAD(image + 2 * plane + at);
        const VF inside = inside_row(x, columns), zero = (VF)(0.0f);
        const VF luminance = luminance_of(r, g, b), level = level_of(luminance, nz);
        VF a[ENTRIES], s[ENTRIES];
        matrices_of(grid, nx, nz, x, per_column, level, a, s);
        VF p[3], grad_level = zero;
        for (uint c = 0; c < 3; c++) {
            const VF value = c == 0 ? r : c == 1 ? g : b;
            const VF changed = value + (a[4 * c] * r + a[4 * c + 1] * g + a[4 * c + 2] * b + a[4 * c + 3]);
            p[c] = (changed < 1.0f ? inside : zero) * VLOAD(gradient + c * plane + at);
            VSTORE(p[c], passed + c * plane + at);
            grad_level += p[c] * (s[4 * c] * r + s[4 * c + 1] * g + s[4 * c + 2] * b + s[4 * c + 3]);
        }
        const VF between = luminance > 0.0f ? (level < (float)(nz - 1) ? grad_level : zero) : zero;
        const VF grad_luminance = (float)(nz - 1) * between;
        VSTORE(p[0] + (a[0] * p[0] + a[4] * p[1] + a[8] * p[2]) + LUMINANCE_RED * grad_luminance, grad_image + at);
        VSTORE(p[1] + (a[1] * p[0] + a[5] * p[1] + a[9] * p[2]) + LUMINANCE_GREEN * grad_luminance,
               grad_image + plane + at);
        VSTORE(p[2] + (a[2] * p[0] + a[6] * p[1] + a[10] * p[2]) + LUMINANCE_BLUE * grad_luminance,
               grad_image + 2 * plane + at);
        if (channels > 3)
            VSTORE(VLOAD(gradient + 3 * plane + at), grad_image + 3 * plane + at);
    }
}

/* Sums of w p [c; 1] over the pixels of a row around a column of nodes, w the weight of position and level.
 * One group of TEAM items = one column of nodes in one row of pixels.  Local memory: ENTRIES * TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void color_grid_row_sums(
    __global const float *restrict image,   // [3 or 4,H',stride] before the transform
    __global const float *restrict passed,  // [3,H',stride] result of color_grid_backward
    __global float *restrict row_sums,      // [ENTRIES,nz,nx,H']
    const uint nx,
    const uint nz,
    const float per_column,                 // (nx - 1) / width
    const uint width,
    const uint rows,                        // H'
    const uint stride)
{
    __local float sums[ENTRIES][TEAM];
    const uint item = get_local_id(0), i = get_group_id(0), y = get_group_id(1), plane = rows * stride;
    const uint from = begin_of_node(i, nx, width), end = min(end_of_node(i, nx, width), stride);
    for (uint k = 0; k < nz; k++) {
        VF total[ENTRIES];
        for (uint n = 0; n < ENTRIES; n++)
            total[n] = (VF)(0.0f);
        for (uint x = from - from % LANES + item * LANES; x < end; x += TEAM * LANES) {
            const uint at = y * stride + x;
            const VF r = VLOAD(image + at), g = VLOAD(image + plane + at), b = VLOAD(image + 2 * plane + at);
            const VF level = level_of(luminance_of(r, g, b), nz);
            const VF weight = hat(node_positions(x, per_column) - (float)i) * hat(level - (float)k);
            for (uint c = 0; c < 3; c++) {
                const VF part = weight * VLOAD(passed + c * plane + at);
                total[4 * c] += part * r;
                total[4 * c + 1] += part * g;
                total[4 * c + 2] += part * b;
                total[4 * c + 3] += part;
            }
        }
        for (uint n = 0; n < ENTRIES; n++)
            sums[n][item] = sum_lanes(total[n]);
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint n = item; n < ENTRIES; n += TEAM)
            row_sums[((n * nz + k) * nx + i) * rows + y] = sum_items(sums[n]);
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}

/* The gradient of the grid: sums over the rows of pixels around each row of nodes, in order.  One item = one value. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void color_grid_gather(
    __global const float *restrict row_sums,  // [ENTRIES,nz,nx,H']
    __global float *restrict grad_grid,       // [ENTRIES,nz,ny,nx]
    const uint nx,
    const uint ny,
    const float per_row,                      // (ny - 1) / height
    const uint height,
    const uint rows,                          // H'
    const uint count)                         // ENTRIES * nz * ny * nx
{
    const uint e = get_global_id(0), line = e / nx, level = line / ny, i = e - line * nx, j = line - level * ny;
    if (e >= count)
        return;
    __global const float *sums = row_sums + (level * nx + i) * rows;
    float total = 0.0f;
    for (uint y = begin_of_node(j, ny, height); y < min(end_of_node(j, ny, height), height); y++) {
        const float weight = 1.0f - fabs(((float)y + 0.5f) * per_row - (float)j);
        total += weight > 0.0f ? weight * sums[y] : 0.0f;
    }
    grad_grid[e] = total;
}
