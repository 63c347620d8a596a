/* Blending for CPUs: one item = one tile, LANES pixels of a row at a time, two rows together so that their chains of
 * transmittance overlap.  Kerbl et al. 2023, eq. 3; the formulas are in splat.h. */
#include "splat.h"

#define COLUMNS (TILE / LANES)  // vectors per tile row
#if PIXEL_BOX
#define SEGMENT 64              // with the lines of each, TILE * 16 bytes
#else
#define SEGMENT 128             // splats of a tile loaded together: one wait for memory, then rows read the cache
#endif

static inline VF pixel_centres(const uint tile_x, const uint column)
{
    return to_VF(LANE_INDEX + (int)(tile_x * TILE + column * LANES)) + 0.5f;
}

/* 1 where the pixel lies in the image, else 0: losses need planes that are zero outside. */
static inline VF inside_image(__constant camera_t *camera, const VF pixel, const uint row)
{
    const VF one = (VF)(1.0f), zero = (VF)(0.0f);
    return row < camera->height ? (pixel < (float)camera->width ? one : zero) : zero;
}

#if PIXEL_BOX
#define LINE_FIELDS (sizeof(line_t) / sizeof(VF))
#define SLOPE_FIELDS (sizeof(slopes_t) / sizeof(VF))
#define SPLAT_AT(splat, lines, row, y) splat_on_lines(splat, lines, splat[BOX_TURNED] > 0.0f, row, y, column, pixel)

/* The lines of a splat through a tile, rows or columns, each field of all lines together. */
static inline void lines_of(const float *splat, const uint tile_x, const uint tile_y, float (*lines)[TILE],
                            float (*slopes)[TILE])
{
    for (uint column = 0; column < COLUMNS; column++) {
        line_t line;
        slopes_t slope;
        line_of(splat, pixel_centres(splat[BOX_TURNED] > 0.0f ? tile_x : tile_y, column), &line, &slope);
        for (uint k = 0; k < LINE_FIELDS; k++)
            VSTORE(((const VF *)&line)[k], lines[k] + column * LANES);
        for (uint k = 0; slopes && k < SLOPE_FIELDS; k++)
            VSTORE(((const VF *)&slope)[k], slopes[k] + column * LANES);
    }
}

/* A field at LANES pixels of row y of a tile: of their columns, or of the row alone. */
static inline VF field_at(const float *field, const bool turned, const uint y, const uint column)
{
    return turned ? VLOAD(field + column * LANES) : (VF)(field[y]);
}

static inline row_splat_t splat_on_lines(const float *splat, const float (*lines)[TILE], const bool turned,
                                         const float row, const uint y, const uint column, const VF pixel)
{
    row_splat_t s = splat_at_pixels(splat, turned, row, pixel);
    for (uint k = 0; k < LINE_FIELDS; k++)
        ((VF *)&s.line)[k] = field_at(lines[k], turned, y, column);
    return s;
}
#else
#define SPLAT_AT(splat, lines, row, y) splat_at_row(splat, row)
#endif

