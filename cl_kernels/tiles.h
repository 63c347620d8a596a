/* The tiles that splats touch: LANES splats at once, or one splat in every lane.
 *
 * The rectangle of tiles around a splat's extent contains `columns` x `rows` tiles; each is tested exactly.  Pairs are
 * derived from two numbers: `tile_box`, the rectangle's corner and width, and `tile_mask`, one bit per touched tile,
 * where the rectangle has no more than 32 tiles; larger ones have width BOX_LARGE and are listed by large.cl. */
#ifndef CLSPLAT_TILES_H
#define CLSPLAT_TILES_H
#include "splat.h"

#define BOX_BITS 12        // of a tile's column and row: images up to 4096 tiles wide
#define BOX_TILES_MAX 32   // bits of a mask
#define BOX_LARGE 33       // width in `tile_box` of a rectangle with more tiles

typedef struct {
    VF x, y;               // mean, px
    VF xx, xy, yy;         // conic, px^-2
    VF along_x, along_y;   // where the ellipse is highest over x, and farthest right over y: -xy/yy, -xy/xx
    VF reach;              // -power where alpha is 1/255, plus EXTENT_SLACK / 2
    VF first_x, first_y;   // corner of the rectangle, tiles
    VF columns, rows;      // its size, tiles; 0 if the splat is not visible
} footprint_t;

#if PIXEL_BOX  // a splat reaches a pixel where it reaches its edge
#define FIRST_PLACE 0.0f
#define PLACES TILE
#else
#define FIRST_PLACE 0.5f
#define PLACES (TILE - 1.0f)
#endif

static inline VF clamp_to(const VF x, const VF low, const VF high) { return smaller(larger(x, low), high); }

/* First and one past the last tile of `begin` to `end` along one axis whose pixel centers reach into [low, high] px. */
static inline VF first_tile(const VF low, const uint begin, const uint end)
{
    return ceil(clamp_to((low - (TILE - 0.5f)) * (1.0f / TILE), (VF)(begin), (VF)(end)));
}

static inline VF end_tile(const VF high, const uint begin, const uint end)
{
    return clamp_to(floor(clamp_to((high - 0.5f) * (1.0f / TILE), (VF)(-1.0f), (VF)(end))) + 1.0f,
                    (VF)(begin), (VF)(end));
}

/* The footprint of splats in a band of rows of tiles, from the fields of their records. */
static inline footprint_t footprint_of(const VF *splat, const VI visible, const uint tiles_x, const uint row_begin,
                                       const uint row_end)
{
    const VF zero = (VF)(0.0f);
    footprint_t f;
    f.x = splat[SPLAT_X];
    f.y = splat[SPLAT_Y];
#if PIXEL_BOX
    const VF k = splat[BOX_SLOPE], longer = splat[BOX_LONG] * splat[BOX_LONG];
    const VF left = splat[BOX_SHORT] * splat[BOX_SHORT], shorter = left + k * k * longer;
    const VI turned = splat[BOX_TURNED] > 0.0f;
    const VF inverse = 1.0f / (longer * left + BOX_FOOTPRINT * (longer + shorter + BOX_FOOTPRINT));
    f.xx = ((turned ? shorter : longer) + BOX_FOOTPRINT) * inverse;
    f.xy = -k * longer * inverse;
    f.yy = ((turned ? longer : shorter) + BOX_FOOTPRINT) * inverse;
#else
    f.xx = splat[SPLAT_XX];
    f.xy = splat[SPLAT_XY];
    f.yy = splat[SPLAT_YY];
#endif
    f.along_x = -f.xy / f.yy;
    f.along_y = -f.xy / f.xx;
#if PIXEL_BOX
    f.reach = 0.5f * EXTENT_SLACK + log_positive(larger(splat[SPLAT_OPACITY], (VF)(ALPHA_MIN)) / ALPHA_MIN);
#else
    f.reach = 0.5f * EXTENT_SLACK - splat[SPLAT_POWER_MIN];
#endif
    f.first_x = first_tile(splat[SPLAT_X_MIN], 0, tiles_x);
    f.first_y = first_tile(splat[SPLAT_Y_MIN], row_begin, row_end);
    f.columns = visible ? larger(end_tile(splat[SPLAT_X_MAX], 0, tiles_x) - f.first_x, zero) : zero;
    f.rows = visible ? larger(end_tile(splat[SPLAT_Y_MAX], row_begin, row_end) - f.first_y, zero) : zero;
    return f;
}

/* Whether the ellipse reaches a pixel center of the tile in `column` and `row` of the rectangle: the smallest -power
 * over the centers' rectangle is at the mean or on the edges next to it, where it is a parabola (the test of
 * StopThePop, Radl et al. 2024). */
static inline VI touches_tile(const footprint_t *f, const VF column, const VF row)
{
    const VF x0 = (f->first_x + column) * TILE + FIRST_PLACE - f->x, x1 = x0 + PLACES;
    const VF y0 = (f->first_y + row) * TILE + FIRST_PLACE - f->y, y1 = y0 + PLACES;
    const VF x = clamp_to((VF)(0.0f), x0, x1), y = clamp_to((VF)(0.0f), y0, y1);
    const VF best_y = clamp_to(f->along_x * x, y0, y1);
    const VF best_x = clamp_to(f->along_y * y, x0, x1);
    const VF on_vertical = 0.5f * (f->xx * x * x + f->yy * best_y * best_y) + f->xy * x * best_y;
    const VF on_horizontal = 0.5f * (f->xx * best_x * best_x + f->yy * y * y) + f->xy * best_x * y;
    return (smaller(on_vertical, on_horizontal) <= f->reach) & (column < f->columns) & (row < f->rows);
}

static inline VI is_large(const footprint_t *f) { return f->columns * f->rows > (float)BOX_TILES_MAX; }

/* The number of tiles that each splat touches, and their mask; both are 0 if the rectangle has more tiles than a mask
 * has bits. */
static inline VI count_tiles(const footprint_t *f, VI *mask)
{
    const VI columns = to_VI(f->columns), zero = (VI)(0);
    const VF rows = is_large(f) ? (VF)(0.0f) : f->rows;
    VI count = zero;
    *mask = zero;
    for (int row = 0; ANY((float)row < rows); row++)
        for (int column = 0; ANY((column < columns) & ((float)row < rows)); column++) {
            const VI touched = touches_tile(f, (VF)((float)column), (VF)((float)row)) & ((float)row < rows);
            count += touched ? (VI)(1) : zero;
            *mask |= touched ? (VI)(1) << ((row * columns + column) & 31) : zero;
        }
    return count;
}

/* Corner and width of the rectangles. */
static inline VI box_of(const footprint_t *f)
{
    const VI width = is_large(f) ? (VI)(BOX_LARGE) : to_VI(f->columns);
    return to_VI(f->first_x) | to_VI(f->first_y) << BOX_BITS | width << (2 * BOX_BITS);
}

#endif
