/* Blending for CPUs: one item = one tile, LANES pixels of a row at a time; the forward pass blends two vectors of
 * pixels together, so that their dependent transmittances overlap.  Kerbl et al. 2023, eq. 3; the formulas are in
 * splat.h. */
#include "rows.h"

#define TOGETHER (COLUMNS > 1 ? 1 : 2)  // rows of a tile that are blended together

/* 1 where the pixel is in the image, else 0: losses need planes that are zero outside. */
static inline VF inside_image(__constant camera_t *camera, const VF pixel, const uint row)
{
    const VF one = (VF)(1.0f), zero = (VF)(0.0f);
    return row < camera->height ? (pixel < (float)camera->width ? one : zero) : zero;
}

/* Private memory: SEGMENT * 72 bytes of splats, SEGMENT * TILE * LINE_FIELDS * 4 of their lines and TILE * TILE * 16
 * of pixels.  Deterministic. */
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend_forward(
    __global const uint *restrict tile_offset,  // [T+1]
    __global const uint *restrict tile_pairs,   // [P] front to back inside a tile
    __global const uint *restrict pair_splat,   // [P]
    __global const float *restrict splats,      // [N,RECORD]
    __constant float *restrict background,      // [3]
    __constant camera_t *restrict camera,       // [1]
    __global float *restrict image,             // [3 + INVERSE_DEPTH,tiles_y*TILE,tiles_x*TILE]
    __global float *restrict transmittance,     // [tiles_y*TILE,tiles_x*TILE]
    __global uint *restrict tile_last,          // [T] pairs of the tile up to the last that any pixel blends
    const uint first_tile)                      // first tile of the launch
{
    const uint tile = first_tile + get_global_id(0);
    const uint tile_y = tile / camera->tiles_x, tile_x = tile - tile_y * camera->tiles_x;
    const uint first = tile_offset[tile], end = tile_offset[tile + 1];
    const uint width = camera->tiles_x * TILE, plane = width * camera->tiles_y * TILE;
    __global const float16 *records = (__global const float16 *)splats;
    float16 segment[SEGMENT];
    float lines[SEGMENT][LINE_FIELDS][TILE];
    uchar lists[TILE / 2][SEGMENT];
    uint listed[TILE / 2];
    VF centers[COLUMNS];
    for (uint column = 0; column < COLUMNS; column++)
        centers[column] = pixel_centers(tile_x, column);
    pixels_t pixels[TILE * COLUMNS];
    for (uint v = 0; v < TILE * COLUMNS; v++) {
        const pixels_t clear = {(VF)(1.0f), (VF)(0.0f), (VF)(0.0f), (VF)(0.0f)};
        pixels[v] = clear;
    }

    uint last = first;
    bool unfinished = true;
    for (uint begin = first; begin < end && unfinished; begin += SEGMENT) {
        const uint length = end - begin < SEGMENT ? end - begin : SEGMENT;
        for (uint j = 0; j < length; j++)
            segment[j] = records[pair_splat[tile_pairs[begin + j]]];
        for (uint j = 0; j < length; j++)
            lines_of((const float *)(segment + j), tile_x, tile_y, lines[j], 0);
        list_splats(segment, length, tile_y, lists, listed);
        unfinished = false;
        for (uint v = 0; v < TILE * COLUMNS; v += 2) {  // and the next vector
            const uint y = v / COLUMNS, below = y + TOGETHER - 1, right = (v + 1) % COLUMNS;
            const uint count = listed[y / 2];
            const uchar *list = lists[y / 2];
            pixels_t one = pixels[v], other = pixels[v + 1];
            bool open = ANY((one.t > 0.0f) | (other.t > 0.0f));
            for (uint some = 0; some < count && open; some += 16) {
                const uint stop = some + 16 < count ? some + 16 : count;
                for (uint k = some; k < stop; k++) {
                    const float *splat = (const float *)(segment + list[k]);
                    blend(&one, SPLAT_AT(splat, lines[list[k]], y, 0), centers[0], splat + SPLAT_RED);
                    blend(&other, SPLAT_AT(splat, lines[list[k]], below, right), centers[right], splat + SPLAT_RED);
                }
                open = ANY((one.t > 0.0f) | (other.t > 0.0f));
                const uint reached = begin + list[stop - 1] + 1;
                last = reached > last ? reached : last;
            }
            pixels[v] = one;
            pixels[v + 1] = other;
            unfinished = unfinished || open;
        }
    }

    tile_last[tile] = last - first;
    for (uint y = 0; y < TILE; y++)
        for (uint column = 0; column < COLUMNS; column++) {
            const uint row = tile_y * TILE + y;
            const uint at = row * width + tile_x * TILE + column * LANES;
            const VF inside = inside_image(camera, centers[column], row);
            const pixels_t p = pixels[y * COLUMNS + column];
            const VF t = magnitude(p.t);
            VSTORE((p.red + t * background[0]) * inside, image + at);
            VSTORE((p.green + t * background[1]) * inside, image + plane + at);
            VSTORE((p.blue + t * background[2]) * inside, image + 2 * plane + at);
            VSTORE(t * inside, transmittance + at);
#if INVERSE_DEPTH
            VSTORE(p.inverse_depth * inside, image + 3 * plane + at);
#endif
        }
}

