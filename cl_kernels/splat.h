/* One splat at LANES pixels: alpha, blending and its gradient.  Both schedules use these functions, so their images are
 * equal bit for bit.
 *
 *   power = -1/2 (xx dx^2 + yy dy^2) - xy dx dy,  alpha = min(0.99, opacity e^power),  d = mean - pixel center
 *
 * A splat contributes to a pixel when the pixel's row is in its extent, power_min <= power <= 0 (power_min is where
 * alpha falls to 1/255) and blending it leaves transmittance >= 1e-4; the first splat that would leave less finishes
 * the pixel and is not blended (Kerbl et al. 2023).  A finished pixel stores its transmittance with a negative sign.
 *
 * With PIXEL_BOX alpha is the mean of that Gaussian over the pixel instead (pixel_box.h), and must be >= 1/255.
 *
 * With INVERSE_DEPTH the image and its gradient have a fourth plane, D = sum_i w_i / z_i with w = alpha T and the
 * depths of the means; it is 0 behind the splats.
 *
 * With MEDIAN_DEPTH the third plane is not blended: it is the red of the splat that takes the transmittance from at
 * least 1/2 to below 1/2, and 0 where no splat does.  depth.cl makes red the depth of the mean. */
#ifndef CLSPLAT_SPLAT_H
#define CLSPLAT_SPLAT_H
#include "lanes.h"

/* fields of a splat record, [RECORD] floats; all zero when the Gaussian is culled */
#define SPLAT_X 0          // mean, px
#define SPLAT_Y 1
#define SPLAT_XX 2         // conic, px^-2
#define SPLAT_XY 3
#define SPLAT_YY 4
#define SPLAT_OPACITY 5    // after both filters
#define SPLAT_RED 6        // then green, blue
#define SPLAT_Y_MIN 9      // extent of alpha >= 1/255, px
#define SPLAT_Y_MAX 10
#define SPLAT_X_MIN 11
#define SPLAT_X_MAX 12
#define SPLAT_POWER_MIN 13 // ln(ALPHA_MIN / opacity)
#define SPLAT_INVERSE_DEPTH 14  // 1/z of the mean, scene units^-1

/* fields of a gradient record, [RECORD] floats: sums over pixels, with p = dL/dpower and w = alpha T */
#define SUM_POWER 0    // p; divided by the opacity it is dL/dopacity
#define SUM_X 1        // p dx
#define SUM_Y 2        // p dy
#define SUM_XX 3       // p dx dx
#define SUM_XY 4       // p dx dy
#define SUM_YY 5       // p dy dy
#define SUM_RED 6      // w dL/dcolor; then green, blue
#define SUM_ABS_X 9    // |dL/dx| of the mean, px^-1; this and the next sums exist where PIXEL_SUMS is larger
#define SUM_ABS_Y 10
#define SUM_WEIGHT 11  // w, of pixels with a known texture, >= 0
#define SUM_TEXTURE 12 // w times the texture, of the same pixels
#define SUM_BLENDED 13 // the texture, summed over these pixels where they blend the splat; their number if it is 1
#define SUM_SQUARE 14  // (dL/dG)^2 with G = e^power, so that alpha = opacity G
#define SUM_INVERSE_DEPTH 15  // w dL/dD; only with INVERSE_DEPTH, summed separately (inverse_depth.cl)

/* With PIXEL_BOX p = dL/dln(alpha), and SUM_X to SUM_YY are p times the derivatives of ln(alpha) with respect to x and
 * y of the mean and to k, ln s and ln t of pixel_box.h. */

/* A gradient record is written and read in aligned parts: with one lane, the quads that contain sums; otherwise the
 * whole record. */
#if LANES == 1
typedef float4 sums_part_t;
#define SUMS_PARTS (INVERSE_DEPTH ? RECORD / 4 : (PIXEL_SUMS + 3) / 4)
#else
typedef float16 sums_part_t;
#define SUMS_PARTS 1
#endif

/* Partial sums, one set per lane. */
typedef struct {
    VF power, x, y, xx, xy, yy, red, green, blue, abs_x, abs_y, weight, texture, blended, square;
#if INVERSE_DEPTH
    VF inverse_depth;
#endif
} pixel_sums_t;

