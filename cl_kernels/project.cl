/* Projection of Gaussians to screen ellipses with view-dependent color, and its gradient (backward.h).
 *
 * Kerbl et al. 2023, section 4, with the linearized perspective of Zwicker et al. 2001.  Both filters are
 * variances: `filter_variance`, scene units^2, is added to the squared scales, `screen_variance`, px^2, to the screen
 * covariance.
 * The opacity is multiplied by the energy factor of the first, and with `compensate` = 1 also by that of the second
 * (Mip-Splatting, Yu et al. 2024, eq. 9 and 11), and by a constant factor.  None of them changes the derivative with
 * respect to the logit: the sum over pixels of dL/dpower times 1 - sigmoid.  With PIXEL_BOX `screen_variance` and
 * `compensate` are 0.
 *
 * One item = LANES Gaussians.  No local memory.  Deterministic: no item writes values that another reads. */
#include "backward.h"
#include "tiles.h"

static inline void add_band(const uint first, const uint last, const VF *basis, __global const float *sh_rest,
                            const uint stride, const uint first_value, VF *color)
{
    for (uint k = first; k < last; k++)
        for (uint channel = 0; channel < 3; channel++)
            color[channel] += basis[k] * VLOAD(sh_rest + ((k - 1) * 3 + channel) * SH_STRIDE(stride) + first_value);
}

/* Write the records of LANES splats: zero where not visible. */
static inline void store_records(const VF *fields, const VI visible, const uint i, const uint count,
                                 __global float *splats)
{
#if LANES == 1
    __global float4 *record = (__global float4 *)splats + (size_t)i * (RECORD / 4);
    for (uint k = 0; k < RECORD / 4; k++)
        record[k] = visible ? vload4(k, fields) : (float4)(0.0f);
#else
    for (uint part = 0; part < RECORD; part += LANES) {
        VF rows[LANES];
        for (uint k = 0; k < LANES; k++)
            rows[k] = visible ? fields[part + k] : (VF)(0.0f);
        transpose(rows);
        for (uint lane = 0; lane < LANES && i + lane < count; lane++)
            VSTORE(rows[lane], splats + (size_t)(i + lane) * RECORD + part);
    }
#endif
}

__attribute__((vec_type_hint(VF)))  // vectorized already; compilers that combine items make it four times slower
/* Splat records, depth keys, 3-sigma radii and the tiles that each splat touches. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void project_forward(
    __global const float *restrict means,            // [3,S] scene units
    __global const float *restrict quats,            // [4,S] unnormalized
    __global const float *restrict log_scales,       // [3,S] log of scene units
    __global const float *restrict logit_opacity,    // [S]
    __global const float *restrict sh_base,          // [3,S]
    __global const float *restrict sh_rest,          // [(K-1)*3,S] coefficient-major, or slots (slots.h)
    __global const uint *restrict sh_slot,           // [S/LANES] slots.h
    __global const float *restrict filter_variance,  // [S] scene units^2
    __global const float *restrict hidden,           // [planes,S] integers: bits of the views that hide a Gaussian
    __constant camera_t *restrict camera,            // [1]
    __global float *restrict splats,                 // [N,RECORD] see splat.h
    __global uint *restrict depth_key,               // [S] bits of z, all ones when culled
    __global uint *restrict tile_count,              // [S] tiles touched; 0 when culled or large (large.cl)
    __global uint *restrict tile_box,                // [S] see tiles.h
    __global uint *restrict tile_mask,               // [S] see tiles.h
    __global float *restrict radius,                 // [S] px, 3 sigma; 0 when outside the tile grid
    const float near_plane,                          // scene units
    const float screen_variance,                     // px^2
    const float compensate,                          // 0 or 1
    const float opacity_factor,                      // 1, or that of the step's dropout
    const uint row_begin,                            // first row of tiles whose pairs are listed
    const uint row_end,
    const uint hidden_plane,                         // plane of the view's bit in `hidden`
    const uint hidden_bit,                           // the view's bit; 0: no Gaussian is hidden
    const uint degree,
    const uint sh_block,                             // values of a block in a slot
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    shape_t s;
    shape_of(means, quats, log_scales, filter_variance, camera, near_plane, screen_variance, compensate, stride, i, &s);
    const VI left_out = to_VI(VLOAD(hidden + hidden_plane * stride + i)) & (VI)((int)hidden_bit);
    const VI inside = ((LANE_INDEX + (int)i) < (int)count) & (left_out == 0);
    const VF u = camera->fx * s.x * s.inverse_z + camera->cx;
    const VF v = camera->fy * s.y * s.inverse_z + camera->cy;

    /* A Gaussian counts as visible when the rectangle of its 3-sigma radius meets the tile grid, as in the reference */
    const VF middle = 0.5f * (s.xx + s.yy) + screen_variance;
    const VF spread = larger(middle * middle - s.determinant, (VF)(LAMBDA_FLOOR));
    const VF r = ceil(3.0f * sqrt(middle + sqrt(spread)));
    const float grid_x = (float)(camera->tiles_x * TILE), grid_y = (float)(camera->tiles_y * TILE);
    const VI seen = inside & s.valid & (u - 0.5f - r < grid_x) & (u - 0.5f + r >= 1.0f) &
                    (v - 0.5f - r < grid_y) & (v - 0.5f + r >= 1.0f);
    VSTORE((seen ? r : (VF)(0.0f)), radius + i);

    const VF opacity = sigmoid(VLOAD(logit_opacity + i)) * s.energy * opacity_factor;
