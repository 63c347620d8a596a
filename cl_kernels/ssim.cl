/* D-SSIM between a rendered image and a photograph, value and gradient, with an optional L1 loss.
 *
 * SSIM: 11x11 Gaussian window, sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2 (Wang et al. 2004, as 3DGS uses it).
 * Planes are [channels,H',W'] with H', W' whole tiles, zero outside the image; gradients too.  One group of SSIM_TEAM
 * items = a block of COLUMNS x ROWS pixels of one channel.  An item sums RUN rows of a column at a time, which reads
 * each value once for all of them; the sums go to local memory for those along rows.  Deterministic. */
#include "planes.h"

#define SSIM_C1 1.0e-4f
#define SSIM_C2 9.0e-4f
#define REACH 5            // window is 2 * REACH + 1 wide
#define WIDE_COLUMNS 256
#define WIDE_ROWS 2
#define SIMT_COLUMNS 32
#define SIMT_ROWS 16
#if LANES > 1
#define COLUMNS WIDE_COLUMNS
#define ROWS WIDE_ROWS
#define RUN WIDE_ROWS
#define MARGIN 16          // columns on either side, at least REACH and whole vectors
#define SSIM_TEAM 1
#else
#define COLUMNS SIMT_COLUMNS
#define ROWS SIMT_ROWS
#define RUN 4
#define MARGIN REACH
#define SSIM_TEAM 128
#endif
#define SPAN (COLUMNS + 2 * MARGIN)

__constant float WINDOW[2 * REACH + 1] = {
    1.02838008e-03f, 7.59875814e-03f, 3.60007721e-02f, 1.09360690e-01f, 2.13005538e-01f, 2.66011725e-01f,
    2.13005538e-01f, 1.09360690e-01f, 3.60007721e-02f, 7.59875814e-03f, 1.02838008e-03f};

/* The place of a block's sum. */
static inline uint block_index(const uint channel)
{
    return (channel * get_num_groups(1) + get_group_id(1)) * get_num_groups(0) + get_group_id(0);
}

static inline float sum_team(__local const float *sums)  // [SSIM_TEAM]
{
    float sum = 0.0f;
    for (uint i = 0; i < SSIM_TEAM; i++)
        sum += sums[i];
    return sum;
}

/* Local means, then the derivatives of the SSIM map with respect to mean of x, variance of x and covariance:
 *   a1 = 2 mx my + C1, a2 = 2 cov + C2, b1 = mx^2 + my^2 + C1, b2 = vx + vy + C2, m = a1 a2 / (b1 b2).
 * Local memory: ROWS * SPAN * 20 bytes + SSIM_TEAM * 4. */
