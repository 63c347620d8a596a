/* Rays of pixels, each the axis of a cone, and the edges of their samples (Barron et al. 2021, "Mip-NeRF").
 *
 *   ray     o the camera's position in units of the field, d toward the pixel's center with depth 1 in the camera; at a
 *           distance t of 1 the cone has the radius 2 / sqrt(12) of a pixel's width (section 3.1)
 *   coarse  edges evenly from near to far; in training each is moved at random by up to 1/2 interval
 *   fine    edges at even values of the distribution of the blurred coarse weights (equation 18, alpha 0.01),
 *           w'_k = (max(w_k-1, w_k) + max(w_k, w_k+1)) / 2 + alpha
 *
 * One item = one ray; items beyond `rays` repeat the last ray, to fill a tile of samples.  Random numbers depend
 * only on (seed, step, ray, block of four edges).  No local memory. */
#include "lanes.h"
#include "random.h"

#define RAY_VALUES 8                  // values of a ray: o, d, radius of the cone, |d|
#define CONE_RADIUS 0.577350269f      // 2 / sqrt(12)
#define BLUR_PADDING 0.01f            // alpha of equation 18
#define WEIGHT_FLOOR 1.0e-5f          // smallest sum of a ray's weights (released code)
#define RANDOM_PIXELS 8u              // stream of random numbers, different from those of other kernels
#define RANDOM_COARSE 9u
#define RANDOM_FINE 10u

/* A uniformly random pixel of a photograph for each ray. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void draw_pixels(
    __global uint *restrict pixels,  // [rays] row * width + column
    const uint pixel_count,          // number of pixels of the photograph
    const uint first_ray,            // index of the first ray in the step
    const uint seed,
    const uint step,
    const uint rays)
{
    const uint i = get_global_id(0);
    if (i < rays)
        pixels[i] = mul_hi(philox((uint4)(first_ray + i, step, RANDOM_PIXELS, 0), (uint2)(seed, 0)).x, pixel_count);
}

/* The ray of each pixel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void cast_rays(
    __global const uint *restrict pixels,  // [rays] row * width + column
    __constant camera_t *restrict camera,  // [1]
    __global float *restrict cones,        // [count,RAY_VALUES]
    const float scale,                     // units of the field per scene unit
    const uint rays,
    const uint count)                      // rays, including padding to whole tiles
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint pixel = pixels[i < rays ? i : rays - 1];
    __constant float *m = camera->world_to_camera;
    const float x = ((float)(pixel % camera->width) + 0.5f - camera->cx) / camera->fx;
    const float y = ((float)(pixel / camera->width) + 0.5f - camera->cy) / camera->fy;
    __global float *cone = cones + i * RAY_VALUES;
    float length2 = 0.0f;
    for (uint k = 0; k < 3; k++) {
        const float d = m[k] * x + m[4 + k] * y + m[8 + k];
        cone[k] = camera->position[k] * scale;
        cone[3 + k] = d;
        length2 += d * d;
    }
    cone[6] = CONE_RADIUS / camera->fx;
    cone[7] = sqrt(length2);
}

/* Edges of the coarse samples. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void spread_edges(
    __global float *restrict edges,  // [count,samples + 1] distances
    const float near,
    const float far,
    const uint samples,              // samples of a ray
    const uint first_ray,            // index of the first ray in the step
    const uint drawn,                // 1: moved at random by up to 1/2 interval, 0: even
    const uint seed,
    const uint step,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    __global float *ray_edges = edges + i * (samples + 1);
    const float width = (far - near) / (float)samples;
    uint bits[4];
    for (uint k = 0; k <= samples; k++) {
        if (k % 4 == 0) {
            const uint4 four = philox((uint4)(first_ray + i, step, RANDOM_COARSE, k / 4), (uint2)(seed, 0));
            bits[0] = four.x, bits[1] = four.y, bits[2] = four.z, bits[3] = four.w;
        }
        const float low = k == 0 ? 0.0f : (float)k - 0.5f, high = k == samples ? (float)k : (float)k + 0.5f;
        const float position = drawn ? low + (high - low) * unit_interval(bits[k % 4]) : (float)k;
        ray_edges[k] = near + width * position;
    }
}

/* The blurred weight of a sample, from a ray's weights w. */
static inline float blurred_weight(__global const float *w, const uint k, const uint samples)
{
    const float before = w[k == 0 ? 0 : k - 1], weight = w[k], after = w[k + 1 == samples ? k : k + 1];
    const float low = before > weight ? before : weight, high = after > weight ? after : weight;
    return 0.5f * (low + high) + BLUR_PADDING;
}

/* Edges of the fine samples, from the weights of the coarse ones. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void resample_edges(
    __global const float *restrict weights,  // [count,samples] of the coarse samples
    __global const float *restrict edges,    // [count,samples + 1] of the coarse samples
    __global float *restrict fine,           // [count,fine_samples + 1]
    const uint samples,
    const uint fine_samples,
    const uint first_ray,                    // index of the first ray in the step
    const uint drawn,                        // 1: within the part of an edge, 0: even
    const uint seed,
    const uint step,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    __global const float *w = weights + i * samples, *t = edges + i * (samples + 1);
    __global float *ray_edges = fine + i * (fine_samples + 1);
    float total = 0.0f;
    for (uint k = 0; k < samples; k++)
        total += blurred_weight(w, k, samples);
    const float lift = total < WEIGHT_FLOOR ? (WEIGHT_FLOOR - total) / (float)samples : 0.0f;
    total += lift * (float)samples;
    const float part = 1.0f / (float)(fine_samples + 1), max_quantile = 1.0f - FLT_EPSILON;
    uint bits[4], k = 0;
    float below = 0.0f, mass = (blurred_weight(w, 0, samples) + lift) / total;
    for (uint edge = 0; edge <= fine_samples; edge++) {
        if (edge % 4 == 0) {
            const uint4 four = philox((uint4)(first_ray + i, step, RANDOM_FINE, edge / 4), (uint2)(seed, 0));
            bits[0] = four.x, bits[1] = four.y, bits[2] = four.z, bits[3] = four.w;
        }
        const float even = (float)edge * max_quantile / (float)fine_samples;
        const float within = ((float)edge + unit_interval(bits[edge % 4])) * part;
        const float quantile = drawn ? (within < max_quantile ? within : max_quantile) : even;
        while (k + 1 < samples && below + mass <= quantile) {
            below += mass;
            k++;
            mass = (blurred_weight(w, k, samples) + lift) / total;
        }
        const float fraction = (quantile - below) / mass;
        ray_edges[edge] = t[k] + (t[k + 1] - t[k]) * (fraction > 1.0f ? 1.0f : fraction);
    }
}
