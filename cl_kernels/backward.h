/* Gradients of a Gaussian's parameters from its sums over pixels: the reverse of projection and color.
 * The values of the forward pass are recomputed.  Both kernels that update parameters use this file, so their
 * results are bit-identical. */
#ifndef CLSPLAT_BACKWARD_H
#define CLSPLAT_BACKWARD_H
#include "gaussian.h"
#include "harmonics.h"
#include "slots.h"
#include "splat.h"

/* Unit direction from the camera to LANES Gaussians; returns 1 / distance. */
static inline VF view_direction(
    __global const float *means, __constant camera_t *camera, const uint stride, const uint i, VF *d)
{
    VF norm2 = (VF)(0.0f);
    for (uint k = 0; k < 3; k++) {
        d[k] = VLOAD(means + k * stride + i) - camera->position[k];
        norm2 = norm2 + d[k] * d[k];
    }
    const VF inverse = 1.0f / sqrt(norm2 + 1.0e-30f);
    for (uint k = 0; k < 3; k++)
        d[k] = d[k] * inverse;
    return inverse;
}

/* Gradients of the mean, quaternion and log-scales from the sums over pixels of a Gaussian, and of a factor on both
 * focal lengths.  A clamped ray is a limit / focal length (RAY_MARGIN), so its element of J does not change. */