/* Private memory: SEGMENT * 68 bytes of splats and TILE * TILE * 16 of pixels; with PIXEL_BOX also
 * SEGMENT * TILE * 16 of lines.  Deterministic. */
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend_forward(
    __global const uint *restrict tile_offset,  // [T+1]
    __global const uint *restrict tile_pairs,   // [P] front to back inside a tile
    __global const uint *restrict pair_splat,   // [P]
    __global const float *restrict splats,      // [N,RECORD]
    __constant float *restrict background,      // [3]
    __constant camera_t *restrict camera,       // [1]
    __global float *restrict image,             // [3 + WEIGHT_ENTROPY,tiles_y*TILE,tiles_x*TILE]
    __global float *restrict transmittance,     // [tiles_y*TILE,tiles_x*TILE]
    __global uint *restrict tile_last,          // [T] pairs of the tile up to the last that any pixel blends
    const uint first_tile)                      // of this launch
{
    const uint tile = first_tile + get_global_id(0);
    const uint tile_y = tile / camera->tiles_x, tile_x = tile - tile_y * camera->tiles_x;
    const uint first = tile_offset[tile], end = tile_offset[tile + 1];
    const uint width = camera->tiles_x * TILE, plane = width * camera->tiles_y * TILE;
    float segment[SEGMENT][RECORD];
#if PIXEL_BOX
    float lines[SEGMENT][LINE_FIELDS][TILE];
#endif
    uint list[SEGMENT];
    pixels_t pixels[TILE][COLUMNS];
    for (uint y = 0; y < TILE; y++)
        for (uint column = 0; column < COLUMNS; column++) {
            const pixels_t clear = {(VF)(1.0f), (VF)(0.0f), (VF)(0.0f), (VF)(0.0f)};
            pixels[y][column] = clear;
        }

    uint last = first;
    bool unfinished = true;
    for (uint begin = first; begin < end && unfinished; begin += SEGMENT) {
        const uint length = end - begin < SEGMENT ? end - begin : SEGMENT;
        for (uint j = 0; j < length; j++)
            vstore16(vload16(pair_splat[tile_pairs[begin + j]], splats), 0, segment[j]);
#if PIXEL_BOX
        for (uint j = 0; j < length; j++)
            lines_of(segment[j], tile_x, tile_y, lines[j], 0);
#endif
        unfinished = false;
        for (uint y = 0; y < TILE; y += 2) {
            const float row = tile_y * TILE + y + 0.5f;
            uint listed = 0;
            for (uint j = 0; j < length; j++) {  // branch-free compaction
                list[listed] = j;
                listed += (segment[j][SPLAT_Y_MIN] <= row + 1.0f) & (segment[j][SPLAT_Y_MAX] >= row);
            }
            for (uint column = 0; column < COLUMNS; column++) {
                const VF pixel = pixel_centres(tile_x, column);
                pixels_t upper = pixels[y][column], lower = pixels[y + 1][column];
                bool open = ANY((upper.t > 0.0f) | (lower.t > 0.0f));
                for (uint k = 0; k < listed && open; k++) {
                    const float *splat = segment[list[k]];
                    blend(&upper, SPLAT_AT(splat, lines[list[k]], row, y), pixel, splat + SPLAT_RED);
                    blend(&lower, SPLAT_AT(splat, lines[list[k]], row + 1.0f, y + 1), pixel, splat + SPLAT_RED);
                    if ((k & 15) == 15 || k + 1 == listed) {
                        open = ANY((upper.t > 0.0f) | (lower.t > 0.0f));
                        const uint reached = begin + list[k] + 1;
                        last = reached > last ? reached : last;
                    }
                }
                pixels[y][column] = upper;
                pixels[y + 1][column] = lower;
                unfinished = unfinished || open;
            }
        }
    }

    tile_last[tile] = last - first;
    for (uint y = 0; y < TILE; y++)
        for (uint column = 0; column < COLUMNS; column++) {
            const uint row = tile_y * TILE + y;
            const uint at = row * width + tile_x * TILE + column * LANES;
            const VF inside = inside_image(camera, pixel_centres(tile_x, column), row);
            const pixels_t p = pixels[y][column];
            const VF t = magnitude(p.t);
            VSTORE((p.red + t * background[0]) * inside, image + at);
            VSTORE((p.green + t * background[1]) * inside, image + plane + at);
            VSTORE((p.blue + t * background[2]) * inside, image + 2 * plane + at);
            VSTORE(t * inside, transmittance + at);
#if WEIGHT_ENTROPY
            VSTORE((p.entropy - t * log_weight(t)) * inside, image + 3 * plane + at);
#endif
        }
}

/* Sum the lanes of each sum over pixels and write one record. */
static inline void store_record(const pixel_sums_t m, __global float *record)
{
    const float16 sums = (float16)(
        sum_lanes(m.power), sum_lanes(m.x), sum_lanes(m.y), sum_lanes(m.xx), sum_lanes(m.xy), sum_lanes(m.yy),
        sum_lanes(m.red), sum_lanes(m.green), sum_lanes(m.blue), sum_lanes(m.abs_x), sum_lanes(m.abs_y),
        sum_lanes(m.weight), sum_lanes(m.texture), sum_lanes(m.blended), sum_lanes(m.square), 0.0f);
    vstore16(sums, 0, record);
}

#if PIXEL_BOX
/* Add a row of pixels. */
static inline void add_row(const float *splat, const float (*lines)[TILE], const float (*slopes)[TILE],
                           const bool turned, const float row, const uint y, const uint tile_x,
                           grad_pixels_t *pixels, pixel_sums_t *sums)
{
    for (uint column = 0; column < COLUMNS; column++) {
        const VF pixel = pixel_centres(tile_x, column);
        row_splat_t s = splat_on_lines(splat, lines, turned, row, y, column, pixel);
        for (uint k = 0; k < SLOPE_FIELDS; k++)
            ((VF *)&s.slopes)[k] = field_at(slopes[k], turned, y, column);
        blend_backward_step(pixels + column, s, pixel, splat + SPLAT_RED, sums);
    }
}
#endif

