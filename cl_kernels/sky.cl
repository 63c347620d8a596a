/* An environment map: the color behind the Gaussians in every direction.
 *
 * It is an octahedral map (Meyer et al. 2010, "On floating-point normal vectors", section 2.2): with s = |x| +
 * |y| + |z|, a direction (x, y, z) maps to (u, v) = (x, y) / s where z >= 0, and at (x - sign(x) z, y - sign(y) z) / s
 * otherwise.  So (u, v) fills the square [-1, 1]^2 without a gap, and the square's edges meet on the sphere.  side *
 * side texels have their centers at -1 + (2 i + 1) / side; between four of them colors are bilinear.  A pixel has the
 * color C + T b, with b the map's color in the direction of its ray and T the transmittance of the splats.
 *
 * The host lists, for each camera, the runs of pixels of a row between the same four texels in one octant: all pixels
 * of a run read and update the same texels, and only their rays differ.  Each sum is written once: for each run, then
 * over the runs around each texel, in order.  Deterministic. */
#include "adam.h"
#include "planes.h"

#define RUN_WORDS 8   // words of a run: row, first column, column after the last, packed position, the four texels
#define CORNERS 4     // texels around a pixel: (i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)
#define RUN_SUMS 12   // sums of a run: for each corner red, green, blue
#define PLACE_BITS 12 // bits of i + 1 and j + 1 in a packed position; then the signs of x, y, z, 1 if negative
#define SKY_EPSILON 1.0f  // epsilon of Adam: the L1 gradient of one wrong pixel (ours)
#define BORDER 16         // columns of zeros on either side of the matches; rows: 1
#define MATCH_FRACTION 0.6f  // fraction of 3 x 3 pixels that must match (splatfacto-w, Xu et al. 2024)

typedef struct {
    float row, i, j;             // row of the ray; indices of the first texel
    float sign_x, sign_y, sign_z;
    uint at, first, end;         // index of the row; columns
} run_t;

static inline run_t run_of(__global const uint *runs, const uint number, const uint stride)
{
    __global const uint *words = runs + number * RUN_WORDS;
    const uint place = words[3], mask = (1u << PLACE_BITS) - 1u;
    run_t run;
    run.row = (float)words[0] + 0.5f;
    run.at = words[0] * stride;
    run.first = words[1];
    run.end = words[2];
    run.i = (float)(place & mask) - 1.0f;
    run.j = (float)((place >> PLACE_BITS) & mask) - 1.0f;
    run.sign_x = (place >> (2 * PLACE_BITS)) & 1u ? -1.0f : 1.0f;
    run.sign_y = (place >> (2 * PLACE_BITS + 1)) & 1u ? -1.0f : 1.0f;
    run.sign_z = (place >> (2 * PLACE_BITS + 2)) & 1u ? -1.0f : 1.0f;
    return run;
}

/* Weights of the four texels for LANES pixels from a column on; `inside` is 1 for pixels of the run from `from` on. */
static inline void corner_weights(
    const run_t *run, __constant camera_t *camera, const float half_side, const uint column, const uint from,
    VF *weights, VF *inside)
{
    __constant float *m = camera->world_to_camera;
    const VI lane = LANE_INDEX + (int)column;
    const VF one = (VF)(1.0f), zero = (VF)(0.0f);
    const VF ray_x = (to_VF(lane) + (0.5f - camera->cx)) / camera->fx;
    const float ray_y = (run->row - camera->cy) / camera->fy;
    const VF x = m[0] * ray_x + (m[4] * ray_y + m[8]);
    const VF y = m[1] * ray_x + (m[5] * ray_y + m[9]);
    const VF z = m[2] * ray_x + (m[6] * ray_y + m[10]);
    const VF scale = half_side / (run->sign_x * x + run->sign_y * y + run->sign_z * z);
    const VF below = run->sign_z < 0.0f ? z : zero;
    const VF a = (x - run->sign_x * below) * scale + (half_side - 0.5f - run->i);
    const VF b = (y - run->sign_y * below) * scale + (half_side - 0.5f - run->j);
    weights[0] = (1.0f - a) * (1.0f - b);
    weights[1] = a * (1.0f - b);
    weights[2] = (1.0f - a) * b;
    weights[3] = a * b;
    *inside = lane >= (int)from ? (lane < (int)run->end ? one : zero) : zero;
}