static inline void shape_backward(
    const shape_t *s, __constant camera_t *camera,
    const VF *m,  // [PIXEL_SUMS] see splat.h
    const float screen_variance, const float compensate,
    VF *grad_mean2d, VF *grad_mean, VF *grad_quat, VF *grad_scale, VF *grad_focal)
{
    __constant const float *w = camera->world_to_camera;
#if PIXEL_BOX
    /* k = xy / longer, s^2 = longer, t^2 = determinant / longer -> covariance */
    const VF gu = m[SUM_X], gv = m[SUM_Y];
    const VI turned = s->xx > s->yy;
    const VF longer = turned ? s->xx : s->yy, inverse_longer = 1.0f / longer, slope = s->xy * inverse_longer;
    const VF g_short = 0.5f * m[SUM_YY] * longer / s->determinant;
    const VF g_long = (0.5f * m[SUM_XY] - slope * m[SUM_XX]) * inverse_longer + g_short * slope * slope;
    const VF g00 = turned ? g_long : g_short, g11 = turned ? g_short : g_long;
    const VF g01 = 0.5f * m[SUM_XX] * inverse_longer - g_short * slope;
#else
    const VF a = s->conic_xx, b = s->conic_xy, c = s->conic_yy;
    const VF gu = -(a * m[SUM_X] + b * m[SUM_Y]);
    const VF gv = -(b * m[SUM_X] + c * m[SUM_Y]);

    /* conic = (yy + s, -xy, xx + s) / det with det = det0 + s (xx + yy + s) and det0 = |V0 x V1|^2.  Its numerators and
     * the determinants are differentiated, since terms of -K G K cancel for long splats.  g_det0 is doubled. */
    const VF ga = -0.5f * m[SUM_XX], gb = -m[SUM_XY], gc = -0.5f * m[SUM_YY];
    const VF energy2 = larger(1.0f + compensate * (s->ratio - 1.0f), (VF)(1.0e-12f));
    const VF g_ratio = compensate * 0.5f * m[SUM_POWER] / energy2, inverse = 1.0f / s->determinant;
    const VF g_det = -(a * ga + b * gb + c * gc + g_ratio * s->ratio) * inverse;
    const VF g_det0 = 2.0f * (g_det + g_ratio * inverse);
    const VF g00 = gc * inverse + screen_variance * g_det, g11 = ga * inverse + screen_variance * g_det;
    const VF g01 = -0.5f * gb * inverse;
    VF normal[3], by_normal[6];
    cross_product(s->v, s->v + 3, normal);
    cross_product(s->v + 3, normal, by_normal);
    cross_product(normal, s->v, by_normal + 3);
#endif

    /* covariance -> V = T M -> T, rotation, scales */
    VF gt[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f}, gr[9];
    for (uint k = 0; k < 3; k++) {
        VF v0 = 2.0f * (g00 * s->v[k] + g01 * s->v[3 + k]), v1 = 2.0f * (g01 * s->v[k] + g11 * s->v[3 + k]);
#if !PIXEL_BOX
        v0 += g_det0 * by_normal[k];
        v1 += g_det0 * by_normal[3 + k];
#endif
        VF g_filtered = (VF)(0.0f);
        for (uint j = 0; j < 3; j++) {
            const VF axis = s->rotation[3 * j + k] * s->filtered[k];
            gt[j] += v0 * axis;
            gt[3 + j] += v1 * axis;
            const VF gm = s->t[j] * v0 + s->t[3 + j] * v1;
            g_filtered += gm * s->rotation[3 * j + k];
            gr[3 * j + k] = gm * s->filtered[k];
        }
        const VF inverse_scale = 1.0f / s->filtered[k];
        grad_scale[k] = (g_filtered * s->scale2[k] + m[SUM_POWER] * s->filter * inverse_scale) * inverse_scale;
    }
    rotation_backward(s->unit, s->inverse_norm, gr, grad_quat);

    /* T = J W and the projected mean -> camera-space mean -> world */
    VF j00 = (VF)(0.0f), j02 = (VF)(0.0f), j11 = (VF)(0.0f), j12 = (VF)(0.0f);
    for (uint k = 0; k < 3; k++) {
        j00 += gt[k] * w[k];
        j02 += gt[k] * w[8 + k];
        j11 += gt[3 + k] * w[4 + k];
        j12 += gt[3 + k] * w[8 + k];
    }
    const VF zero = (VF)(0.0f), jx = camera->fx * s->inverse_z, jy = camera->fy * s->inverse_z;
    const VF ray_x = s->free_x ? -jx * j02 : zero, ray_y = s->free_y ? -jy * j12 : zero;
    const VF x_over_z = s->x * s->inverse_z, y_over_z = s->y * s->inverse_z;
    const VF gx = jx * gu + ray_x * s->inverse_z;
    const VF gy = jy * gv + ray_y * s->inverse_z;
    const VF gz = -(jx * x_over_z * gu + jy * y_over_z * gv) -
                  s->inverse_z * (jx * (j00 - s->ray_x * j02) + x_over_z * ray_x +
                                  jy * (j11 - s->ray_y * j12) + y_over_z * ray_y);
    for (uint k = 0; k < 3; k++)
        grad_mean[k] = w[k] * gx + w[4 + k] * gy + w[8 + k] * gz;
    grad_mean2d[0] = gu;
    grad_mean2d[1] = gv;
    *grad_focal = jx * (s->x * gu + j00) + jy * (s->y * gv + j11) + s->ray_x * ray_x + s->ray_y * ray_y;
}

/* Gradients of all parameters except SH coefficients, whose gradients are basis[k] * color[channel]. */
typedef struct {
    VI touched;      // whether the Gaussian is visible; if not, all gradients are zero and these values are invalid
    VF mean2d[2];    // px^-1
    VF means[3], quats[4], log_scales[3], logit_opacity;
    VF focal;        // gradient of the logarithm of a factor on both focal lengths
    VF basis[16], color[3];
} gradient_t;

/* The sums over pixels of LANES Gaussians. */
static inline void load_sums(__global const float *pixel_sums, const uint stride, const uint i, VF *m)
{
    for (uint k = 0; k < PIXEL_SUMS; k++)
        m[k] = VLOAD(pixel_sums + k * stride + i);
}