/* Sum one splat over the rows of its tile that it reaches, whole pairs of rows. */
static inline void pixel_sums_of(const float *splat, const uint tile_x, const uint tile_y,
                                 grad_pixels_t (*pixels)[COLUMNS], pixel_sums_t *sums)
{
    const VF zero = (VF)(0.0f);
    pixel_sums_t pixel_sums = {zero, zero, zero, zero, zero, zero, zero, zero,
                               zero, zero, zero, zero, zero, zero, zero};
#if PIXEL_BOX
    float lines[LINE_FIELDS][TILE], slopes[SLOPE_FIELDS][TILE];
    lines_of(splat, tile_x, tile_y, lines, slopes);
#endif
    const float top = tile_y * TILE + 0.5f;
    const float low = splat[SPLAT_Y_MIN] - top, high = splat[SPLAT_Y_MAX] - top;
    const uint y_first = low > 0.0f ? (uint)low : 0u;
    const uint y_end = high < TILE - 1.0f ? (uint)(high + 1.0f) : TILE;
#if PIXEL_BOX
    if (splat[BOX_TURNED] > 0.0f)  // apart, so that both loops know where their fields lie
        for (uint y = y_first; y < y_end; y++)
            add_row(splat, lines, slopes, true, top + y, y, tile_x, pixels[y], &pixel_sums);
    else
        for (uint y = y_first; y < y_end; y++)
            add_row(splat, lines, slopes, false, top + y, y, tile_x, pixels[y], &pixel_sums);
#else
    const uint y_begin = y_first - (y_end == TILE ? (y_end - y_first) & 1u : 0u);
    for (uint y = y_begin; y < y_end; y += 2) {
        const row_splat_t upper = splat_at_row(splat, top + y), lower = splat_at_row(splat, top + y + 1.0f);
        for (uint column = 0; column < COLUMNS; column++) {
            const VF pixel = pixel_centres(tile_x, column);
            blend_backward_step(&pixels[y][column], upper, pixel, splat + SPLAT_RED, &pixel_sums);
            blend_backward_step(&pixels[y + 1][column], lower, pixel, splat + SPLAT_RED, &pixel_sums);
        }
    }
#endif
    *sums = pixel_sums;
}

/* The outer loop runs over splats, the inner one over rows: a splat's record is summed in registers and written once,
 * at the pair's address; the records of pairs that no pixel blends are zero.  Private memory: SEGMENT * 68 bytes of
 * splats and TILE * TILE * 20 of pixels.  Deterministic. */
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend_backward(
    __global const uint *restrict tile_offset,  // [T+1]
    __global const uint *restrict tile_pairs,   // [P] front to back inside a tile
    __global const uint *restrict pair_splat,   // [P]
    __global const float *restrict splats,      // [N,RECORD]
    __constant camera_t *restrict camera,       // [1]
    __global const float *restrict image,       // [3 + WEIGHT_ENTROPY,tiles_y*TILE,tiles_x*TILE]
    __global const float *restrict grad_image,  // [3 + WEIGHT_ENTROPY,tiles_y*TILE,tiles_x*TILE]
    __global const float *restrict texture,     // [tiles_y*TILE,tiles_x*TILE] read where PIXEL_SUMS > SUM_WEIGHT
    __global const uint *restrict tile_last,    // [T]
    __global float *restrict pair_sums,         // [P,RECORD] in emission order
    const uint first_tile)                      // of this launch
{
    const uint tile = first_tile + get_global_id(0);
    const uint tile_y = tile / camera->tiles_x, tile_x = tile - tile_y * camera->tiles_x;
    const uint width = camera->tiles_x * TILE, plane = width * camera->tiles_y * TILE;
    grad_pixels_t pixels[TILE][COLUMNS];
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
#if PIXEL_SUMS > SUM_WEIGHT
            p.texture = VLOAD(texture + at);
#endif
#if WEIGHT_ENTROPY
            p.entropy = VLOAD(grad_image + 3 * plane + at);
            p.rest = p.rest - p.entropy * (1.0f - VLOAD(image + 3 * plane + at));
#endif
            pixels[y][column] = p;
        }

    const uint first = tile_offset[tile], end = tile_offset[tile + 1], last = first + tile_last[tile];
    for (uint begin = first; begin < last; begin += SEGMENT) {
        const uint length = last - begin < SEGMENT ? last - begin : SEGMENT;
        float segment[SEGMENT][RECORD];
        uint pairs[SEGMENT];
        for (uint j = 0; j < length; j++) {  // together, so that their waits for memory overlap
            pairs[j] = tile_pairs[begin + j];
            vstore16(vload16(pair_splat[pairs[j]], splats), 0, segment[j]);
        }
        for (uint j = 0; j < length; j++) {
            pixel_sums_t pixel_sums;
            pixel_sums_of(segment[j], tile_x, tile_y, pixels, &pixel_sums);
            store_record(pixel_sums, pair_sums + (size_t)pairs[j] * RECORD);
        }
    }
    for (uint j = last; j < end; j++)
        vstore16((float16)(0.0f), tile_pairs[j], pair_sums);
}
