/* Projection of Gaussians to screen ellipses with view-dependent colour, and its gradient.
 *
 * Kerbl et al. 2023, section 4, with the linearised perspective of Zwicker et al. 2001.  Both filters are numbers:
 * `filter_variance` is added to the squared scales, `screen_variance` to the screen covariance; the opacity loses the
 * energy that the first spreads out, and `compensate` (0 or 1) says whether it also loses that of the second
 * (Mip-Splatting, Yu et al. 2024, eq. 9 and 11).
 *
 * One item = LANES Gaussians.  No local memory.  Deterministic: no item writes what another reads. */
#include "gaussian.h"
#include "harmonics.h"
#include "tiles.h"

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

static inline void add_band(const uint first, const uint last, const VF *basis, __global const float *sh_rest,
                            const uint stride, const uint i, VF *colour)
{
    for (uint k = first; k < last; k++)
        for (uint channel = 0; channel < 3; channel++)
            colour[channel] += basis[k] * VLOAD(sh_rest + ((k - 1) * 3 + channel) * stride + i);
}

/* Splat records, depth keys, 3-sigma radii and the tiles that each splat touches. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void project_forward(
    __global const float *restrict means,            // [3,S] scene units
    __global const float *restrict quats,            // [4,S] unnormalised
    __global const float *restrict log_scales,       // [3,S] log of scene units
    __global const float *restrict logit_opacity,    // [S]
    __global const float *restrict sh_base,          // [3,S]
    __global const float *restrict sh_rest,          // [(K-1)*3,S] coefficient-major
    __global const float *restrict filter_variance,  // [S] scene units^2
    __constant camera_t *restrict camera,            // [1]
    __global float *restrict splats,                 // [N,RECORD] see splat.h
    __global uint *restrict depth_key,               // [S] bits of z, all ones when culled
    __global uint *restrict tile_count,              // [S] tiles touched; 0 when culled
    __global uint *restrict tile_box,                // [S] see tiles.h
    __global uint *restrict tile_mask,               // [S] see tiles.h
    __global float *restrict radius,                 // [S] px, 3 sigma; 0 when outside the tile grid
    const float near_plane,                          // scene units
    const float screen_variance,                     // px^2
    const float compensate,                          // 0 or 1
    const uint degree,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const shape_t s = shape_of(means, quats, log_scales, filter_variance, camera, near_plane, screen_variance,
                               compensate, stride, i);
    const VI inside = (LANE_INDEX + (int)i) < (int)count;
    const VF u = camera->fx * s.x * s.inverse_z + camera->cx;
    const VF v = camera->fy * s.y * s.inverse_z + camera->cy;

    /* 3-sigma radius and the tile rectangle of the reference implementation: who counts as seen */
    const VF middle = 0.5f * (s.xx + s.yy) + screen_variance;
    const VF spread = larger(middle * middle - s.determinant, (VF)(LAMBDA_FLOOR));
    const VF r = ceil(3.0f * sqrt(middle + sqrt(spread)));
    const float grid_x = (float)(camera->tiles_x * TILE), grid_y = (float)(camera->tiles_y * TILE);
    const VI seen = inside & s.valid & (u - 0.5f - r < grid_x) & (u - 0.5f + r >= 1.0f) &
                    (v - 0.5f - r < grid_y) & (v - 0.5f + r >= 1.0f);
    VSTORE((seen ? r : (VF)(0.0f)), radius + i);

    const VF opacity = sigmoid(VLOAD(logit_opacity + i)) * s.energy;
    const VI opaque = opacity > ALPHA_MIN;
    const VF power_min = larger(log_positive(ALPHA_MIN / (opaque ? opacity : (VF)(1.0f))), (VF)(POWER_MIN));
    const VF size2 = EXTENT_SLACK - 2.0f * power_min;
    const VF half_x = sqrt(size2 * (s.xx + screen_variance)), half_y = sqrt(size2 * (s.yy + screen_variance));
    const VI visible = inside & s.valid & opaque & (u + half_x >= 0.0f) & (u - half_x <= (float)camera->width) &
                       (v + half_y >= 0.0f) & (v - half_y <= (float)camera->height);

    VF colour[3] = {(VF)(0.5f), (VF)(0.5f), (VF)(0.5f)};
    if (ANY(visible)) {
        VF d[3], basis[16];
        view_direction(means, camera, stride, i, d);
        harmonics_basis(degree, d[0], d[1], d[2], basis);
        for (uint channel = 0; channel < 3; channel++)
            colour[channel] += basis[0] * VLOAD(sh_base + channel * stride + i);
        if (degree > 0)
            add_band(1, 4, basis, sh_rest, stride, i, colour);
        if (degree > 1)
            add_band(4, 9, basis, sh_rest, stride, i, colour);
        if (degree > 2)
            add_band(9, 16, basis, sh_rest, stride, i, colour);
    }

    const VF zero = (VF)(0.0f);
    const VF fields[RECORD] = {
        u, v, s.conic_xx, s.conic_xy, s.conic_yy, opacity,
        larger(colour[0], zero), larger(colour[1], zero), larger(colour[2], zero),
        v - half_y, v + half_y, u - half_x, u + half_x, power_min, zero, zero};
    const footprint_t footprint = footprint_of(fields, visible, camera->tiles_x, camera->tiles_y);
    VI mask;
    VSTORE(count_tiles(&footprint, &mask), (__global int *)tile_count + i);
    VSTORE(mask, (__global int *)tile_mask + i);
    VSTORE(box_of(&footprint), (__global int *)tile_box + i);
    VSTORE((visible ? as_VI(s.z) : (VI)(-1)), (__global int *)depth_key + i);
    for (uint part = 0; part < RECORD; part += LANES) {
        VF rows[LANES];
        for (uint k = 0; k < LANES; k++)
            rows[k] = visible ? fields[part + k] : zero;
        transpose(rows);
        for (uint lane = 0; lane < LANES && i + lane < count; lane++)
            VSTORE(rows[lane], splats + (size_t)(i + lane) * RECORD + part);
    }
}