__kernel __attribute__((reqd_work_group_size(SSIM_TEAM, 1, 1)))
void ssim_maps(
    __global const float *restrict image,       // [3,H',stride]
    __global const float *restrict photograph,  // [3,H',stride]
    __global float *restrict maps,              // [3,3,H',stride] derivative, channel, row, column
    __global float *restrict block_sums,        // [3,blocks] sums of the SSIM map
    const uint width,
    const uint height,
    const uint rows,                            // H'
    const uint stride)
{
    __local float vertical[5][ROWS][SPAN];
    __local float sums[SSIM_TEAM];
    const uint item = get_local_id(0), channel = get_group_id(2);
    const uint plane = rows * stride, left = get_group_id(0) * COLUMNS, top = get_group_id(1) * ROWS;
    const VF zero = (VF)(0.0f);
    for (uint part = item; part < ROWS / RUN * (SPAN / LANES); part += SSIM_TEAM) {
        const uint v = part % (SPAN / LANES) * LANES, first = part / (SPAN / LANES) * RUN;
        const uint x = left + v - MARGIN;  // wraps to a large number left of the image
        VF mx[RUN], my[RUN], xx[RUN], yy[RUN], xy[RUN];
        for (uint r = 0; r < RUN; r++)
            mx[r] = my[r] = xx[r] = yy[r] = xy[r] = zero;
        if (x < stride)
            for (uint j = 0; j < RUN + 2 * REACH; j++) {
                const uint row = top + first + j - REACH;  // wraps to a large number above the image
                if (row >= height)
                    continue;
                const uint at = channel * plane + row * stride + x;
                const VF a = VLOAD(image + at), b = VLOAD(photograph + at);
                for (uint r = 0; r < RUN; r++) {
                    if (j - r > 2 * REACH)  // wraps to a large number
                        continue;
                    const VF wa = WINDOW[j - r] * a, wb = WINDOW[j - r] * b;
                    mx[r] += wa;
                    my[r] += wb;
                    xx[r] += wa * a;
                    yy[r] += wb * b;
                    xy[r] += wa * b;
                }
            }
        for (uint r = 0; r < RUN; r++) {
            VSTORE_LOCAL(mx[r], vertical[0][first + r] + v);
            VSTORE_LOCAL(my[r], vertical[1][first + r] + v);
            VSTORE_LOCAL(xx[r], vertical[2][first + r] + v);
            VSTORE_LOCAL(yy[r], vertical[3][first + r] + v);
            VSTORE_LOCAL(xy[r], vertical[4][first + r] + v);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    VF total = zero;
    for (uint part = item; part < ROWS * (COLUMNS / LANES); part += SSIM_TEAM) {
        const uint v = part % (COLUMNS / LANES) * LANES, row = part / (COLUMNS / LANES), y = top + row;
        if (y >= height || left + v >= stride)
            continue;
        VF mx = zero, my = zero, xx = zero, yy = zero, xy = zero;
        for (uint k = 0; k <= 2 * REACH; k++) {
            const uint at = v + MARGIN - REACH + k;
            mx += WINDOW[k] * VLOAD_LOCAL(vertical[0][row] + at);
            my += WINDOW[k] * VLOAD_LOCAL(vertical[1][row] + at);
            xx += WINDOW[k] * VLOAD_LOCAL(vertical[2][row] + at);
            yy += WINDOW[k] * VLOAD_LOCAL(vertical[3][row] + at);
            xy += WINDOW[k] * VLOAD_LOCAL(vertical[4][row] + at);
        }
        const VF a1 = 2.0f * mx * my + SSIM_C1, a2 = 2.0f * (xy - mx * my) + SSIM_C2;
        const VF b1 = mx * mx + my * my + SSIM_C1, b2 = (xx - mx * mx) + (yy - my * my) + SSIM_C2;
        const VF inside = inside_row(left + v, width);
        const VF inverse = inside / (b1 * b2);
        const VF m = a1 * a2 * inverse;
        const uint at = channel * plane + y * stride + left + v;
        VSTORE(2.0f * my * (a2 - a1) * inverse - 2.0f * mx * m * (1.0f / b1 - 1.0f / b2), maps + at);
        VSTORE(-m / b2, maps + 3 * plane + at);
        VSTORE(2.0f * a1 * inverse, maps + 6 * plane + at);
        total += m;
    }
    sums[item] = sum_lanes(total);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0)
        block_sums[block_index(channel)] = sum_team(sums);
}

/* gradient (+)= l1 sign(x - y) + scale (W * d_mean + 2 x (W * d_variance) + y (W * d_covariance)), W * the window.
 * Local memory: ROWS * SPAN * 12 bytes + SSIM_TEAM * 4. */
__kernel __attribute__((reqd_work_group_size(SSIM_TEAM, 1, 1)))
void ssim_gradient(
    __global const float *restrict maps,        // [3,3,H',stride]
    __global const float *restrict image,       // [3,H',stride]
    __global const float *restrict photograph,  // [3,H',stride]
    __global float *restrict gradient,          // [3,H',stride]
    __global float *restrict absolute_sums,     // [3,blocks] sums of |x - y|, if `has_l1`
    const float scale,                          // -weight / values in the image, for 1 - mean SSIM
    const float l1,                             // weight / values in the image
    const uint has_l1,
    const uint accumulate,                      // 0: overwrite the gradient
    const uint width,
    const uint height,
    const uint rows,                            // H'
    const uint stride)
{
    __local float vertical[3][ROWS][SPAN];
    __local float sums[SSIM_TEAM];
    const uint item = get_local_id(0), channel = get_group_id(2);
    const uint plane = rows * stride, left = get_group_id(0) * COLUMNS, top = get_group_id(1) * ROWS;
    const VF zero = (VF)(0.0f);
    for (uint part = item; part < ROWS / RUN * (SPAN / LANES); part += SSIM_TEAM) {
        const uint v = part % (SPAN / LANES) * LANES, first = part / (SPAN / LANES) * RUN;
        const uint x = left + v - MARGIN;
        VF mean[RUN], variance[RUN], covariance[RUN];
        for (uint r = 0; r < RUN; r++)
            mean[r] = variance[r] = covariance[r] = zero;
        if (x < stride)
            for (uint j = 0; j < RUN + 2 * REACH; j++) {
                const uint row = top + first + j - REACH;
                if (row >= height)
                    continue;
                const uint at = channel * plane + row * stride + x;
                const VF a = VLOAD(maps + at), b = VLOAD(maps + 3 * plane + at), c = VLOAD(maps + 6 * plane + at);
                for (uint r = 0; r < RUN; r++) {
                    if (j - r > 2 * REACH)
                        continue;
                    mean[r] += WINDOW[j - r] * a;
                    variance[r] += WINDOW[j - r] * b;
                    covariance[r] += WINDOW[j - r] * c;
                }
            }
        for (uint r = 0; r < RUN; r++) {
            VSTORE_LOCAL(mean[r], vertical[0][first + r] + v);
            VSTORE_LOCAL(variance[r], vertical[1][first + r] + v);
            VSTORE_LOCAL(covariance[r], vertical[2][first + r] + v);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    VF absolute = zero;
    for (uint part = item; part < ROWS * (COLUMNS / LANES); part += SSIM_TEAM) {
        const uint v = part % (COLUMNS / LANES) * LANES, row = part / (COLUMNS / LANES), y = top + row;
        if (y >= rows || left + v >= stride)
            continue;
        VF mean = zero, variance = zero, covariance = zero;
        for (uint k = 0; k <= 2 * REACH; k++) {
            const uint at = v + MARGIN - REACH + k;
            mean += WINDOW[k] * VLOAD_LOCAL(vertical[0][row] + at);
            variance += WINDOW[k] * VLOAD_LOCAL(vertical[1][row] + at);
            covariance += WINDOW[k] * VLOAD_LOCAL(vertical[2][row] + at);
        }
        const uint at = channel * plane + y * stride + left + v;
        const VF inside = inside_row(left + v, y < height ? width : 0);
        const VF a = VLOAD(image + at), b = VLOAD(photograph + at);
        VF before = accumulate ? VLOAD(gradient + at) : zero;
        if (has_l1) {
            const VF difference = a - b, part_l1 = l1 * inside;
            before += difference > 0.0f ? part_l1 : (difference < 0.0f ? -part_l1 : zero);
            absolute += magnitude(difference) * inside;
        }
        const VF g = (scale * inside) * (mean + 2.0f * a * variance + b * covariance);
        VSTORE((accumulate | has_l1 ? before + g : g), gradient + at);
    }
    sums[item] = sum_lanes(absolute);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (has_l1 && item == 0)
        absolute_sums[block_index(channel)] = sum_team(sums);
}