/* Add T b to the image.  One item = a strip of runs, in order: vectors may reach into other runs of the item, but not
 * of other items.  No local memory. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sky_forward(
    __global const uint *restrict runs,            // [R,RUN_WORDS]
    __global const uint *restrict strips,          // [strips + 1] first run of each
    __global const float *restrict texels,         // [3,side * side]
    __constant camera_t *restrict camera,          // [1]
    __global const float *restrict transmittance,  // [H',stride]
    __global float *restrict image,                // [3 or 4,H',stride]
    const float half_side,                         // side / 2
    const uint map_plane,                          // side * side
    const uint plane,                              // H' * stride
    const uint stride,
    const uint count)                              // strips
{
    const uint strip = get_global_id(0);
    if (strip >= count)
        return;
    for (uint number = strips[strip]; number < strips[strip + 1]; number++) {
        const run_t run = run_of(runs, number, stride);
        __global const uint *corners = runs + number * RUN_WORDS + CORNERS;
        for (uint x = run.first; x < run.end; x += LANES) {
            const uint column = x + LANES > stride ? stride - LANES : x;
            VF weights[CORNERS], inside;
            corner_weights(&run, camera, half_side, column, x, weights, &inside);
            const uint at = run.at + column;
            const VF seen = inside * magnitude(VLOAD(transmittance + at));
            for (uint channel = 0; channel < 3; channel++) {
                __global const float *values = texels + channel * map_plane;
                VF color = (VF)(0.0f);
                for (uint k = 0; k < CORNERS; k++)
                    color += weights[k] * values[corners[k]];
                VSTORE(VLOAD(image + channel * plane + at) + seen * color, image + channel * plane + at);
            }
        }
    }
}

/* Whether the photograph shows the map's color, 1 or 0: the mean difference of the channels is small, and all four
 * texels are learned.  Items and memory are as in sky_forward. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sky_matches(
    __global const uint *restrict runs,         // [R,RUN_WORDS]
    __global const uint *restrict strips,       // [strips + 1] first run of each
    __global const float *restrict texels,      // [3,side * side]
    __global const float *restrict free,        // [side * side] 1 for learned texels, else 0
    __constant camera_t *restrict camera,       // [1]
    __global const float *restrict photograph,  // [3,H',stride]
    __global float *restrict matches,           // [H' + 2,stride + 2 BORDER] initially zero
    const float difference,                     // largest difference of a matching pixel
    const float half_side,                      // side / 2
    const uint map_plane,                       // side * side
    const uint plane,                           // H' * stride
    const uint stride,
    const uint count)                           // strips
{
    const uint strip = get_global_id(0);
    if (strip >= count)
        return;
    for (uint number = strips[strip]; number < strips[strip + 1]; number++) {
        const run_t run = run_of(runs, number, stride);
        __global const uint *corners = runs + number * RUN_WORDS + CORNERS;
        for (uint x = run.first; x < run.end; x += LANES) {
            const uint column = x + LANES > stride ? stride - LANES : x;
            VF weights[CORNERS], inside;
            corner_weights(&run, camera, half_side, column, x, weights, &inside);
            const uint at = run.at + column;
            VF total_difference = (VF)(0.0f);
            for (uint channel = 0; channel < 3; channel++) {
                __global const float *values = texels + channel * map_plane;
                VF color = (VF)(0.0f);
                for (uint k = 0; k < CORNERS; k++)
                    color += weights[k] * values[corners[k]];
                total_difference += magnitude(color - VLOAD(photograph + channel * plane + at));
            }
            float learned = 1.0f;
            for (uint k = 0; k < CORNERS; k++)
                learned *= free[corners[k]];
            const VF matched = total_difference <= 3.0f * difference ? inside * learned : (VF)(0.0f);
            __global float *match = matches + (run.at / stride + 1) * (stride + 2 * BORDER) + BORDER + column;
            VSTORE(VLOAD(match) + matched, match);
        }
    }
}

/* The loss of splats that cover the sky: weight / (width height) times the sum of 1 - T over pixels with a 3 x 3
 * neighborhood that mostly matches.  Writes T dL/dT for blend_backward, and the sum of each row.
 * One group = one row.  Local memory: TEAM * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void sky_cover(
    __global const float *restrict matches,        // [H' + 2,stride + 2 BORDER]
    __global const float *restrict transmittance,  // [H',stride]
    __global float *restrict behind,               // [H',stride] T dL/dT
    __global float *restrict row_sums,             // [H'] sums of 1 - T
    const float scale,                             // weight / (width height)
    const uint width,
    const uint height,
    const uint stride)
{
    __local float sums[TEAM];
    const uint item = get_local_id(0), y = get_group_id(1), columns = y < height ? width : 0;
    const uint padded_stride = stride + 2 * BORDER;
    VF total = (VF)(0.0f);
    for (uint x = item * LANES; x < stride; x += TEAM * LANES) {
        const uint at = y * stride + x;
        VF box = (VF)(0.0f);
        for (uint row = y; row < y + 3; row++) {
            __global const float *match = matches + row * padded_stride + BORDER + x;
            box += VLOAD(match - 1) + VLOAD(match) + VLOAD(match + 1);
        }
        const VF chosen = box > 9.0f * MATCH_FRACTION ? inside_row(x, columns) : (VF)(0.0f);
        const VF t = magnitude(VLOAD(transmittance + at));
        VSTORE(-scale * (chosen * t), behind + at);
        total += chosen * (1.0f - t);
    }
    sums[item] = sum_lanes(total);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0)
        row_sums[y] = sum_items(sums);
}

/* Sums of T g w over the pixels of a run, for each corner's weight w and channel of the gradient g with respect to the
 * image.  One item = one run.  No local memory. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sky_backward(
    __global const uint *restrict runs,            // [R,RUN_WORDS]
    __constant camera_t *restrict camera,          // [1]
    __global const float *restrict transmittance,  // [H',stride]
    __global const float *restrict gradient,       // [3 or 4,H',stride] with respect to the image
    __global float *restrict run_sums,             // [R,RUN_SUMS]
    const float half_side,                         // side / 2
    const uint plane,                              // H' * stride
    const uint stride,
    const uint count)                              // R
{
    const uint number = get_global_id(0);
    if (number >= count)
        return;
    const run_t run = run_of(runs, number, stride);
    VF sums[RUN_SUMS];
    for (uint k = 0; k < RUN_SUMS; k++)
        sums[k] = (VF)(0.0f);
    for (uint x = run.first; x < run.end; x += LANES) {
        const uint column = x + LANES > stride ? stride - LANES : x;
        VF weights[CORNERS], inside;
        corner_weights(&run, camera, half_side, column, x, weights, &inside);
        const uint at = run.at + column;
        const VF seen = inside * magnitude(VLOAD(transmittance + at));
        for (uint channel = 0; channel < 3; channel++) {
            const VF through = seen * VLOAD(gradient + channel * plane + at);
            for (uint k = 0; k < CORNERS; k++)
                sums[k * 3 + channel] += weights[k] * through;
        }
    }
    for (uint k = 0; k < RUN_SUMS; k++)
        run_sums[number * RUN_SUMS + k] = sum_lanes(sums[k]);
}

/* Gradients of the texels that the view shows: sums over the corners of runs, in the order of the runs.
 * One item = one channel of one such texel; dimensions texel, channel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sky_gather(
    __global const float *restrict run_sums,   // [R,RUN_SUMS]
    __global const uint *restrict first_entry, // [shown + 1]
    __global const uint *restrict entries,     // [R * CORNERS] run * CORNERS + corner, by texel
    __global float *restrict grad_texels,      // [3,shown]
    const uint shown)                          // texels that the view shows
{
    const uint index = get_global_id(0), channel = get_global_id(1);
    if (index >= shown)
        return;
    float sum = 0.0f;
    for (uint k = first_entry[index]; k < first_entry[index + 1]; k++)
        sum += run_sums[entries[k] * 3 + channel];
    grad_texels[channel * shown + index] = sum;
}

/* Adam on the learned texels that the view shows, with a bias correction for the number of updates of each texel: 1 -
 * BETA^t, by the recursion of the moments for a gradient of 1.  The gradient is in pixels of L1: a texel that is
 * visible in less than a pixel, as behind a wall, hardly changes.  One item = one texel. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sky_update(
    __global const uint *restrict shown_texels,  // [shown]
    __global const float *restrict grad_texels,  // [3,shown]
    __global const float *restrict free,         // [side * side] 1 for learned texels, else 0
    __global float *restrict texels,             // [3,side * side]
    __global float *restrict moment1,            // [3,side * side]
    __global float *restrict moment2,            // [3,side * side]
    __global float *restrict biases,             // [2,side * side] bias corrections of the moments
    const float rate,
    const float pixels,                          // factor on the gradient: 3 width height
    const uint map_plane,                        // side * side
    const uint shown)
{
    const uint index = get_global_id(0);
    if (index >= shown)
        return;
    const uint texel = shown_texels[index];
    const float bias1 = BETA1 * biases[texel] + (1.0f - BETA1);
    const float bias2 = BETA2 * biases[map_plane + texel] + (1.0f - BETA2);
    for (uint channel = 0; channel < 3; channel++) {
        const uint at = channel * map_plane + texel;
        const float g = grad_texels[channel * shown + index] * pixels;
        const float m = BETA1 * moment1[at] + (1.0f - BETA1) * g;
        const float v = BETA2 * moment2[at] + (1.0f - BETA2) * (g * g);
        moment1[at] = m;
        moment2[at] = v;
        texels[at] -= free[texel] * rate * (m / bias1) / (sqrt(v / bias2) + SKY_EPSILON);
    }
    biases[texel] = bias1;
    biases[map_plane + texel] = bias2;
}
