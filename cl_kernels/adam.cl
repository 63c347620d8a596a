/* Update every parameter by Adam.
 *
 * adam_step reads gradients from memory.  update_gaussians computes the gradients of the projection itself, which saves
 * writing and reading 59 values per Gaussian; its results equal those of project_backward and adam_step bit for bit.
 * It can sum the records of pairs itself (gather.cl), and add the view to statistics (density.cl).
 *
 * `every`: all ones to update all Gaussians; 0: the values and moments of culled Gaussians do not change.
 * `undrawn`: all ones to update vectors without a Gaussian in the view at once; 0: their harmonics are updated later
 * (deferred.cl).
 *
 * One item = LANES Gaussians.  No local memory.  Deterministic: each value has one writer. */
#include "adam.h"
#include "backward.h"
#include "pair_sums.h"

/* What update_gaussians writes in addition to the parameters, as bits of `outputs`. */
#define OUTPUT_MEAN2D 1    // the gradient of the projected means
#define OUTPUT_SEEN 2      // statistics: as count_seen
#define OUTPUT_NORM 4      // as accumulate_norm of the projected means
#define OUTPUT_ABS_NORM 8  // as accumulate_norm of the sums of absolute values

/* One update of one table.  Dimension 1 is the plane.  With SH_SLOTS the table is in slots (slots.h). */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void adam_step(
    __global float *restrict values,          // [components,S]
    __global const float *restrict gradient,  // [components,S]
    __global float *restrict moment1,         // [components,S]
    __global float *restrict moment2,         // [components,S]
    __global const uint *restrict depth_key,  // [S] of the view; all ones when culled
    __global const uint *restrict sh_slot,    // [S/LANES] slots.h
    const float rate,                         // learning rate / (1 - BETA1^t)
    const float correction2,                  // 1 / (1 - BETA2^t)
    const uint every,
    const uint undrawn,
    const uint sh_block,                      // values of a block in a slot
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES, first = every & undrawn;
    if (i >= count)
        return;
    /* if all are updated, every item reads the first keys, which costs nothing */
    const VI seen = VLOAD_INT(depth_key + (i & ~first)) != -1;
    if (!ANY(seen | (VI)((int)first)))
        return;
    const VI updated = seen | (VI)((int)every);
    const uint at = get_global_id(1) * SH_STRIDE(stride) + sh_first(sh_slot, sh_block, i);
    adam_update(values + at, moment1 + at, moment2 + at, VLOAD(gradient + at), updated, rate, correction2,
                EPSILON);
}

/* Update one plane of a block.  first, gradient, g, updated: [VECTORS]; waiting: a bit for each vector to skip. */
static inline void update_plane(__global float *values, __global float *moment1, __global float *moment2,
                                const uint *first, const VF *gradient, const gradient_t *g, const VI *updated,
                                const uint vectors, const uint waiting, const float rate, const float correction2)
{
    for (uint v = 0; v < vectors; v++)
        if (!((waiting >> v) & 1))
            adam_update(values + first[v], moment1 + first[v], moment2 + first[v],
                        g[v].touched ? gradient[v] : (VF)(0.0f), updated[v], rate, correction2, EPSILON);
}