#if PIXEL_BOX  // a pixel shows at most the full area of the splat
    const VI opaque = opacity * smaller(TWO_PI * sqrt(s.determinant), (VF)(1.0f)) > ALPHA_MIN;
#else
    const VI opaque = opacity > ALPHA_MIN;
#endif
    const VF power_min = larger(log_positive(ALPHA_MIN / (opaque ? opacity : (VF)(1.0f))), (VF)(POWER_MIN));
    const VF size2 = EXTENT_SLACK - 2.0f * power_min;
#if PIXEL_BOX
    const VF half_x = 0.5f + sqrt(size2 * (s.xx + BOX_FOOTPRINT)), half_y = 0.5f + sqrt(size2 * (s.yy + BOX_FOOTPRINT));
#else
    const VF half_x = sqrt(size2 * (s.xx + screen_variance)), half_y = sqrt(size2 * (s.yy + screen_variance));
#endif
    const VI visible = inside & s.valid & opaque & (u + half_x >= 0.0f) & (u - half_x <= (float)camera->width) &
                       (v + half_y >= 0.0f) & (v - half_y <= (float)camera->height);

    VF color[3] = {(VF)(0.5f), (VF)(0.5f), (VF)(0.5f)};
    if (ANY(visible)) {
        VF d[3], basis[16];
        view_direction(means, camera, stride, i, d);
        harmonics_basis(degree, d[0], d[1], d[2], basis);
        for (uint channel = 0; channel < 3; channel++)
            color[channel] += basis[0] * VLOAD(sh_base + channel * stride + i);
        const uint sh_index = sh_first(sh_slot, sh_block, i);
        if (degree > 0)
            add_band(1, 4, basis, sh_rest, stride, sh_index, color);
        if (degree > 1)
            add_band(4, 9, basis, sh_rest, stride, sh_index, color);
        if (degree > 2)
            add_band(9, 16, basis, sh_rest, stride, sh_index, color);
    }

    const VF zero = (VF)(0.0f);
#if PIXEL_BOX
    const VI turned = s.xx > s.yy;
    const VF longer = turned ? s.xx : s.yy;
    const VF fields[RECORD] = {
        u, v, s.xy / longer, sqrt(longer), sqrt(s.determinant / longer), opacity,
        larger(color[0], zero), larger(color[1], zero), larger(color[2], zero),
        v - half_y, v + half_y, u - half_x, u + half_x, turned ? (VF)(1.0f) : zero, s.inverse_z, zero};