#if PIXEL_BOX
#include "pixel_box.h"

/* A splat at LANES pixels of a row. */
typedef struct {
    line_t line;
    slopes_t slopes;  // known in the backward pass
    VF place;         // position of the pixels across the lines, px
    bool turned;
    float opacity;
    float alpha_min;  // above 1, so that no pixel is hit, when the row is outside the splat's extent
} row_splat_t;

/* The splat at a row; line and slopes are added by the schedules. */
static inline row_splat_t splat_at_pixels(const float *splat, const bool turned, const float row, const VF pixel)
{
    const bool inside = (row >= splat[SPLAT_Y_MIN]) & (row <= splat[SPLAT_Y_MAX]);
    row_splat_t s;
    s.turned = turned;
    s.place = turned ? (VF)(row) : pixel;
    s.opacity = splat[SPLAT_OPACITY];
    s.alpha_min = inside ? ALPHA_MIN : 2.0f;
    return s;
}
#else
/* A splat at one row of pixels. */
typedef struct {
    float x;           // mean, px
    float dy;          // px
    float a, b, c;     // power = (a dx - b) dx - c
    float xy, slope;   // dpower/dy of the mean = -(xy dx + slope)
    float opacity;
    float power_min;   // above 0, so that no pixel is hit, when the row is outside the splat's extent
} row_splat_t;

static inline row_splat_t splat_at_row(const float *splat, const float row)
{
    const float dy = splat[SPLAT_Y] - row;
    const bool inside = (row >= splat[SPLAT_Y_MIN]) & (row <= splat[SPLAT_Y_MAX]);
    const row_splat_t s = {
        splat[SPLAT_X], dy,
        -0.5f * splat[SPLAT_XX], splat[SPLAT_XY] * dy, 0.5f * splat[SPLAT_YY] * dy * dy,
        splat[SPLAT_XY], splat[SPLAT_YY] * dy,
        splat[SPLAT_OPACITY],
        inside ? splat[SPLAT_POWER_MIN] : 1.0f};
    return s;
}
#endif

/* Contribution of a splat to LANES pixels whose transmittance before it is t. */
typedef struct {
    VI hit;       // the splat reaches the pixel ...
    VI blended;   // ... and does not finish the pixel
#if PIXEL_BOX
    rise_t rise;  // across the lines
#else
    VF dx;        // px
#endif
    VF uncapped;  // alpha before the cap
    VF remain;    // 1 - alpha
    VF weight;    // alpha t where blended, else 0
    VF next;      // transmittance after it; negative once finished
} contribution_t;

static inline contribution_t contribution_of(const row_splat_t s, const VF pixel, const VF t)
{
    contribution_t k;
#if PIXEL_BOX
    k.rise = rise_of((s.line.shift - s.place) * s.line.inverse, s.line.spread);
    k.uncapped = s.line.scale * k.rise.value;
    const VF alpha = smaller(k.uncapped, (VF)(ALPHA_MAX));
    k.hit = (k.uncapped >= s.alpha_min) & (k.uncapped > 0.0f);
#else
    k.dx = s.x - pixel;
    const VF power = (k.dx * s.a - s.b) * k.dx - s.c;
    /* the bound changes no pixel that is hit; without it, distant pixels produce subnormal numbers, which are slow */
    k.uncapped = s.opacity * exp_power(larger(power, (VF)(POWER_MIN)));
    const VF alpha = smaller(k.uncapped, (VF)(ALPHA_MAX));
    k.hit = (power >= s.power_min) & (power <= 0.0f);
#endif
    k.remain = 1.0f - alpha;
    const VF left = t * k.remain;
    const VI passes = left >= TRANSMITTANCE_MIN;
    k.blended = k.hit & passes;
    k.weight = k.blended ? alpha * t : (VF)(0.0f);
    const VF finished = as_VF(as_VI(t) | (VI)(0x80000000));
    k.next = k.blended ? left : (k.hit ? finished : t);
    return k;
}

/* State of LANES pixels going front to back: transmittance and color. */
typedef struct {
    VF t, red, green, blue;
#if INVERSE_DEPTH
    VF inverse_depth;
#endif
} pixels_t;

