/* Shape of a Gaussian: quaternion and scales -> screen covariance, and its reverse.
 *
 * M = R(q/|q|) diag(s'), s'^2 = s^2 + filter variance; T = J W (2x3); V = T M; covariance = V V^T.  The Gram form keeps
 * the covariance positive in float32, and its determinant is |V0 x V1|^2, without cancellation. */
#ifndef CLSPLAT_GAUSSIAN_H
#define CLSPLAT_GAUSSIAN_H
#include "lanes.h"

/* Rotation matrix, row-major [9], of the unit quaternion (w, x, y, z). */
static inline void rotation_of(const VF *q, VF *r)
{
    const VF w = q[0], x = q[1], y = q[2], z = q[3];
    r[0] = 1.0f - 2.0f * (y * y + z * z);
    r[1] = 2.0f * (x * y - w * z);
    r[2] = 2.0f * (x * z + w * y);
    r[3] = 2.0f * (x * y + w * z);
    r[4] = 1.0f - 2.0f * (x * x + z * z);
    r[5] = 2.0f * (y * z - w * x);
    r[6] = 2.0f * (x * z - w * y);
    r[7] = 2.0f * (y * z + w * x);
    r[8] = 1.0f - 2.0f * (x * x + y * y);
}

/* Gradient of the unnormalized quaternion from that of the rotation matrix: chain through rotation_of and q/|q|. */
static inline void rotation_backward(const VF *q, const VF inverse_norm, const VF *h, VF *grad)
{
    const VF w = q[0], x = q[1], y = q[2], z = q[3];
    const VF gw = 2.0f * (z * (h[3] - h[1]) + y * (h[2] - h[6]) + x * (h[7] - h[5]));
    const VF gx = 2.0f * (y * (h[1] + h[3]) + z * (h[2] + h[6]) + w * (h[7] - h[5]) - 2.0f * x * (h[4] + h[8]));
    const VF gy = 2.0f * (x * (h[1] + h[3]) + z * (h[5] + h[7]) + w * (h[2] - h[6]) - 2.0f * y * (h[0] + h[8]));
    const VF gz = 2.0f * (x * (h[2] + h[6]) + y * (h[5] + h[7]) + w * (h[3] - h[1]) - 2.0f * z * (h[0] + h[4]));
    const VF along = w * gw + x * gx + y * gy + z * gz;
    grad[0] = (gw - w * along) * inverse_norm;
    grad[1] = (gx - x * along) * inverse_norm;
    grad[2] = (gy - y * along) * inverse_norm;
    grad[3] = (gz - z * along) * inverse_norm;
}

static inline void cross_product(const VF *a, const VF *b, VF *product)
{
    product[0] = a[1] * b[2] - a[2] * b[1];
    product[1] = a[2] * b[0] - a[0] * b[2];
    product[2] = a[0] * b[1] - a[1] * b[0];
}

/* All values between a Gaussian's parameters and its screen ellipse, which both passes compute. */
typedef struct {
    VI valid;                 // in front of the near plane, with a direction and a shape
    VF x, y, z, inverse_z;    // mean in camera space, scene units
    VF ray_x, ray_y;          // x/z and y/z, clamped to the camera's limits
    VI free_x, free_y;        // the clamp is not active
    VF unit[4], inverse_norm; // q/|q|, 1/|q|
    VF rotation[9];
    VF filter;                // variance of the world filter, scene units^2
    VF scale2[3];             // s^2, before the world filter
    VF filtered[3];           // s' after it
    VF t[6];                  // J W, row-major [2,3]
    VF v[6];                  // T M, row-major [2,3]
    VF xx, xy, yy;            // covariance before the screen filter, px^2
    VF determinant;           // of the covariance after the screen filter
    VF ratio;                 // determinant before / after the screen filter
    VF conic_xx, conic_xy, conic_yy;  // inverse covariance after the screen filter, px^-2
    VF energy;                // factor on the opacity that conserves energy under the two filters
} shape_t;

