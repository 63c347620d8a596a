/* A multiresolution hash grid of features, the input of a network instead of sines (Müller et al. 2022), with each
 * level weighted by how well a sample resolves it (Barron et al. 2023, "Zip-NeRF", section 3.1).
 *
 *   position mean of a frustum (frustum.h) in a cube, u = (x - corner) / side, and v = variance / side^2: the mean of
 *            the variances along the three axes, as for a sphere
 *   level    a cube of n^3 cells; each of the (n + 1)^3 corners has an entry of GRID_FEATURES values.  Where a level
 *            has fewer entries, corners share them: index (x ^ y * HASH_Y ^ z * HASH_Z) modulo the entries (equation 4)
 *   feature  w * (trilinear mean of the 8 entries around u), w = erf(1 / sqrt(8 v n^2)), by erf(x) ~ sqrt(1 - exp(-4/pi
 *            x^2)), whose error is at most 0.7 %: so w = sqrt(1 - exp(-1 / (2 pi v n^2)))
 *
 * Outside the cube all features are 0.  Backward: an item owns a range of a level's entries and adds the gradients of
 * all samples to it in order, without atomics, so results do not depend on the number of items per level.  No local
 * memory. */
#include "frustum.h"
#include "layers.h"

#define GRID_FEATURES 4  // features of an entry: one block of rows
#define PLACE_ROWS 4     // values of a sample: u along x, y, z, and v
#define LEVEL_VALUES 4   // values of a level: n, first entry, number of entries, 1 if corners share entries
#define HASH_Y 2654435761u
#define HASH_Z 805459861u
#define CORNERS 8
#define TWO_PI 6.28318531f
#define SERIES_MAX 0.01f  // below it, 1 - e^-x is computed as a series, since the difference would lose digits

/* LANES samples in a level: the index of the first corner of the cell along each axis, the offset in the cell, w. */
typedef struct {
    int x[LANES], y[LANES], z[LANES];
    float offset_x[LANES], offset_y[LANES], offset_z[LANES], weight[LANES];
} cells_t;

/* The cell along an axis, and the offset in it; positions at the end of the cube are in the last cell. */
static inline void cell_along(const VF u, const float n, int *cell, float *offset)
{
    const VF scaled = n * u, below = floor(scaled), last = larger(smaller(below, (VF)(n - 1.0f)), (VF)(0.0f));
    VSTORE_INT_PRIVATE(to_VI(last), cell);
    VSTORE_PRIVATE(scaled - last, offset);
}

static inline void find_cells(__global const float *places, const uint n, cells_t *cells)
{
    const VF x = VLOAD(places), y = VLOAD(places + SAMPLES), z = VLOAD(places + 2 * SAMPLES);
    const float size = (float)n;
    const VF part = 1.0f / (TWO_PI * size * size * VLOAD(places + 3 * SAMPLES));
    const VF series = part * (1.0f - part * (0.5f - part / 6.0f));
    const VF weight = sqrt(part < SERIES_MAX ? series : 1.0f - exp_clamped(-part));
    const VI inside = (x >= 0.0f) & (x <= 1.0f) & (y >= 0.0f) & (y <= 1.0f) & (z >= 0.0f) & (z <= 1.0f);  // not NaN
    VSTORE_PRIVATE((inside ? weight : (VF)(0.0f)), cells->weight);
    cell_along(x, size, cells->x, cells->offset_x);
    cell_along(y, size, cells->y, cells->offset_y);
    cell_along(z, size, cells->z, cells->offset_z);
}

/* The entries of the corners of a lane's cell, in their level, and the weights of the trilinear mean. */
static inline void find_corners(const cells_t *cells, const uint lane, const uint n, const uint entries,
                                const uint shared, uint *entry, float *weight)
{
    const uint step_y = shared ? HASH_Y : n + 1, step_z = shared ? HASH_Z : (n + 1) * (n + 1);
    const uint x = (uint)cells->x[lane], y = (uint)cells->y[lane] * step_y, z = (uint)cells->z[lane] * step_z;
    const float dx = cells->offset_x[lane], dy = cells->offset_y[lane], dz = cells->offset_z[lane];
    const float level_weight = cells->weight[lane];
    for (uint corner = 0; corner < CORNERS; corner++) {
        const uint right = corner & 1, down = corner >> 1 & 1, back = corner >> 2;
        const uint a = x + right, b = y + down * step_y, c = z + back * step_z;
        entry[corner] = shared ? (a ^ b ^ c) & (entries - 1) : a + b + c;
        weight[corner] = level_weight * (right ? dx : 1.0f - dx) * (down ? dy : 1.0f - dy) * (back ? dz : 1.0f - dz);
    }
}