/* Gradients of the mean, quaternion and log-scales from the summed moments of a Gaussian's pixels. */
static inline void shape_backward(const shape_t *s, __constant camera_t *camera, const VF *m,
                                  const float compensate, VF *grad_mean2d, VF *grad_mean, VF *grad_quat, VF *grad_scale)
{
    __constant const float *w = camera->world_to_camera;
    const VF a = s->conic_xx, b = s->conic_xy, c = s->conic_yy;
    const VF gu = -(a * m[MOMENT_X] + b * m[MOMENT_Y]);
    const VF gv = -(b * m[MOMENT_X] + c * m[MOMENT_Y]);

    /* conic -> covariance: -K G K with G = ((gA, gB/2), (gB/2, gC)) */
    const VF ga = -0.5f * m[MOMENT_XX], gb = -0.5f * m[MOMENT_XY], gc = -0.5f * m[MOMENT_YY];
    const VF k00 = a * ga + b * gb, k01 = a * gb + b * gc, k10 = b * ga + c * gb, k11 = b * gb + c * gc;
    /* energy of the screen filter: ratio = det0 / det1, d ratio = tr((adj(V0) / det1 - ratio K) dV) */
    const VF energy2 = larger(1.0f + compensate * (s->ratio - 1.0f), (VF)(1.0e-12f));
    const VF g_ratio = compensate * 0.5f * m[MOMENT_POWER] / energy2;
    const VF g00 = g_ratio * (s->yy / s->determinant - s->ratio * a) - (k00 * a + k01 * b);
    const VF g01 = g_ratio * (-s->xy / s->determinant - s->ratio * b) - (k00 * b + k01 * c);
    const VF g11 = g_ratio * (s->xx / s->determinant - s->ratio * c) - (k10 * b + k11 * c);

    /* covariance -> V = T M -> T, rotation, scales */
    VF gt[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f}, gr[9];
    for (uint k = 0; k < 3; k++) {
        const VF v0 = 2.0f * (g00 * s->v[k] + g01 * s->v[3 + k]);
        const VF v1 = 2.0f * (g01 * s->v[k] + g11 * s->v[3 + k]);
        VF g_filtered = (VF)(0.0f);
        for (uint j = 0; j < 3; j++) {
            const VF axis = s->rotation[3 * j + k] * s->filtered[k];
            gt[j] += v0 * axis;
            gt[3 + j] += v1 * axis;
            const VF gm = s->t[j] * v0 + s->t[3 + j] * v1;
            g_filtered += gm * s->rotation[3 * j + k];
            gr[3 * j + k] = gm * s->filtered[k];
        }
        const VF inverse = 1.0f / s->filtered[k];
        grad_scale[k] = (g_filtered * s->scale2[k] + m[MOMENT_POWER] * s->filter * inverse) * inverse;
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
}

/* Gradient of one band of coefficients; `weights` becomes c_k . g, the derivative of the loss by basis_k. */
static inline void band_backward(const uint first, const uint last, const VF *basis, const VF *grad_colour,
                                 const VI touched, __global const float *sh_rest,
                                 __global float *grad_sh_rest, const uint stride, const uint i, VF *weights)
{
    for (uint k = first; k < last; k++) {
        weights[k] = (VF)(0.0f);
        for (uint channel = 0; channel < 3; channel++) {
            const uint at = ((k - 1) * 3 + channel) * stride + i;
            weights[k] += VLOAD(sh_rest + at) * grad_colour[channel];
            VSTORE((touched ? basis[k] * grad_colour[channel] : (VF)(0.0f)), grad_sh_rest + at);
        }
    }
}

static inline void store_planes(__global float *planes, const VF *values, const VI touched,
                                const uint components, const uint stride, const uint i)
{
    for (uint k = 0; k < components; k++)
        VSTORE((touched ? values[k] : (VF)(0.0f)), planes + k * stride + i);
}

/* Gradients of all parameters from the moments; zero for Gaussians that were culled. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void project_backward(
    __global const float *restrict means,            // [3,S] scene units
    __global const float *restrict quats,            // [4,S] unnormalised
    __global const float *restrict log_scales,       // [3,S] log of scene units
    __global const float *restrict logit_opacity,    // [S]
    __global const float *restrict sh_rest,          // [(K-1)*3,S] coefficient-major
    __global const float *restrict filter_variance,  // [S] scene units^2
    __constant camera_t *restrict camera,            // [1]
    __global const float *restrict splats,           // [N,RECORD] see splat.h
    __global const float *restrict moments,          // [MOMENTS,S] see splat.h
    __global float *restrict grad_means,             // [3,S]
    __global float *restrict grad_quats,             // [4,S]
    __global float *restrict grad_log_scales,        // [3,S]
    __global float *restrict grad_logit_opacity,     // [S]
    __global float *restrict grad_sh_base,           // [3,S]
    __global float *restrict grad_sh_rest,           // [(K-1)*3,S] bands up to `degree` only
    __global float *restrict grad_mean2d,            // [2,S] px^-1
    const float near_plane,                          // scene units
    const float screen_variance,                     // px^2
    const float compensate,                          // 0 or 1
    const uint degree,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const shape_t s = shape_of(means, quats, log_scales, filter_variance, camera, near_plane, screen_variance,
                               compensate, stride, i);

    VF opacity, grad_colour[3], m[MOMENTS];
    float table[4][LANES];
    for (uint lane = 0; lane < LANES; lane++)
        for (uint k = 0; k < 4; k++)
            table[k][lane] = i + lane < count ? splats[(size_t)(i + lane) * RECORD + SPLAT_OPACITY + k] : 0.0f;
    opacity = VLOAD(table[0]);
    const VI touched = opacity > 0.0f;  // culled records are all zero
    for (uint k = 0; k < MOMENTS; k++)
        m[k] = VLOAD(moments + k * stride + i);
    for (uint channel = 0; channel < 3; channel++)  // max(0, .) passes no gradient where it clamped
        grad_colour[channel] = VLOAD(table[1 + channel]) > 0.0f ? m[MOMENT_RED + channel] : (VF)(0.0f);

    VF mean2d[2], mean[3], quat[4], scale[3];
    shape_backward(&s, camera, m, compensate, mean2d, mean, quat, scale);

    VF d[3], basis[16], weights[16], gd[3] = {0.0f, 0.0f, 0.0f}, base[3];
    const VF inverse_distance = view_direction(means, camera, stride, i, d);
    harmonics_basis(degree, d[0], d[1], d[2], basis);
    if (degree > 0)
        band_backward(1, 4, basis, grad_colour, touched, sh_rest, grad_sh_rest, stride, i, weights);
    if (degree > 1)
        band_backward(4, 9, basis, grad_colour, touched, sh_rest, grad_sh_rest, stride, i, weights);
    if (degree > 2)
        band_backward(9, 16, basis, grad_colour, touched, sh_rest, grad_sh_rest, stride, i, weights);
    harmonics_direction_gradient(degree, d[0], d[1], d[2], weights, gd, gd + 1, gd + 2);
    const VF along = d[0] * gd[0] + d[1] * gd[1] + d[2] * gd[2];
    for (uint k = 0; k < 3; k++) {
        mean[k] += (gd[k] - d[k] * along) * inverse_distance;
        base[k] = basis[0] * grad_colour[k];
    }
    const VF logit = m[MOMENT_POWER] * (1.0f - sigmoid(VLOAD(logit_opacity + i)));

    store_planes(grad_means, mean, touched, 3, stride, i);
    store_planes(grad_quats, quat, touched, 4, stride, i);
    store_planes(grad_log_scales, scale, touched, 3, stride, i);
    store_planes(grad_logit_opacity, &logit, touched, 1, stride, i);
    store_planes(grad_sh_base, base, touched, 3, stride, i);
    store_planes(grad_mean2d, mean2d, touched, 2, stride, i);
}
