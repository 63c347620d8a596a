/* Density control: sum statistics of each Gaussian, mark rows by rules, and write the new rows.
 *
 * Kerbl et al. 2023, section 5.  A rule is a box in (statistic, size, opacity) with an outcome of three numbers: the
 * rows that a Gaussian becomes (`copies`), the number of these that keep its moments (`old_rows`), and the factor on
 * the scales of its fresh rows (`shrink`).  Clone = (2, 1, 1), split in n = (n, 0, 1/1.6), prune = (0, 0, 1).  If
 * `shared` is set, the rows together are as opaque as the Gaussian was.  One item = one Gaussian or one row.  No local
 * memory.  Deterministic. */
#include "random.h"
#include "splat.h"

/* Count the views in which each Gaussian is visible. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_seen(
    __global const float *restrict radius,  // [S] px, 0 = not seen
    __global float *restrict seen,          // [S] views
    const uint count)
{
    const uint i = get_global_id(0);
    if (i < count && radius[i] > 0.0f)
        seen[i] += 1.0f;
}

/* Add the Euclidean norm of this view's screen gradient, in the unit of Kerbl et al.: loss per normalized device
 * coordinate.  The gradient is in planes `first` and `first` + 1. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void accumulate_norm(
    __global const float *restrict planes,  // [>first+1,S] px^-1
    __global const float *restrict radius,  // [S] px, 0 = not seen
    __global float *restrict total,         // [S] over views
    const float half_width,                 // px
    const float half_height,                // px
    const uint first,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || !(radius[i] > 0.0f))
        return;
    const float x = half_width * planes[first * stride + i], y = half_height * planes[(first + 1) * stride + i];
    total[i] += sqrt(x * x + y * y);
}

/* The same with |x| + |y| instead of the norm. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void accumulate_sum(
    __global const float *restrict planes,  // [>first+1,S] px^-1
    __global const float *restrict radius,  // [S] px, 0 = not seen
    __global float *restrict total,         // [S] over views
    const float half_width,                 // px
    const float half_height,                // px
    const uint first,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || !(radius[i] > 0.0f))
        return;
    total[i] += half_width * fabs(planes[first * stride + i]) + half_height * fabs(planes[(first + 1) * stride + i]);
}

/* Add one of this view's sums over pixels. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void accumulate_pixel_sum(
    __global const float *restrict pixel_sums,  // [>pixel_sum,S] see splat.h
    __global const float *restrict radius,      // [S] px, 0 = not seen
    __global float *restrict total,             // [S] over views
    const uint pixel_sum,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i < count && radius[i] > 0.0f)
        total[i] += pixel_sums[pixel_sum * stride + i];
}

/* Add the largest change of this view's loss by a shift of one standard deviation, sqrt(g^T C g) with the splat's
 * covariance C, times a factor. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void accumulate_gain(
    __global const float *restrict grad_mean2d,  // [2,S] px^-1
    __global const float *restrict splats,       // [N,RECORD] see splat.h
    __global const float *restrict radius,       // [S] px, 0 = not seen
    __global float *restrict total,              // [S] over views
    const float factor,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || !(radius[i] > 0.0f))
        return;
    __global const float *splat = splats + (size_t)i * RECORD;
    const float xx = splat[SPLAT_XX], xy = splat[SPLAT_XY], yy = splat[SPLAT_YY];
    const float x = grad_mean2d[i], y = grad_mean2d[stride + i];
    const float square = yy * x * x - 2.0f * xy * x * y + xx * y * y, determinant = xx * yy - xy * xy;
    total[i] += square > 0.0f && determinant > 0.0f ? factor * sqrt(square / determinant) : 0.0f;
}

/* Add this view's error, whether it sees the Gaussian or not. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void accumulate_error(
    __global const float *restrict error,  // [1]
    __global float *restrict total,        // [S] over views
    const uint count)
{
    const uint i = get_global_id(0);
    if (i < count)
        total[i] += error[0];
}

/* Add this view's radius. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void accumulate_radius(
    __global const float *restrict radius,  // [S] px, 0 = not seen
    __global float *restrict total,         // [S] over views, px
    const uint count)
{
    const uint i = get_global_id(0);
    if (i < count)
        total[i] += radius[i];
}

/* Start an edit: every Gaussian keeps its row. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void start_edit(
    __global uint *restrict copies,    // [N]
    __global uint *restrict old_rows,  // [N]
    __global float *restrict shrink,   // [N]
    __global uint *restrict shared,    // [N] 0 or 1
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    copies[i] = 1;
    old_rows[i] = 1;
    shrink[i] = 1.0f;
    shared[i] = 0;
}

/* Apply one rule.  The first growing rule whose box contains a Gaussian decides; pruning overrides growth, and compares
 * the size of the children after a split. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void mark_rule(
    __global const float *restrict log_scales,     // [3,S] log of scene units
    __global const float *restrict logit_opacity,  // [S]
    __global const float *restrict statistic,      // [S] sum over views
    __global const float *restrict divisor,        // [S] divisor of the sum: views, or another sum
    __global uint *restrict copies,                // [N]
    __global uint *restrict old_rows,              // [N]
    __global float *restrict shrink,               // [N]
    __global uint *restrict shared,                // [N] 0 or 1
    const float gradient_above,                    // lower bound of the mean, inclusive
    const float size_above,                        // lower bound of the size, exclusive, scene units
    const float size_below,                        // upper bound of the size, inclusive, scene units
    const float opacity_below,                     // upper bound of the opacity, exclusive
    const float new_shrink,
    const uint new_copies,
    const uint new_old_rows,
    const uint new_shared,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || !(new_copies == 0 || copies[i] == 1))
        return;
    const float size = exp(fmax(log_scales[i], fmax(log_scales[stride + i], log_scales[2 * stride + i]))) * shrink[i];
    const float opacity = 1.0f / (1.0f + exp(-logit_opacity[i]));
    const float gradient = divisor[i] > 0.0f ? statistic[i] / divisor[i] : 0.0f;
    if (gradient >= gradient_above && size > size_above && size <= size_below && opacity < opacity_below) {
        copies[i] = new_copies;
        old_rows[i] = new_old_rows;
        shared[i] = new_shared;
        shrink[i] = new_copies == 0 ? shrink[i] : new_shrink;
    }
}

/* Apply one rule to the Gaussians that the host has chosen, with the same precedence. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void mark_chosen(
    __global const uint *restrict outcome,  // [N] new copies + 1; 0: not chosen
    __global uint *restrict copies,         // [N]
    __global uint *restrict old_rows,       // [N]
    __global float *restrict shrink,        // [N]
    const float new_shrink,
    const uint new_old_rows,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || outcome[i] == 0 || !(outcome[i] == 1 || copies[i] == 1))
        return;
    copies[i] = outcome[i] - 1;
    old_rows[i] = new_old_rows < copies[i] ? new_old_rows : copies[i];
    shrink[i] = copies[i] == 0 ? shrink[i] : new_shrink;
}

/* The source row of each new row, in the old order: all rows of a Gaussian are contiguous. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void list_rows(
    __global const uint *restrict copies,      // [N]
    __global const uint *restrict old_rows,    // [N]
    __global const uint *restrict row_offset,  // [N+1] scanned copies
    __global uint *restrict source,            // [M]
    __global uint *restrict fresh,             // [M] 0 or 1
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    for (uint copy = 0; copy < copies[i]; copy++) {
        source[row_offset[i] + copy] = i;
        fresh[row_offset[i] + copy] = copy >= old_rows[i] ? 1 : 0;
    }
}

/* Move and shrink the children of split Gaussians: mean + R (s * normal), s * shrink. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void spawn_children(
    __global const uint *restrict source,    // [M] row before the edit
    __global const uint *restrict old_rows,  // [N] before the edit; 0 = split
    __global const float *restrict shrink,   // [N] before the edit
    __global const float *restrict quats,    // [4,S] unnormalized
    __global float *restrict means,          // [3,S] scene units
    __global float *restrict log_scales,     // [3,S] log of scene units
    const uint seed,
    const uint step,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || old_rows[source[i]] > 0)
        return;
    const float3 normal = normal3((uint4)(i, step, 0, 0), (uint2)(seed, 0));
    const float ex = exp(log_scales[i]) * normal.x;
    const float ey = exp(log_scales[stride + i]) * normal.y;
    const float ez = exp(log_scales[2 * stride + i]) * normal.z;
    float w = quats[i], x = quats[stride + i], y = quats[2 * stride + i], z = quats[3 * stride + i];
    const float inverse = 1.0f / sqrt(w * w + x * x + y * y + z * z);
    w *= inverse, x *= inverse, y *= inverse, z *= inverse;
    const float xx = 2.0f * x * x, yy = 2.0f * y * y, zz = 2.0f * z * z;
    means[i] += (1.0f - yy - zz) * ex + 2.0f * (x * y - w * z) * ey + 2.0f * (x * z + w * y) * ez;
    means[stride + i] += 2.0f * (x * y + w * z) * ex + (1.0f - xx - zz) * ey + 2.0f * (y * z - w * x) * ez;
    means[2 * stride + i] += 2.0f * (x * z - w * y) * ex + 2.0f * (y * z + w * x) * ey + (1.0f - xx - yy) * ez;
    for (uint k = 0; k < 3; k++)
        log_scales[k * stride + i] += log(shrink[source[i]]);
}

/* Opacities of rows that together transmit as much light as their Gaussian did: 1 - o' = (1 - o)^(1/n) (Rota Bulo et
 * al. 2024, "Revising Densification in Gaussian Splatting").  In logits, with x = log(1 + e^l) / n:
 * l' = log(e^x - 1). */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void share_opacity(
    __global const uint *restrict source,    // [M] row before the edit
    __global const uint *restrict copies,    // [N] before the edit
    __global const uint *restrict shared,    // [N] before the edit, 0 or 1
    __global float *restrict logit_opacity,  // [S]
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count || shared[source[i]] == 0)
        return;
    const float logit = logit_opacity[i];
    const float x = (fmax(logit, 0.0f) + log1p(exp(-fabs(logit)))) / (float)copies[source[i]];
    logit_opacity[i] = x + log(-expm1(-x));
}

/* Lower opacities to the limit, which applies to the opacity after the world filter (the opacity reset of 3DGS and
 * Mip-Splatting). */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void cap_opacity(
    __global const float *restrict log_scales,       // [3,S] log of scene units
    __global const float *restrict filter_variance,  // [S] scene units^2
    __global float *restrict logit_opacity,          // [S]
    const float limit,                               // largest filtered opacity
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    float energy2 = 1.0f;
    for (uint k = 0; k < 3 && filter_variance[i] > 0.0f; k++) {
        const float scale = exp(log_scales[k * stride + i]);
        energy2 /= 1.0f + filter_variance[i] / (scale * scale);
    }
    const float unfiltered = limit / sqrt(energy2);  // limit of the opacity before the filter; may be 1 or more
    const float logit = unfiltered < 1.0f ? log(unfiltered / (1.0f - unfiltered)) : logit_opacity[i];
    logit_opacity[i] = logit_opacity[i] < logit ? logit_opacity[i] : logit;
}
