/* The mean of a splat over the box of a pixel, instead of its value at the center, where PIXEL_BOX is 1.
 *
 * With V the covariance of the splat on the screen without any blur, y the pixel axis of its larger variance (x where
 * the splat is `turned`), s^2 = V_yy, k = V_xy / V_yy and t^2 = V_xx - k^2 V_yy, d = mean - pixel center:
 *
 *   Z(dy) = F((dy + 1/2) / s) - F((dy - 1/2) / s)        the marginal of y, over the pixel's height
 *   m, v  = mean and variance of y within the pixel      a truncated normal distribution
 *   r = 12 k^2 v,  w = (1 + r^2)^(1/4),  e^2 = t^2 + (1 + r - w^2) / 12
 *   alpha = opacity 2 pi s t Z / w (F((dx - k m + w/2) / e) - F((dx - k m - w/2) / e))
 *
 * The last line is the integral over x given y; w and e combine the pixel's width with the variation of y within the
 * pixel, as one box and one Gaussian with the same second and fourth moments.  F, the cumulative normal
 * distribution, is 1 / (1 + e^-P) with an odd polynomial P.  Z, m, w and e belong to a line of pixels (a row, or a
 * column of a turned splat). */
#ifndef CLSPLAT_PIXEL_BOX_H
#define CLSPLAT_PIXEL_BOX_H
#include "lanes.h"

/* fields of a splat record that replace the conic and SPLAT_POWER_MIN */
#define BOX_SLOPE 2    // k
#define BOX_LONG 3     // s, px
#define BOX_SHORT 4    // t, px
#define BOX_TURNED 13  // 1 where x is the axis of the larger variance, else 0

#define BOX_FOOTPRINT 0.1f  // px^2, added to V for a splat's extent and tiles, with 1/2 px on every side

#define CDF_SLOPE 1.5957691f  // slope of P at 0: sqrt(8 / pi)
#define CDF_CUBIC 7.333173e-2f
#define CDF_QUINTIC (-5.9424e-4f)
#define CDF_REACH 6.0f     // standard deviations
#define BOX_UNIFORM 0.4f   // 1 / (2 s) below which m and v use series, since differences cancel there
#define TWO_PI 6.28318531f

/* F(z + h) - F(z - h) and the derivatives of its logarithm. */
typedef struct {
    VF value, by_z, by_h;
    VF by_size;    // z by_z + h by_h
    VF z, h;       // |z| and h after clipping the ends to CDF_REACH
    VF high, low;  // tanh(P/2) at z + h and z - h
} rise_t;

/* With a, d = (P(z + h) +- P(z - h)) / 2 it is sinh d / (cosh d + cosh a): nothing cancels where h is small. */
static inline rise_t rise_of(const VF position, const VF h)
{
    const VF one = (VF)(1.0f), reach = (VF)(CDF_REACH), size = as_VF(as_VI(position) & 0x7fffffff);
    const VF end = smaller(size + h, reach), begin = smaller(larger(size - h, -reach), reach);
    const VI clipped = size + h > reach;
    rise_t f;
    f.z = clipped ? 0.5f * (end + begin) : size;
    f.h = clipped ? 0.5f * (end - begin) : h;
    const VF z2 = f.z * f.z, h2 = f.h * f.h;
    const VF a = f.z * (CDF_SLOPE + CDF_CUBIC * (z2 + 3.0f * h2) +
                        CDF_QUINTIC * ((z2 + 10.0f * h2) * z2 + 5.0f * h2 * h2));
    const VF d = f.h * (CDF_SLOPE + CDF_CUBIC * (3.0f * z2 + h2) +
                        CDF_QUINTIC * ((5.0f * z2 + 10.0f * h2) * z2 + h2 * h2));
    const VF ea = exp_power(-a), ed = exp_power(-d), ea2 = ea * ea, ed2 = ed * ed, t = 2.0f * d;
    const VF series = t * (1.0f - t * (1.0f / 2.0f) * (1.0f - t * (1.0f / 3.0f) * (1.0f - t * (1.0f / 4.0f) *
                      (1.0f - t * (1.0f / 5.0f) * (1.0f - t * (1.0f / 6.0f))))));
    const VF gap = larger(t < 0.35f ? series : one - ed2, (VF)(1.0e-10f));  // 1 - ed2; the bound changes no pixel
    const VF below = ea * (1.0f + ed2) + ed * (1.0f + ea2);
    const VF inverse = 1.0f / (gap * below), inverse_below = gap * inverse;
    f.value = ea * gap * inverse_below;

    const VF by_a = -ed * (1.0f - ea2) * inverse_below;
    const VF by_d = (4.0f * ea * ed + (1.0f + ea2) * (1.0f + ed2)) * ed * inverse;
    const VF even = CDF_SLOPE + 3.0f * CDF_CUBIC * (z2 + h2) + 5.0f * CDF_QUINTIC * ((z2 + 6.0f * h2) * z2 + h2 * h2);
    const VF odd = 2.0f * f.z * f.h * (3.0f * CDF_CUBIC + 10.0f * CDF_QUINTIC * (z2 + h2));
    const VF by_z = by_a * even + by_d * odd;
    f.by_z = position < 0.0f ? -by_z : by_z;
    f.by_h = by_a * odd + by_d * even;
    f.by_size = f.z * by_z + f.h * f.by_h;
    f.high = (1.0f - ea * ed) / (1.0f + ea * ed);
    f.low = (ed - ea) / (ed + ea);
    return f;
}

