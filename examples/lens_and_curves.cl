/* Camera response y = f(v c) of every pixel c, with the falloff v of the lens and a curve f for each channel; forward
 * and backward.
 *
 * v = 1 + a q + b q^2 + c q^3; q is the squared distance from a center, 1 at a corner of the image.
 * The slope of f is piecewise linear between NODES nodes from 0 to 1, and constant beyond them; f(0) = 0.
 * A fourth plane is copied.  Planes are [channels,H',W'] with H', W' whole tiles, zero outside the image.
 * One group of TEAM items = one row; each sum is written once.  Deterministic. */
#include "planes.h"

#define NODES 5
#define SUMS (5 + 3 * NODES)  // gradients of the center, of a, b, c, and of the slopes of each channel

/* Forward: the response to an image.  Backward: the gradient with respect to the image, from that with respect to the
 * response, and the row sums from which the parameters' gradient follows.  numbers: a, b, and c, then the slopes of
 * each channel; center: px; per_px: px^-1, the inverse of a corner's distance.  Local memory: TEAM * SUMS * 4 bytes. */
__kernel __attribute__((reqd_work_group_size(TEAM, 1, 1)))
void camera_response(
    __global const float *restrict image, __global const float *restrict gradient,  // [channels,H',stride] 3 or 4
    __global float *restrict out, __global float *restrict row_sums,  // [channels,H',stride]; [SUMS,H']
    __global const float *restrict numbers, const float center_x, const float center_y, const float per_px,  // [18]
    const uint back, const uint channels, const uint width, const uint height, const uint rows, const uint stride)
{
    __local float sums[SUMS][TEAM];
    const uint item = get_local_id(0), y = get_group_id(1), columns = y < height ? width : 0;
    const float dy = ((float)y + 0.5f - center_y) * per_px;
    VF total[SUMS] = {(VF)(0.0f)}, zero = (VF)(0.0f), one = (VF)(1.0f);
    for (uint x = item * LANES; x < stride; x += TEAM * LANES) {
        const VF dx = (to_VF(LANE_INDEX + (int)x) + 0.5f - center_x) * per_px, q = dx * dx + dy * dy;
        const VF falloff = one + q * (numbers[0] + q * (numbers[1] + q * numbers[2])), inside = inside_row(x, columns);
        VF grad_falloff = zero;
        for (uint i = 0; i < 3; i++) {
            const uint at = (i * rows + y) * stride + x, first = 3 + NODES * i;
            const VF c = VLOAD(image + at), light = falloff * c, passed = inside * VLOAD(gradient + at);
            const VF scaled = (float)(NODES - 1) * smaller(larger(light, zero), one);
            VF value = zero, slope = zero;
            for (uint k = 0; k < NODES; k++) {
                const VF t = smaller(larger(scaled - (float)k, -one), one), hat = one - magnitude(t);
                const VF beyond = k == 0 ? smaller(light, zero) : k == NODES - 1 ? larger(light - one, zero) : zero;
                const VF part = beyond + (0.5f * t * (one + hat) + (k > 0 ? 0.5f : 0.0f)) / (float)(NODES - 1);
                value += numbers[first + k] * part;
                slope += numbers[first + k] * hat;
                total[2 + first + k] += passed * part;
            }
            grad_falloff += passed * slope * c;
            VSTORE(back ? passed * slope * falloff : inside * value, out + at);
        }
        if (channels > 3)
            VSTORE(VLOAD((back ? gradient : image) + (3 * rows + y) * stride + x), out + (3 * rows + y) * stride + x);
        const VF grad_q = grad_falloff * (numbers[0] + q * (2.0f * numbers[1] + q * 3.0f * numbers[2]));
        total[0] -= 2.0f * dx * grad_q;
        total[1] -= 2.0f * dy * grad_q;
        for (uint k = 2; k < 5; k++)
            total[k] += grad_falloff *= q;
    }
    for (uint k = 0; k < SUMS; k++)
        sums[k][item] = sum_lanes(total[k]);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < SUMS; k += TEAM)
        row_sums[k * rows + y] = sum_items(sums[k]);
}