/* The result is written to an address: Oclgrind 21.10 does not support inlined functions that return a structure. */
static inline void shape_of(
    __global const float *means,            // [3,S] scene units
    __global const float *quats,            // [4,S] unnormalized
    __global const float *log_scales,       // [3,S] log of scene units
    __global const float *filter_variance,  // [S] scene units^2
    __constant camera_t *camera,
    const float near_plane, const float screen_variance, const float compensate, const uint stride, const uint i,
    shape_t *shape)
{
    __constant const float *w = camera->world_to_camera;
    shape_t s;
    const VF px = VLOAD(means + i), py = VLOAD(means + stride + i), pz = VLOAD(means + 2 * stride + i);
    s.x = w[0] * px + w[1] * py + w[2] * pz + w[3];
    s.y = w[4] * px + w[5] * py + w[6] * pz + w[7];
    s.z = w[8] * px + w[9] * py + w[10] * pz + w[11];
    s.valid = (s.z >= near_plane) & (s.z <= DEPTH_MAX);  // false for NaN
    s.inverse_z = 1.0f / s.z;

    const VF rx = s.x * s.inverse_z, ry = s.y * s.inverse_z;
    s.ray_x = smaller(larger(rx, (VF)(camera->ray_x_min)), (VF)(camera->ray_x_max));
    s.ray_y = smaller(larger(ry, (VF)(camera->ray_y_min)), (VF)(camera->ray_y_max));
    s.free_x = s.ray_x == rx;
    s.free_y = s.ray_y == ry;

    VF norm2 = (VF)(0.0f);
    for (uint k = 0; k < 4; k++) {
        s.unit[k] = VLOAD(quats + k * stride + i);
        norm2 = norm2 + s.unit[k] * s.unit[k];
    }
    s.valid = s.valid & (norm2 >= QUAT_NORM2_MIN);
    s.inverse_norm = 1.0f / sqrt(norm2);
    for (uint k = 0; k < 4; k++)
        s.unit[k] = s.unit[k] * s.inverse_norm;
    rotation_of(s.unit, s.rotation);

    s.filter = VLOAD(filter_variance + i);
    VF energy2 = (VF)(1.0f);
    for (uint k = 0; k < 3; k++) {
        const VF scale = exp_clamped(VLOAD(log_scales + k * stride + i));
        s.scale2[k] = scale * scale;
        s.filtered[k] = sqrt(s.scale2[k] + s.filter);
        energy2 = energy2 * (s.scale2[k] / (s.scale2[k] + s.filter));
    }

    /* J W: the rows of J are (fx/z, 0, -fx ray_x/z) and (0, fy/z, -fy ray_y/z) */
    const VF jx = camera->fx * s.inverse_z, jy = camera->fy * s.inverse_z;
    for (uint k = 0; k < 3; k++) {
        s.t[k] = jx * (w[k] - s.ray_x * w[8 + k]);
        s.t[3 + k] = jy * (w[4 + k] - s.ray_y * w[8 + k]);
    }
    for (uint row = 0; row < 2; row++)
        for (uint k = 0; k < 3; k++)
            s.v[3 * row + k] = (s.t[3 * row] * s.rotation[k] + s.t[3 * row + 1] * s.rotation[3 + k] +
                                s.t[3 * row + 2] * s.rotation[6 + k]) * s.filtered[k];

    s.xx = s.v[0] * s.v[0] + s.v[1] * s.v[1] + s.v[2] * s.v[2];
    s.xy = s.v[0] * s.v[3] + s.v[1] * s.v[4] + s.v[2] * s.v[5];
    s.yy = s.v[3] * s.v[3] + s.v[4] * s.v[4] + s.v[5] * s.v[5];
    VF normal[3];
    cross_product(s.v, s.v + 3, normal);
    const VF determinant0 = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
    s.determinant = determinant0 + screen_variance * (s.xx + s.yy + screen_variance);
    s.valid = s.valid & (s.determinant > 0.0f) & (s.determinant < INFINITY);
    s.ratio = determinant0 / s.determinant;
    s.conic_xx = (s.yy + screen_variance) / s.determinant;
    s.conic_xy = -s.xy / s.determinant;
    s.conic_yy = (s.xx + screen_variance) / s.determinant;
    s.energy = sqrt(energy2 * (1.0f + compensate * (s.ratio - 1.0f)));
    *shape = s;
}

#endif