/* Update plane `plane` of a table from the field `member` of the block's gradients. */
#define UPDATE(table, plane, member) UPDATE_BUT(0, first, stride, table, plane, member)
#define UPDATE_BUT(waiting, first, stride, table, plane, member)                                              \
    do {                                                                                                      \
        const uint at = (plane) * stride;                                                                     \
        VF gradient[VECTORS];                                                                                 \
        for (uint v = 0; v < vectors; v++)                                                                    \
            gradient[v] = g[v].member;                                                                        \
        update_plane(table + at, table##_moment1 + at, table##_moment2 + at, first, gradient, g, updated,     \
                     vectors, waiting, table##_rate, table##_correction2);                                    \
    } while (0)

/* Write the outputs of LANES Gaussians.  x, y: gradient of the projected means; m: sums over pixels. */
static inline void write_outputs(const uint outputs, __global float *grad_mean2d, __global const float *radius,
                                 __global float *seen, __global float *norms, const float half_width,
                                 const float half_height, const uint stride, const uint i, VF x, VF y, const VF *m)
{
    if (outputs & OUTPUT_MEAN2D) {
        VSTORE(x, grad_mean2d + i);
        VSTORE(y, grad_mean2d + stride + i);
    }
    if (!(outputs & (OUTPUT_SEEN | OUTPUT_NORM | OUTPUT_ABS_NORM)))
        return;
    const VI visible = VLOAD(radius + i) > 0.0f;
    if (outputs & OUTPUT_SEEN) {
        const VF views = VLOAD(seen + i);
        VSTORE((visible ? views + 1.0f : views), seen + i);
    }
#if PIXEL_SUMS > SUM_ABS_Y
    if (outputs & OUTPUT_ABS_NORM)
        x = m[SUM_ABS_X], y = m[SUM_ABS_Y];
#endif
    if (outputs & (OUTPUT_NORM | OUTPUT_ABS_NORM)) {
        const VF total = VLOAD(norms + i);
        x *= half_width, y *= half_height;
        VSTORE((visible ? total + sqrt(x * x + y * y) : total), norms + i);
    }
}

/* The update of all tables from the sums over pixels.  Rates are divided by 1 - BETA1^t.
 *
 * One item = VECTORS vectors of Gaussians, plane by plane, so that memory is read contiguously; vectors without an
 * updated Gaussian are skipped.  Private memory: VECTORS * LANES * 204 bytes. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void update_gaussians(
    __global float *restrict means,                  // [3,S] scene units
    __global float *restrict quats,                  // [4,S] unnormalized
    __global float *restrict log_scales,             // [3,S] log of scene units
    __global float *restrict logit_opacity,          // [S]
    __global float *restrict sh_base,                // [3,S]
    __global float *restrict sh_rest,                // [(K-1)*3,S] coefficient-major, or slots (slots.h)
    __global const uint *restrict sh_slot,           // [S/LANES] slots.h
    __global float *restrict means_moment1,          // [3,S]
    __global float *restrict means_moment2,          // [3,S]
    __global float *restrict quats_moment1,          // [4,S]
    __global float *restrict quats_moment2,          // [4,S]
    __global float *restrict log_scales_moment1,     // [3,S]
    __global float *restrict log_scales_moment2,     // [3,S]
    __global float *restrict logit_opacity_moment1,  // [S]
    __global float *restrict logit_opacity_moment2,  // [S]
    __global float *restrict sh_base_moment1,        // [3,S]
    __global float *restrict sh_base_moment2,        // [3,S]
    __global float *restrict sh_rest_moment1,        // [(K-1)*3,S] as sh_rest
    __global float *restrict sh_rest_moment2,        // [(K-1)*3,S] as sh_rest
    __global const float *restrict filter_variance,  // [S] scene units^2
    __constant camera_t *restrict camera,            // [1]
    __global const float *restrict splats,           // [N,RECORD] see splat.h
    __global const float *restrict pixel_sums,       // [PIXEL_SUMS,S] see splat.h; read unless `has_pairs`
    __global const float *restrict pair_sums,        // [P,RECORD]
    __global const uint *restrict first_pair,        // [N]
    __global const uint *restrict tile_count,        // [N]
    __global const uint *restrict pair_count,        // [2] see pairs.cl; without room for the pairs, nothing changes
    __global float *restrict grad_mean2d,            // [2,S] px^-1
    __global const float *restrict radius,           // [S] px, 0 = not seen
    __global float *restrict seen,                   // [S] views
    __global float *restrict norms,                  // [S] over views
    const float near_plane,                          // scene units
    const float screen_variance,                     // px^2
    const float compensate,                          // 0 or 1
    const float means_rate,
    const float quats_rate,
    const float log_scales_rate,
    const float logit_opacity_rate,
    const float sh_base_rate,
    const float sh_rest_rate,
    const float means_correction2,
    const float quats_correction2,
    const float log_scales_correction2,
    const float logit_opacity_correction2,
    const float sh_base_correction2,
    const float sh_rest_correction2,
    const uint degree,
    const uint sh_rest_degree,                       // of the bands to update: 0 or `degree`
    const float half_width,                          // px
    const float half_height,                         // px
    const uint has_pairs,                            // 1: sum the records of pairs, as sum_records does
    const uint outputs,
    const uint every,
    const uint undrawn,
    const uint sh_block,                             // values of a block in a slot
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES * VECTORS;
    if (i >= count || pair_count[1])
        return;
    uint first[VECTORS], active = 0, unseen = 0;
    gradient_t g[VECTORS];
    VI updated[VECTORS];
    VF weights[VECTORS][16], m[VECTORS][PIXEL_SUMS];
    for (uint v = 0; v < VECTORS && i + v * LANES < count; v++) {
        const uint at = i + v * LANES;
        if (has_pairs)
            sum_pairs(pair_sums, first_pair, tile_count, pixel_sums, 0, stride, count, at, m[active]);
        else
            load_sums(pixel_sums, stride, at, m[active]);
        color_backward(splats, m[active], count, at, g + active);
        first[active] = at;
        updated[active] = g[active].touched | (VI)((int)every);
        if (ANY(updated[active])) {
            unseen |= (ANY(g[active].touched) ? 0u : 1u) << active;
            active++;
        } else {
            write_outputs(outputs, grad_mean2d, radius, seen, norms, half_width, half_height, stride, at, (VF)(0.0f),
                          (VF)(0.0f), m[active]);
        }
    }
    if (active == 0)
        return;
    const uint vectors = active < VECTORS ? active : VECTORS;  // so that compilers know it is 1 if VECTORS is 1
#if SH_SLOTS
    uint sh_index[VECTORS];
    for (uint v = 0; v < vectors; v++)
        sh_index[v] = sh_first(sh_slot, sh_block, first[v]);
#else
    const uint *sh_index = first;
#endif
    weigh_harmonics(sh_rest, g, vectors, unseen, degree, stride, sh_index, weights);
    for (uint v = 0; v < vectors; v++) {
        const uint at = first[v];
        if ((unseen >> v) & 1)
            no_gradient(g + v);
        else
            gradient_of(means, quats, log_scales, logit_opacity, filter_variance, camera, m[v], weights[v], near_plane,
                        screen_variance, compensate, degree, stride, at, g + v);
        write_outputs(outputs, grad_mean2d, radius, seen, norms, half_width, half_height, stride, at,
                      g[v].touched ? g[v].mean2d[0] : (VF)(0.0f), g[v].touched ? g[v].mean2d[1] : (VF)(0.0f), m[v]);
    }
    for (uint k = 0; k < 3; k++)
        UPDATE(means, k, means[k]);
    for (uint k = 0; k < 4; k++)
        UPDATE(quats, k, quats[k]);
    for (uint k = 0; k < 3; k++)
        UPDATE(log_scales, k, log_scales[k]);
    UPDATE(logit_opacity, 0, logit_opacity);
    for (uint channel = 0; channel < 3; channel++)
        UPDATE(sh_base, channel, basis[0] * g[v].color[channel]);
    for (uint k = 1; k < (sh_rest_degree + 1) * (sh_rest_degree + 1); k++)
        for (uint channel = 0; channel < 3; channel++)
            UPDATE_BUT(unseen & ~undrawn, sh_index, SH_STRIDE(stride), sh_rest, (k - 1) * 3 + channel,
                       basis[k] * g[v].color[channel]);
}