/* Positions of samples in the cube.  One item = LANES samples of one ray. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void grid_places(
    __global const float *restrict cones,  // [rays,RAY_VALUES_READ]
    __global const float *restrict edges,  // [rays,samples + 1]
    __global float *restrict places,       // [T,PLACE_ROWS,SAMPLES]
    const float corner_x,                  // corner of the cube, scene units
    const float corner_y,
    const float corner_z,
    const float side,                      // side of the cube, scene units
    const uint samples,                    // samples of a ray: a multiple of LANES
    const uint count)                      // rays * samples
{
    const uint first = get_global_id(0) * LANES;
    if (first >= count)
        return;
    __global const float *cone = cones + first / samples * RAY_VALUES_READ;
    __global const float *t = edges + first / samples * (samples + 1) + first % samples;
    __global float *sample = places + feature_at(first, 0, PLACE_ROWS);
    const frustum_t f = frustum_of(cone, VLOAD(t), VLOAD(t + 1));
    VSTORE((cone[0] + cone[3] * f.distance - corner_x) / side, sample);
    VSTORE((cone[1] + cone[4] * f.distance - corner_y) / side, sample + SAMPLES);
    VSTORE((cone[2] + cone[5] * f.distance - corner_z) / side, sample + 2 * SAMPLES);
    VSTORE((cone[7] * cone[7] * f.along + 2.0f * f.across) / (3.0f * side * side), sample + 3 * SAMPLES);
}

/* Features of samples.  One item = LANES samples of one level. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void grid_forward(
    __global const float *restrict places,      // [T,PLACE_ROWS,SAMPLES]
    __global const uint *restrict levels,       // [levels,LEVEL_VALUES]
    __global const float *restrict parameters,  // [P] from first_parameter on: entries [entries,GRID_FEATURES]
    __global float *restrict features,          // [T,rows,SAMPLES] from first_row on, GRID_FEATURES for each level
    const uint first_parameter,
    const uint rows,
    const uint first_row,
    const uint samples,                         // T * SAMPLES
    const uint count)                           // items: levels * samples / LANES
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint level = i / (samples / LANES), first = i % (samples / LANES) * LANES;
    __global const uint *values = levels + level * LEVEL_VALUES;
    const uint n = values[0], entries = values[2], shared = values[3];
    __global const float4 *table = (__global const float4 *)(parameters + first_parameter) + values[1];
    cells_t cells;
    find_cells(places + feature_at(first, 0, PLACE_ROWS), n, &cells);
    float sums[GRID_FEATURES][LANES];
    for (uint lane = 0; lane < LANES; lane++) {
        float4 sum = (float4)(0.0f);
        if (cells.weight[lane] != 0.0f) {
            uint entry[CORNERS];
            float weight[CORNERS];
            find_corners(&cells, lane, n, entries, shared, entry, weight);
            for (uint corner = 0; corner < CORNERS; corner++)
                sum += weight[corner] * table[entry[corner]];
        }
        sums[0][lane] = sum.x;
        sums[1][lane] = sum.y;
        sums[2][lane] = sum.z;
        sums[3][lane] = sum.w;
    }
    __global float *own = features + feature_at(first, first_row + level * GRID_FEATURES, rows);
    for (uint k = 0; k < GRID_FEATURES; k++)
        VSTORE(VLOAD_PRIVATE(sums[k]), own + k * SAMPLES);
}

/* Add the gradient of the entries.  One item = a range of the entries of one level, for all samples. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void grid_backward(
    __global const float *restrict places,       // [T,PLACE_ROWS,SAMPLES]
    __global const uint *restrict levels,        // [levels,LEVEL_VALUES]
    __global const float *restrict grad_features,  // [T,rows,SAMPLES] GRID_FEATURES for each level
    __global float *restrict gradient,           // [P] from first_parameter on: entries [entries,GRID_FEATURES]
    const uint first_parameter,
    const uint rows,
    const uint parts,                            // parts of a level
    const uint samples,                          // T * SAMPLES
    const uint count)                            // items: levels * parts
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint level = i / parts;
    __global const uint *values = levels + level * LEVEL_VALUES;
    const uint n = values[0], entries = values[2], shared = values[3];
    const uint size = (entries + parts - 1) / parts, begin = i % parts * size;
    __global float4 *table = (__global float4 *)(gradient + first_parameter) + values[1];
    for (uint first = 0; first < samples; first += LANES) {
        cells_t cells;
        find_cells(places + feature_at(first, 0, PLACE_ROWS), n, &cells);
        __global const float *grads = grad_features + feature_at(first, level * GRID_FEATURES, rows);
        float lanes[GRID_FEATURES][LANES];
        for (uint k = 0; k < GRID_FEATURES; k++)
            VSTORE_PRIVATE(VLOAD(grads + k * SAMPLES), lanes[k]);
        for (uint lane = 0; lane < LANES; lane++) {
            const float4 grad = (float4)(lanes[0][lane], lanes[1][lane], lanes[2][lane], lanes[3][lane]);
            if (cells.weight[lane] == 0.0f || (grad.x == 0.0f && grad.y == 0.0f && grad.z == 0.0f && grad.w == 0.0f))
                continue;
            uint entry[CORNERS];
            float weight[CORNERS];
            find_corners(&cells, lane, n, entries, shared, entry, weight);
            for (uint corner = 0; corner < CORNERS; corner++)
                if (entry[corner] - begin < size)
                    table[entry[corner]] += weight[corner] * grad;
        }
    }
}