/* A splat on lines of pixels: alpha = scale (F(z + spread) - F(z - spread)), z = (shift - pixel center) inverse. */
typedef struct {
    VF scale, shift;    // shift: px, across the lines
    VF inverse, spread; // 1 / e, px^-1; w / (2 e)
} line_t;

/* Derivatives of ln alpha on these lines: with respect to a parameter, base + by_z shift_by + R r_by with the pixel's
 * R = fixed + by_h wide + by_size narrow. */
typedef struct {
    VF base_long, shift_long, r_long;  // with respect to the mean along the larger variance, px^-1
    VF base_size, shift_size, r_size;  // with respect to ln s
    VF shift_slope, r_slope;           // with respect to k
    VF fixed, wide, narrow;            // d ln alpha / dr: the constant part, and the parts through w and through e
    VF share;                          // t^2 / e^2
} slopes_t;

/* m and v within the pixel, and their derivatives with respect to y and ln s. */
typedef struct {
    VF mean, mean_y, mean_s;              // px, 1, px
    VF variance, variance_y, variance_s;  // px^2, px, px^2
} within_t;

static inline within_t wide_within(const VF dy, const float s)
{
    within_t w;
    const float inverse2 = 1.0f / (s * s), c = 1.0f / 12.0f - inverse2 * (1.0f / 360.0f);
    const VF tilt = dy * inverse2, tilt2 = tilt * tilt, variance = c - tilt2 * (1.0f / 240.0f);
    const VI positive = variance > 0.0f;
    const VF zero = (VF)(0.0f);
    w.mean = dy - tilt * (c - tilt2 * (1.0f / 720.0f));
    w.mean_y = 1.0f - inverse2 * (c - tilt2 * (1.0f / 240.0f));
    w.mean_s = tilt * (2.0f * c - inverse2 * (1.0f / 180.0f) - tilt2 * (1.0f / 120.0f));
    w.variance = positive ? variance : zero;
    w.variance_y = positive ? -tilt * inverse2 * (1.0f / 120.0f) : zero;
    w.variance_s = positive ? inverse2 * (1.0f / 180.0f) + tilt2 * (1.0f / 60.0f) : zero;
    return w;
}

/* -d ln f(x) / dx of the density f that belongs to F, with tanh(P/2) there: x where F is exact. */
static inline VF steepness(const VF x, const VF tanh)
{
    const VF x2 = x * x, slope = CDF_SLOPE + x2 * (3.0f * CDF_CUBIC + x2 * (5.0f * CDF_QUINTIC));
    return tanh * slope - x * (6.0f * CDF_CUBIC + 20.0f * CDF_QUINTIC * x2) / slope;
}