/* Fold two vectors into one: the lower lanes of each part plus the upper ones. */
#define FOLD(a, b, low, high) ((VF)((a).low, (b).low) + (VF)((a).high, (b).high))
#if LANES == 16
#define FOLD_TWICE(a, b, c, d) FOLD(FOLD(a, b, lo, hi), FOLD(c, d, lo, hi), s012389ab, s4567cdef)
#else
#define FOLD_TWICE(a, b, c, d) FOLD(FOLD(a, b, lo, hi), FOLD(c, d, lo, hi), s0145, s2367)
#endif

/* Sum the lanes of each sum over pixels, as sum_lanes does, and write one record. */
static inline void store_record(const pixel_sums_t m, __global float *record)
{
    const VF a = FOLD_TWICE(m.power, m.x, m.y, m.xx), b = FOLD_TWICE(m.xy, m.yy, m.red, m.green);
    const VF c = FOLD_TWICE(m.blue, m.abs_x, m.abs_y, m.weight);
#if INVERSE_DEPTH
    const VF last = m.inverse_depth;
#else
    const VF last = (VF)(0.0f);
#endif
    const VF d = FOLD_TWICE(m.texture, m.blended, m.square, last);
#if LANES == 16
    const VF low = FOLD(a, b, s014589cd, s2367abef), high = FOLD(c, d, s014589cd, s2367abef);
    *(__global float16 *)record = FOLD(low, high, even, odd);
#else
    *(__global float16 *)record = (float16)(FOLD(a, b, even, odd), FOLD(c, d, even, odd));
#endif
}

#if PIXEL_BOX
/* Add a row of pixels. */
static inline void add_row(const float *splat, const float (*lines)[TILE], const float (*slopes)[TILE],
                           const bool turned, const float row, const uint y, const VF *centers,
                           grad_pixels_t *pixels, pixel_sums_t *sums)
{
    for (uint column = 0; column < COLUMNS; column++) {
        const VF pixel = centers[column];
        row_splat_t s = splat_on_lines(splat, lines, turned, row, y, column, pixel);
        for (uint k = 0; k < SLOPE_FIELDS; k++)
            ((VF *)&s.slopes)[k] = field_at(slopes[k], turned, y, column);
        blend_backward_step(pixels + column, s, pixel, splat + SPLAT_RED, sums);
    }
}
#endif

/* Sum one splat over the rows of its tile that it reaches. */
static inline void pixel_sums_of(const float *splat, const uint tile_x, const uint tile_y, const VF *centers,
                                 grad_pixels_t *pixels, pixel_sums_t *sums)
{
    const VF zero = (VF)(0.0f);
    pixel_sums_t pixel_sums = {zero, zero, zero, zero, zero, zero, zero, zero,
                               zero, zero, zero, zero, zero, zero, zero};
    float lines[LINE_FIELDS][TILE], slopes[SLOPE_FIELDS][TILE];
    lines_of(splat, tile_x, tile_y, lines, slopes);
    const float top = tile_y * TILE + 0.5f;
    const float low = splat[SPLAT_Y_MIN] - top, high = splat[SPLAT_Y_MAX] - top;
    const uint y_below = low > 0.0f ? (uint)low : 0u, y_first = y_below + (low > (float)y_below ? 1u : 0u);
    const uint y_end = high < 0.0f ? 0u : high < TILE - 1.0f ? (uint)(high + 1.0f) : TILE;
#if PIXEL_BOX
    if (splat[BOX_TURNED] > 0.0f)  // two loops, so that the fields are constant in each
        for (uint y = y_first; y < y_end; y++)
            add_row(splat, lines, slopes, true, top + y, y, centers, pixels + y * COLUMNS, &pixel_sums);
    else
        for (uint y = y_first; y < y_end; y++)
            add_row(splat, lines, slopes, false, top + y, y, centers, pixels + y * COLUMNS, &pixel_sums);
#else
    /* One vector after the other, in one loop: two at once need too many registers. */
    for (uint v = y_first * COLUMNS; v < y_end * COLUMNS; v++) {
        const row_splat_t at_row = splat_on_lines(splat, lines, slopes, v / COLUMNS);
        blend_backward_step(pixels + v, at_row, centers[v % COLUMNS], splat + SPLAT_RED, &pixel_sums);
    }
#endif
    *sums = pixel_sums;
}

