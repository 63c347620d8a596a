/* Fusion of depth images (Curless & Levoy 1996): the truncated signed distance to the surface, and the free space.
 *
 * Grid points have the coordinates `voxel` times their integer index.  They are in blocks of BLOCK_SIDE^3, of which
 * only those near surfaces exist; the last axis of a block varies fastest.  A view at a point with depth z, whose pixel
 * has the depth d, measures the signed distance d - z, positive in front of the surface.  Points behind the surface by
 * more than the truncation are hidden; points in front of it by more than the truncation get the truncation.
 *
 * One item = one grid point.  No local memory.  Deterministic: one launch per view, each item adds to its own sums. */
#include "common.h"

#define BLOCK_SIDE 16   // grid points along a side of a block
#define POINT_FIELDS 6  // sums over views: distance in truncations, views; red, green, blue near the surface, views

/* The image position of the item's grid point, px, and its depth, scene units; 0 where the view does not show it. */
static inline float project_point(__global const int *blocks, __constant camera_t *camera, const float voxel, float *u,
                                  float *v)
{
    const uint i = get_global_id(0), point = i % (BLOCK_SIDE * BLOCK_SIDE * BLOCK_SIDE);
    __global const int *block = blocks + 3 * (i / (BLOCK_SIDE * BLOCK_SIDE * BLOCK_SIDE));
    const float p[3] = {
        voxel * (float)(block[0] * BLOCK_SIDE + (int)(point / (BLOCK_SIDE * BLOCK_SIDE))),
        voxel * (float)(block[1] * BLOCK_SIDE + (int)(point / BLOCK_SIDE % BLOCK_SIDE)),
        voxel * (float)(block[2] * BLOCK_SIDE + (int)(point % BLOCK_SIDE))};
    float q[3];
    for (uint k = 0; k < 3; k++) {
        __constant float *row = camera->world_to_camera + 4 * k;
        q[k] = row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3];
    }
    const float inverse = q[2] > 0.0f ? 1.0f / q[2] : 0.0f;
    *u = camera->fx * q[0] * inverse + camera->cx;
    *v = camera->fy * q[1] * inverse + camera->cy;
    const bool shown = (*u >= 0.0f) & (*v >= 0.0f) & (*u < camera->width) & (*v < camera->height) & (q[2] > 0.0f);
    return shown ? q[2] : 0.0f;
}

/* The depth between the four pixels around a position, where they show one surface, otherwise that of the pixel. */
static inline float depth_at(__global const float4 *pixels, const uint width, const uint height, const float u,
                             const float v, const float step)
{
    const float nearest = pixels[(uint)v * width + (uint)u].w, x = u - 0.5f, y = v - 0.5f;
    if (!(x >= 0.0f && y >= 0.0f && x < width - 1.0f && y < height - 1.0f))
        return nearest;
    const uint column = (uint)x, row = (uint)y;
    const float right = x - column, down = y - row;
    const float a = pixels[row * width + column].w, b = pixels[row * width + column + 1].w;
    const float c = pixels[(row + 1) * width + column].w, d = pixels[(row + 1) * width + column + 1].w;
    const float low = fmin(fmin(a, b), fmin(c, d)), high = fmax(fmax(a, b), fmax(c, d));
    const float top = a + right * (b - a), bottom = c + right * (d - c);
    return low > 0.0f && high - low < step ? top + down * (bottom - top) : nearest;
}

/* Add a view to the sums of the grid points. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void integrate_view(
    __global const int *restrict blocks,     // [B,3] indices of the blocks
    __global const float4 *restrict pixels,  // [H,W] red, green, blue in [0, 1]; depth, scene units, 0: unknown
    __constant camera_t *restrict camera,    // [1]
    __global float *restrict points,         // [POINT_FIELDS,count] sums
    const float voxel,                       // scene units
    const float truncation,                  // scene units
    const uint count)                        // B * BLOCK_SIDE^3
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    float u, v;
    const float z = project_point(blocks, camera, voxel, &u, &v);
    if (!(z > 0.0f))
        return;
    const float4 seen = pixels[(uint)v * camera->width + (uint)u];
    const float depth = depth_at(pixels, camera->width, camera->height, u, v, truncation);
    const float distance = (depth - z) / truncation;
    if (!(depth > 0.0f) || distance < -1.0f)
        return;
    points[i] += distance < 1.0f ? distance : 1.0f;
    points[count + i] += 1.0f;
    if (distance < 1.0f) {
        points[2 * count + i] += seen.x;
        points[3 * count + i] += seen.y;
        points[4 * count + i] += seen.z;
        points[5 * count + i] += 1.0f;
    }
}

/* Count the views that see a grid point in front of the surface, by at least a voxel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_free(
    __global const int *restrict blocks,    // [B,3] indices of the blocks
    __global const float *restrict depths,  // [H,W] scene units; 0: unknown
    __constant camera_t *restrict camera,   // [1]
    __global uint *restrict views,          // [count]
    const float voxel,                      // scene units
    const uint count)                       // B * BLOCK_SIDE^3
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    float u, v;
    const float z = project_point(blocks, camera, voxel, &u, &v);
    if (z > 0.0f && depths[(uint)v * camera->width + (uint)u] - z >= voxel)
        views[i] += 1;
}
