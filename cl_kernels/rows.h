/* A splat at the rows of a tile, for CPUs: the values that a row of pixels needs are precomputed for all rows of
 * a tile, LANES at once, so that loops over pixels only read them, without a branch.
 * The formulas are those of splat.h; the results are bit-identical to those of splat_at_row. */
#ifndef CLSPLAT_ROWS_H
#define CLSPLAT_ROWS_H
#include "splat.h"

#define COLUMNS (TILE / LANES)  // vectors per tile row
#define SEGMENT 64              // splats of a tile loaded together: one wait for memory, then rows read from the cache

static inline VF pixel_centers(const uint tile_x, const uint column)
{
    return to_VF(LANE_INDEX + (int)(tile_x * TILE + column * LANES)) + 0.5f;
}

#if PIXEL_BOX
#define LINE_FIELDS (sizeof(line_t) / sizeof(VF))
#define SLOPE_FIELDS (sizeof(slopes_t) / sizeof(VF))
#define SPLAT_AT(splat, lines, y, column) \
    splat_on_lines(splat, lines, splat[BOX_TURNED] > 0.0f, tile_y * TILE + (y) + 0.5f, y, column, centers[column])

/* The lines of a splat through a tile, rows or columns, each field of all lines together. */
static inline void lines_of(const float *splat, const uint tile_x, const uint tile_y, float (*lines)[TILE],
                            float (*slopes)[TILE])
{
    for (uint column = 0; column < COLUMNS; column++) {
        line_t line;
        slopes_t slope;
        line_of(splat, pixel_centers(splat[BOX_TURNED] > 0.0f ? tile_x : tile_y, column), &line, &slope);
        for (uint k = 0; k < LINE_FIELDS; k++)
            VSTORE_PRIVATE(((const VF *)&line)[k], lines[k] + column * LANES);
        for (uint k = 0; slopes && k < SLOPE_FIELDS; k++)
            VSTORE_PRIVATE(((const VF *)&slope)[k], slopes[k] + column * LANES);
    }
}

/* A field at LANES pixels of row y of a tile: of their columns, or only of the row. */
static inline VF field_at(const float *field, const bool turned, const uint y, const uint column)
{
    return turned ? VLOAD_PRIVATE(field + column * LANES) : (VF)(field[y]);
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
#define LINE_FIELDS 3   // fields of row_splat_t: b, c, power_min
#define SLOPE_FIELDS 2  // dy, slope
#define SPLAT_AT(splat, lines, y, column) splat_on_lines(splat, lines, 0, y)

/* The values of splat_at_row for all rows of a tile; `slopes` is only used in the backward pass. */
static inline void lines_of(const float *splat, const uint tile_x, const uint tile_y, float (*lines)[TILE],
                            float (*slopes)[TILE])
{
    for (uint y = 0; y < TILE; y += LANES) {
        const VF row = pixel_centers(tile_y, y / LANES), dy = splat[SPLAT_Y] - row;
        const VI inside = (row >= splat[SPLAT_Y_MIN]) & (row <= splat[SPLAT_Y_MAX]);
        VSTORE_PRIVATE(splat[SPLAT_XY] * dy, lines[0] + y);
        VSTORE_PRIVATE(0.5f * splat[SPLAT_YY] * dy * dy, lines[1] + y);
        VSTORE_PRIVATE((inside ? (VF)(splat[SPLAT_POWER_MIN]) : (VF)(1.0f)), lines[2] + y);
        if (slopes) {
            VSTORE_PRIVATE(dy, slopes[0] + y);
            VSTORE_PRIVATE(splat[SPLAT_YY] * dy, slopes[1] + y);
        }
    }
}

static inline row_splat_t splat_on_lines(const float *splat, const float (*lines)[TILE], const float (*slopes)[TILE],
                                         const uint y)
{
    const row_splat_t s = {
        splat[SPLAT_X], slopes ? slopes[0][y] : 0.0f, -0.5f * splat[SPLAT_XX], lines[0][y], lines[1][y],
        splat[SPLAT_XY], slopes ? slopes[1][y] : 0.0f, splat[SPLAT_OPACITY], lines[2][y]};
    return s;
}
#endif

/* List, for each pair of rows of a tile, the splats of a segment that may reach them. */
static inline void list_splats(const float16 *segment, const uint length, const uint tile_y,
                               uchar (*lists)[SEGMENT], uint *listed)
{
    const float top = tile_y * TILE + 0.5f;
    for (uint y = 0; y < TILE; y += 2)
        listed[y / 2] = 0;
    for (uint j = 0; j < length; j++) {  // branch-free compaction
        const float *splat = (const float *)(segment + j);
        for (uint y = 0; y < TILE; y += 2) {
            lists[y / 2][listed[y / 2]] = j;
            listed[y / 2] += (splat[SPLAT_Y_MIN] <= top + y + 1.0f) & (splat[SPLAT_Y_MAX] >= top + y);
        }
    }
}

#endif