/* The outer loop runs over splats, the inner one over rows: a splat's record is summed in registers and written once,
 * at the pair's address; the records of pairs that no pixel blends are zero.  Private memory: SEGMENT * 68 bytes of
 * splats, TILE * (LINE_FIELDS + SLOPE_FIELDS) * 4 of lines and TILE * TILE * 20 of pixels.  Deterministic. */
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend_backward(
    __global const uint *restrict tile_offset,  // [T+1]
    __global const uint *restrict tile_pairs,   // [P] front to back inside a tile
    __global const uint *restrict pair_splat,   // [P]
    __global const float *restrict splats,      // [N,RECORD]
    __constant camera_t *restrict camera,       // [1]
    __global const float *restrict image,       // [3 + INVERSE_DEPTH,tiles_y*TILE,tiles_x*TILE]
    __global const float *restrict grad_image,  // [3 + INVERSE_DEPTH,tiles_y*TILE,tiles_x*TILE]
    __global const float *restrict texture,     // [tiles_y*TILE,tiles_x*TILE] read where PIXEL_SUMS > SUM_WEIGHT
    __global const float *restrict behind,      // [tiles_y*TILE,tiles_x*TILE] T dL/dT, read where GRAD_BEHIND
    __global const uint *restrict tile_last,    // [T]
    __global float *restrict pair_sums,         // [P,RECORD] in emission order
    const uint first_tile)                      // first tile of the launch
{
    const uint tile = first_tile + get_global_id(0);
    const uint tile_y = tile / camera->tiles_x, tile_x = tile - tile_y * camera->tiles_x;
    const uint width = camera->tiles_x * TILE, plane = width * camera->tiles_y * TILE;
    __global const float16 *records = (__global const float16 *)splats;
    VF centers[COLUMNS];
    for (uint column = 0; column < COLUMNS; column++)
        centers[column] = pixel_centers(tile_x, column);
    grad_pixels_t pixels[TILE * COLUMNS];
    for (uint y = 0; y < TILE; y++)
        for (uint column = 0; column < COLUMNS; column++) {
            const uint at = (tile_y * TILE + y) * width + tile_x * TILE + column * LANES;
            grad_pixels_t p;
            p.t = (VF)(1.0f);
            p.red = VLOAD(grad_image + at);
            p.green = VLOAD(grad_image + plane + at);
            p.blue = VLOAD(grad_image + 2 * plane + at);
            p.rest = p.red * VLOAD(image + at) + p.green * VLOAD(image + plane + at) +
                     p.blue * VLOAD(image + 2 * plane + at);
#if GRAD_BEHIND
            p.rest = p.rest + VLOAD(behind + at);
#endif
#if PIXEL_SUMS > SUM_WEIGHT
            p.texture = VLOAD(texture + at);
#endif
#if INVERSE_DEPTH
            p.inverse_depth = VLOAD(grad_image + 3 * plane + at);
            p.rest = p.rest + p.inverse_depth * VLOAD(image + 3 * plane + at);
#endif
            pixels[y * COLUMNS + column] = p;
        }

    const uint first = tile_offset[tile], end = tile_offset[tile + 1], last = first + tile_last[tile];
    for (uint begin = first; begin < last; begin += SEGMENT) {
        const uint length = last - begin < SEGMENT ? last - begin : SEGMENT;
        float16 segment[SEGMENT];
        uint pairs[SEGMENT];
        for (uint j = 0; j < length; j++) {  // all loads in one loop, so that waits for memory overlap
            pairs[j] = tile_pairs[begin + j];
            segment[j] = records[pair_splat[pairs[j]]];
        }
        for (uint j = 0; j < length; j++) {
            pixel_sums_t pixel_sums;
            pixel_sums_of((const float *)(segment + j), tile_x, tile_y, centers, pixels, &pixel_sums);
            store_record(pixel_sums, pair_sums + (size_t)pairs[j] * RECORD);
        }
    }
    for (uint j = last; j < end; j++)
        ((__global float16 *)pair_sums)[tile_pairs[j]] = (float16)(0.0f);
}