/* Which Gaussians were rendered, and the gradients of their colors. */
static inline void color_backward(
    __global const float *splats,  // [N,RECORD] see splat.h
    const VF *m,                   // [PIXEL_SUMS] see splat.h
    const uint count, const uint i, gradient_t *g)
{
    float table[4][LANES];
    for (uint lane = 0; lane < LANES; lane++)
        for (uint k = 0; k < 4; k++)
            table[k][lane] = i + lane < count ? splats[(size_t)(i + lane) * RECORD + SPLAT_OPACITY + k] : 0.0f;
    g->touched = VLOAD_PRIVATE(table[0]) > 0.0f;  // culled records are all zero
    for (uint channel = 0; channel < 3; channel++)  // max(0, .) passes no gradient where it clamps
        g->color[channel] = VLOAD_PRIVATE(table[1 + channel]) > 0.0f ? m[SUM_RED + channel] : (VF)(0.0f);
}

/* The weight of each basis function in the derivative with respect to the direction, c_k . g, for the vectors whose
 * harmonics start at `first`: plane by plane, so that memory is read contiguously.  unseen: a bit for each vector
 * without a visible Gaussian, whose harmonics are not read. */
static inline void weigh_harmonics(
    __global const float *sh_rest,  // coefficient-major, see slots.h
    const gradient_t *g, const uint vectors, const uint unseen, const uint degree, const uint stride, const uint *first,
    VF (*weights)[16])
{
    for (uint k = 1; k < (degree + 1) * (degree + 1); k++) {
        for (uint v = 0; v < vectors; v++)
            weights[v][k] = (VF)(0.0f);
        for (uint channel = 0; channel < 3; channel++)
            for (uint v = 0; v < vectors; v++)
                if (!((unseen >> v) & 1))
                    weights[v][k] += VLOAD(sh_rest + ((k - 1) * 3 + channel) * SH_STRIDE(stride) + first[v]) *
                                     g[v].color[channel];
    }
}

/* Set the gradients of Gaussians that are not visible to zero. */
static inline void no_gradient(gradient_t *g)
{
    const VF zero = (VF)(0.0f);
    for (uint k = 0; k < 2; k++)
        g->mean2d[k] = zero;
    for (uint k = 0; k < 3; k++)
        g->means[k] = g->log_scales[k] = zero;
    for (uint k = 0; k < 4; k++)
        g->quats[k] = zero;
    for (uint k = 0; k < 16; k++)
        g->basis[k] = zero;
    g->logit_opacity = g->focal = zero;
}

/* The remaining gradients, from those of the colors and the weights of the harmonics. */
static inline void gradient_of(
    __global const float *means,            // [3,S] scene units
    __global const float *quats,            // [4,S] unnormalized
    __global const float *log_scales,       // [3,S] log of scene units
    __global const float *logit_opacity,    // [S]
    __global const float *filter_variance,  // [S] scene units^2
    __constant camera_t *camera,            // [1]
    const VF *m,                            // [PIXEL_SUMS] see splat.h
    const VF *weights,                      // [16]
    const float near_plane, const float screen_variance, const float compensate, const uint degree,
    const uint stride, const uint i, gradient_t *g)
{
    shape_t s;
    shape_of(means, quats, log_scales, filter_variance, camera, near_plane, screen_variance, compensate, stride, i, &s);
    shape_backward(&s, camera, m, screen_variance, compensate, g->mean2d, g->means, g->quats, g->log_scales, &g->focal);
    VF d[3], gd[3] = {0.0f, 0.0f, 0.0f};
    const VF inverse_distance = view_direction(means, camera, stride, i, d);
    harmonics_basis(degree, d[0], d[1], d[2], g->basis);
    harmonics_direction_gradient(degree, d[0], d[1], d[2], weights, gd, gd + 1, gd + 2);
    const VF along = d[0] * gd[0] + d[1] * gd[1] + d[2] * gd[2];
    for (uint k = 0; k < 3; k++)
        g->means[k] += (gd[k] - d[k] * along) * inverse_distance;
    g->logit_opacity = m[SUM_POWER] * (1.0f - sigmoid(VLOAD(logit_opacity + i)));
}

#endif