#else
    const VF fields[RECORD] = {
        u, v, s.conic_xx, s.conic_xy, s.conic_yy, opacity,
        larger(color[0], zero), larger(color[1], zero), larger(color[2], zero),
        v - half_y, v + half_y, u - half_x, u + half_x, power_min, s.inverse_z, zero};
#endif
    const footprint_t footprint = footprint_of(fields, visible, camera->tiles_x, row_begin, row_end);
    VI mask;
    VSTORE_INT(count_tiles(&footprint, &mask), tile_count + i);
    VSTORE_INT(mask, tile_mask + i);
    VSTORE_INT(box_of(&footprint), tile_box + i);
    VSTORE_INT((visible ? as_VI(s.z) : (VI)(-1)), depth_key + i);
    store_records(fields, visible, i, count, splats);
}

static inline void store_planes(__global float *planes, const VF *values, const VI touched,
                                const uint components, const uint stride, const uint i)
{
    for (uint k = 0; k < components; k++)
        VSTORE((touched ? values[k] : (VF)(0.0f)), planes + k * stride + i);
}

/* Gradients of all parameters from the sums over pixels; zero for Gaussians that were culled. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void project_backward(
    __global const float *restrict means,            // [3,S] scene units
    __global const float *restrict quats,            // [4,S] unnormalized
    __global const float *restrict log_scales,       // [3,S] log of scene units
    __global const float *restrict logit_opacity,    // [S]
    __global const float *restrict sh_rest,          // [(K-1)*3,S] coefficient-major, or slots (slots.h)
    __global const uint *restrict sh_slot,           // [S/LANES] slots.h
    __global const float *restrict filter_variance,  // [S] scene units^2
    __constant camera_t *restrict camera,            // [1]
    __global const float *restrict splats,           // [N,RECORD] see splat.h
    __global const float *restrict pixel_sums,       // [PIXEL_SUMS,S] see splat.h
    __global float *restrict grad_means,             // [3,S]
    __global float *restrict grad_quats,             // [4,S]
    __global float *restrict grad_log_scales,        // [3,S]
    __global float *restrict grad_logit_opacity,     // [S]
    __global float *restrict grad_sh_base,           // [3,S]
    __global float *restrict grad_sh_rest,           // [(K-1)*3,S] as sh_rest, bands up to `degree` only
    __global float *restrict grad_mean2d,            // [2,S] px^-1
    const float near_plane,                          // scene units
    const float screen_variance,                     // px^2
    const float compensate,                          // 0 or 1
    const uint degree,
    const uint sh_block,                             // values of a block in a slot
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    gradient_t g;
    VF weights[1][16], m[PIXEL_SUMS];
    const uint sh_index = sh_first(sh_slot, sh_block, i);
    load_sums(pixel_sums, stride, i, m);
    color_backward(splats, m, count, i, &g);
    weigh_harmonics(sh_rest, &g, 1, !ANY(g.touched), degree, stride, &sh_index, weights);
    gradient_of(means, quats, log_scales, logit_opacity, filter_variance, camera, m, weights[0], near_plane,
                screen_variance, compensate, degree, stride, i, &g);
    store_planes(grad_means, g.means, g.touched, 3, stride, i);
    store_planes(grad_quats, g.quats, g.touched, 4, stride, i);
    store_planes(grad_log_scales, g.log_scales, g.touched, 3, stride, i);
    store_planes(grad_logit_opacity, &g.logit_opacity, g.touched, 1, stride, i);
    store_planes(grad_mean2d, g.mean2d, g.touched, 2, stride, i);
    for (uint k = 0; k < (degree + 1) * (degree + 1); k++) {
        const VF coefficients[3] = {g.basis[k] * g.color[0], g.basis[k] * g.color[1], g.basis[k] * g.color[2]};
        if (k == 0)
            store_planes(grad_sh_base, coefficients, g.touched, 3, stride, i);
        else if (sh_held(sh_slot, i))
            store_planes(grad_sh_rest + (k - 1) * 3 * SH_STRIDE(stride), coefficients, g.touched, 3, SH_STRIDE(stride),
                         sh_index);
    }
}