static inline void blend(pixels_t *p, const row_splat_t s, const VF pixel, const float *color)
{
    const contribution_t k = contribution_of(s, pixel, p->t);
    p->red += k.weight * color[0];
    p->green += k.weight * color[1];
#if MEDIAN_DEPTH
    const VI crosses = k.blended & (p->t >= 0.5f) & (k.next < 0.5f);
    p->blue = crosses ? (VF)(color[0]) : p->blue;
#else
    p->blue += k.weight * color[2];
#endif
#if INVERSE_DEPTH
    p->inverse_depth += k.weight * color[SPLAT_INVERSE_DEPTH - SPLAT_RED];
#endif
    p->t = k.next;
}

/* State of LANES pixels for gradients: g = dL/dcolor of the pixel; rest = g . (color that is blended after this
 * splat, background included), which starts as g . final color.  Then dL/dalpha = t (c . g) - rest_after / (1 -
 * alpha): front to back, without dividing the transmittance.
 *
 * A loss of the final transmittance T adds -T / (1 - alpha) dL/dT, the same for all splats: rest starts larger by
 * T dL/dT, the plane `behind`. */
typedef struct {
    VF t, rest, red, green, blue;
#if PIXEL_SUMS > SUM_WEIGHT
    VF texture;
#endif
#if INVERSE_DEPTH
    VF inverse_depth;  // dL/dD
#endif
} grad_pixels_t;

static inline void blend_backward_step(grad_pixels_t *p, const row_splat_t s, const VF pixel, const float *color,
                                       pixel_sums_t *m)
{
    const VF zero = (VF)(0.0f);
    const contribution_t k = contribution_of(s, pixel, p->t);
    VF shade = color[0] * p->red + color[1] * p->green + color[2] * p->blue;
#if INVERSE_DEPTH
    shade = shade + color[SPLAT_INVERSE_DEPTH - SPLAT_RED] * p->inverse_depth;
#endif
    p->rest = p->rest - k.weight * shade;
    const VF grad_alpha = p->t * shade - p->rest / k.remain;
    const VI passes = k.blended & (k.uncapped <= ALPHA_MAX);  // the cap passes no gradient
    const VF power = passes ? k.uncapped * grad_alpha : zero;
#if PIXEL_BOX
    const log_slopes_t l = log_slopes_of(s.slopes, s.line, k.rise);
    const VF power_x = power * (s.turned ? l.along : l.across), power_y = power * (s.turned ? l.across : l.along);
    p->t = k.next;
    m->power += power;
    m->x += power_x;
    m->y += power_y;
    m->xx += power * l.slope;
    m->xy += power * l.longer;
    m->yy += power * l.shorter;
#else
    const VF power_x = power * k.dx;
    p->t = k.next;
    m->power += power;
    m->x += power_x;
    m->y += power * s.dy;
    m->xx += power_x * k.dx;
    m->xy += power_x * s.dy;
    m->yy += power * (s.dy * s.dy);
#endif
    m->red += k.weight * p->red;
    m->green += k.weight * p->green;
    m->blue += k.weight * p->blue;
#if INVERSE_DEPTH
    m->inverse_depth += k.weight * p->inverse_depth;
#endif
#if PIXEL_SUMS > SUM_ABS_X && PIXEL_BOX
    m->abs_x += magnitude(power_x);
    m->abs_y += magnitude(power_y);
#elif PIXEL_SUMS > SUM_ABS_X
    m->abs_x += magnitude(power * (s.b - 2.0f * s.a * k.dx));
    m->abs_y += magnitude(power * (s.xy * k.dx + s.slope));
#endif
#if PIXEL_SUMS > SUM_WEIGHT
    const VF known = p->texture >= zero ? k.weight : zero;
    m->weight += known;
    m->texture += known * p->texture;
#endif
#if PIXEL_SUMS > SUM_BLENDED
    m->blended += k.blended ? larger(p->texture, zero) : zero;
    const VF grad_falloff = passes ? s.opacity * grad_alpha : zero;
    m->square += grad_falloff * grad_falloff;
#endif
}

#endif
