/* The colors of rays from the outputs of a network, and the gradient (Max 1995, as in Barron et al. 2021).
 *
 *   density of a sample s = softplus(raw - 1), color c = (1 + 2 p) sigmoid(raw) - p with p = 0.001
 *   weight w_k = T_k (1 - exp(-s_k e_k)), T_k+1 = T_k exp(-s_k e_k), e_k its length
 *   color of a ray = sum of w_k c_k + (1 - sum of w_k) background
 *
 * The loss of a ray is the squared difference from its pixel, times a scale.  Backward, from the last sample to the
 * first, with g_k = dL/dw_k: dL/d(s_k e_k) = T_k+1 g_k - (sum over j > k of w_j g_j).
 *
 * One item = one ray.  No local memory. */
#include "layers.h"

#define DENSITY_BIAS (-1.0f)   // value of the released code, which starts with nearly empty space
#define COLOR_PADDING 0.001f  // lets colors reach 0 and 1
#define FLUSH_BELOW 1.0e-30f
#define COLOR_ROWS 4          // rows of the network's colors, and of its densities: one block (layers.h)
#define RAY_LENGTH 7           // index of |d| in a ray's values (rays.cl)
#define RAY_STEP 8

/* Replace numbers that are nearly subnormal, which are slow on some CPUs, with zero; NaN does not change. */
static inline float flush_to_zero(const float x) { return fabs(x) < FLUSH_BELOW ? 0.0f : x; }

static inline float density_of(const float raw)
{
    const float x = raw + DENSITY_BIAS;
    return x > 0.0f ? x + log1p(exp(-x)) : log1p(exp(x));
}

static inline float logistic(const float x) { return 1.0f / (1.0f + exp(-x)); }

static inline float color_of(const float raw)
{
    return (1.0f + 2.0f * COLOR_PADDING) * logistic(raw) - COLOR_PADDING;
}

/* Colors and weights of rays. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void composite_forward(
    __global const float *restrict raw_colors,     // [T,COLOR_ROWS,SAMPLES]
    __global const float *restrict raw_densities,  // [T,COLOR_ROWS,SAMPLES], in the first row
    __global const float *restrict cones,          // [rays,RAY_STEP]
    __global const float *restrict edges,          // [rays,samples + 1]
    __global const float *restrict background,     // [3]
    __global float *restrict weights,              // [rays,samples]
    __global float *restrict transmittance,        // [rays,samples] T_k+1
    __global float *restrict colors,               // [rays,3]
    const uint samples,
    const uint rays)
{
    const uint ray = get_global_id(0);
    if (ray >= rays)
        return;
    __global const float *t = edges + ray * (samples + 1);
    const float length = cones[ray * RAY_STEP + RAY_LENGTH];
    float through = 1.0f, sums[3] = {0.0f, 0.0f, 0.0f}, covered = 0.0f;
    for (uint k = 0; k < samples; k++) {
        const uint at = feature_at(ray * samples + k, 0, COLOR_ROWS);
        const float passed = exp(-density_of(raw_densities[at]) * (t[k + 1] - t[k]) * length);
        const float weight = through * (1.0f - passed);
        through *= passed;
        for (uint channel = 0; channel < 3; channel++)
            sums[channel] += weight * color_of(raw_colors[at + channel * SAMPLES]);
        covered += weight;
        weights[ray * samples + k] = weight;
        transmittance[ray * samples + k] = through;
    }
    for (uint channel = 0; channel < 3; channel++)
        colors[ray * 3 + channel] = sums[channel] + (1.0f - covered) * background[channel];
}

/* Squared errors of rays, and the gradient of the network's outputs. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void composite_backward(
    __global const float *restrict raw_colors,     // [T,COLOR_ROWS,SAMPLES]
    __global const float *restrict raw_densities,  // [T,COLOR_ROWS,SAMPLES]
    __global const float *restrict cones,          // [rays,RAY_STEP]
    __global const float *restrict edges,          // [rays,samples + 1]
    __global const float *restrict background,     // [3]
    __global const float *restrict weights,        // [rays,samples]
    __global const float *restrict transmittance,  // [rays,samples] T_k+1
    __global const float *restrict colors,         // [rays,3]
    __global const float *restrict photograph,     // [3,rows,stride]
    __global const uint *restrict pixels,          // [pixel_count] row * width + column
    __global float *restrict grad_colors,          // [T,COLOR_ROWS,SAMPLES]
    __global float *restrict grad_densities,       // [T,COLOR_ROWS,SAMPLES]
    __global float *restrict errors,               // [rays of the step] from first_ray on
    const float scale,                             // factor on a ray's squared difference
    const uint first_ray,
    const uint width,
    const uint stride,
    const uint plane,                              // rows * stride
    const uint samples,
    const uint pixel_count,                        // the rays after these only fill the last tile
    const uint rays)
{
    const uint ray = get_global_id(0);
    if (ray >= rays)
        return;
    const float counts = ray < pixel_count ? 1.0f : 0.0f, length = cones[ray * RAY_STEP + RAY_LENGTH];
    const uint pixel = pixels[ray < pixel_count ? ray : pixel_count - 1];
    __global const float *photo = photograph + pixel / width * stride + pixel % width, *t = edges + ray * (samples + 1);
    float grad_color[3], error = 0.0f;
    for (uint channel = 0; channel < 3; channel++) {
        const float difference = colors[ray * 3 + channel] - photo[channel * plane];
        grad_color[channel] = 2.0f * counts * scale * difference;
        error += difference * difference;
    }
    if (ray < pixel_count)
        errors[first_ray + ray] = error;
    float behind = 0.0f;  // sum of w_j g_j over the samples behind
    for (uint k = samples; k-- > 0;) {
        const uint at = feature_at(ray * samples + k, 0, COLOR_ROWS);
        const float weight = weights[ray * samples + k];
        float grad_weight = 0.0f;
        for (uint channel = 0; channel < 3; channel++) {
            const float raw = raw_colors[at + channel * SAMPLES], y = logistic(raw);
            grad_weight += grad_color[channel] * (color_of(raw) - background[channel]);
            grad_colors[at + channel * SAMPLES] =
                flush_to_zero(grad_color[channel] * weight * (1.0f + 2.0f * COLOR_PADDING) * y * (1.0f - y));
            grad_densities[at + (1 + channel) * SAMPLES] = 0.0f;
        }
        grad_colors[at + 3 * SAMPLES] = 0.0f;
        const float grad_depth = transmittance[ray * samples + k] * grad_weight - behind;
        grad_densities[at] =
            flush_to_zero(grad_depth * (t[k + 1] - t[k]) * length * logistic(raw_densities[at] + DENSITY_BIAS));
        behind += weight * grad_weight;
    }
}

/* Write the colors of rays to an image. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void place_colors(
    __global const float *restrict colors,  // [rays,3]
    __global const uint *restrict pixels,   // [rays] row * width + column
    __global float *restrict image,         // [3,rows,stride]
    const uint width,
    const uint stride,
    const uint plane,                       // rows * stride
    const uint rays)
{
    const uint ray = get_global_id(0);
    if (ray >= rays)
        return;
    const uint at = pixels[ray] / width * stride + pixels[ray] % width;
    for (uint channel = 0; channel < 3; channel++)
        image[channel * plane + at] = colors[ray * 3 + channel];
}