/* By the logarithm f of Z: m = -s df/dz, v = s^2 (1 - z df/dz - h df/dh - (df/dz)^2). */
static inline within_t sharp_within(const VF dy, const float s, const rise_t f)
{
    const VF zero = (VF)(0.0f), max_variance = (VF)(1.0f / 12.0f), size = dy < 0.0f ? -dy : dy;
    const VF z = f.z, h = f.h, by_z = dy < 0.0f ? -f.by_z : f.by_z;
    const VF mean = -s * by_z, bounded = smaller(larger(mean, size - 0.5f), size + 0.5f);
    const VF part = 1.0f - f.by_size - by_z * by_z, variance = s * s * part;
    const VF high = 0.5f * (f.by_h + by_z), low = 0.5f * (f.by_h - by_z);  // densities at the ends, divided by Z
    const VF upper = steepness(z + h, f.high) * high, lower = steepness(z - h, f.low) * low;
    const VF zz = lower - upper - by_z * by_z;
    const VF zh = -lower - upper - by_z * f.by_h;
    const VF hh = lower - upper - f.by_h * f.by_h;
    const VF part_z = -by_z - z * zz - h * zh - 2.0f * by_z * zz;
    const VF part_h = -f.by_h - z * zh - h * hh - 2.0f * by_z * zh;
    const VI unclamped = (variance > 0.0f) & (variance < max_variance);
    const VF mean_s = mean == bounded ? s * (z * zz + h * zh - by_z) : zero;
    const VF variance_y = unclamped ? s * part_z : zero;
    within_t w;
    w.mean = dy < 0.0f ? -bounded : bounded;
    w.mean_y = mean == bounded ? -zz : (VF)(1.0f);
    w.mean_s = dy < 0.0f ? -mean_s : mean_s;
    w.variance = smaller(larger(variance, zero), max_variance);
    w.variance_y = dy < 0.0f ? -variance_y : variance_y;
    w.variance_s = unclamped ? s * s * (2.0f * part - z * part_z - h * part_h) : zero;
    return w;
}

/* The lines at `center`, px along the larger variance, and the derivatives there. */
static inline void line_of(const float *splat, const VF center, line_t *line, slopes_t *slopes)
{
    const bool turned = splat[BOX_TURNED] > 0.0f;
    const float k = splat[BOX_SLOPE], s = splat[BOX_LONG], t = splat[BOX_SHORT], inverse_s = 1.0f / s;
    const VF dy = splat[turned ? SPLAT_X : SPLAT_Y] - center;
    const rise_t f = rise_of(dy * inverse_s, (VF)(0.5f * inverse_s));
    within_t y;
    if (0.5f * inverse_s < BOX_UNIFORM)
        y = wide_within(dy, s);
    else
        y = sharp_within(dy, s, f);
    const float k2 = 12.0f * k * k, t2 = t * t;  // t2 apart: compilers may contract a sum of two products either way
    const VF r = k2 * y.variance, w2 = sqrt(1.0f + r * r), w = sqrt(w2);
    const VF e = sqrt(t2 + (1.0f + r - w2) * (1.0f / 12.0f)), inverse = 1.0f / e;
    line->scale = splat[SPLAT_OPACITY] * (TWO_PI * s * t) * f.value / w;
    line->shift = splat[turned ? SPLAT_Y : SPLAT_X] - k * y.mean;
    line->inverse = inverse;
    line->spread = 0.5f * w * inverse;

    const VF by_w = 0.5f * r / (w * w2);  // dw/dr
    slopes->base_long = f.by_z * inverse_s;
    slopes->base_size = 1.0f - f.by_size;
    slopes->shift_long = -k * y.mean_y * inverse;
    slopes->shift_size = -k * y.mean_s * inverse;
    slopes->shift_slope = -y.mean * inverse;
    slopes->r_long = k2 * y.variance_y;
    slopes->r_size = k2 * y.variance_s;
    slopes->r_slope = 24.0f * k * y.variance;
    slopes->fixed = -by_w / w;
    slopes->wide = 0.5f * by_w * inverse;
    slopes->narrow = -(1.0f - r / w2) * (1.0f / 24.0f) * inverse * inverse;
    slopes->share = t2 * inverse * inverse;
}

/* d ln alpha at a pixel. */
typedef struct {
    VF across, along;           // with respect to the mean across and along the larger variance, px^-1
    VF slope, longer, shorter;  // with respect to k, ln s, ln t
} log_slopes_t;

static inline log_slopes_t log_slopes_of(const slopes_t s, const line_t line, const rise_t f)
{
    const VF by_r = s.fixed + f.by_h * s.wide + f.by_size * s.narrow;
    log_slopes_t l;
    l.across = f.by_z * line.inverse;
    l.along = s.base_long + f.by_z * s.shift_long + by_r * s.r_long;
    l.slope = f.by_z * s.shift_slope + by_r * s.r_slope;
    l.longer = s.base_size + f.by_z * s.shift_size + by_r * s.r_size;
    l.shorter = 1.0f - f.by_size * s.share;
    return l;
}

#endif
