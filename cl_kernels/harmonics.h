/* Real spherical harmonics up to degree 3 in the sign convention of 3DGS: value and gradient.
 *
 * color = max(0, 1/2 + sum_k basis_k(d) sh_k), d the unit direction from the camera to the Gaussian. */
#ifndef CLSPLAT_HARMONICS_H
#define CLSPLAT_HARMONICS_H
#include "lanes.h"

#define SH_C0 0.28209479f
#define SH_C1 0.48860251f
#define SH_C2_XY 1.0925484f
#define SH_C2_ZZ 0.31539157f
#define SH_C2_XX 0.54627422f
#define SH_C3_0 0.59004359f
#define SH_C3_1 2.8906114f
#define SH_C3_2 0.45704580f
#define SH_C3_3 0.37317633f
#define SH_C3_5 1.4453057f

/* Values of the first (degree + 1)^2 basis functions. */
static inline void harmonics_basis(const uint degree, const VF x, const VF y, const VF z, VF *basis)
{
    basis[0] = (VF)(SH_C0);
    if (degree < 1)
        return;
    basis[1] = -SH_C1 * y;
    basis[2] = SH_C1 * z;
    basis[3] = -SH_C1 * x;
    if (degree < 2)
        return;
    const VF xx = x * x, yy = y * y, zz = z * z;
    basis[4] = SH_C2_XY * x * y;
    basis[5] = -SH_C2_XY * y * z;
    basis[6] = SH_C2_ZZ * (2.0f * zz - xx - yy);
    basis[7] = -SH_C2_XY * x * z;
    basis[8] = SH_C2_XX * (xx - yy);
    if (degree < 3)
        return;
    basis[9] = -SH_C3_0 * y * (3.0f * xx - yy);
    basis[10] = SH_C3_1 * x * y * z;
    basis[11] = -SH_C3_2 * y * (4.0f * zz - xx - yy);
    basis[12] = SH_C3_3 * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
    basis[13] = -SH_C3_2 * x * (4.0f * zz - xx - yy);
    basis[14] = SH_C3_5 * z * (xx - yy);
    basis[15] = -SH_C3_0 * x * (xx - 3.0f * yy);
}

/* Gradient of sum_k c_k basis_k(x, y, z), with x, y, z as independent variables. */
static inline void harmonics_direction_gradient(
    const uint degree, const VF x, const VF y, const VF z, const VF *c, VF *gx, VF *gy, VF *gz)
{
    if (degree < 1)
        return;
    *gx = -SH_C1 * c[3];
    *gy = -SH_C1 * c[1];
    *gz = SH_C1 * c[2];
    if (degree < 2)
        return;
    *gx += SH_C2_XY * (y * c[4] - z * c[7]) - 2.0f * SH_C2_ZZ * x * c[6] + 2.0f * SH_C2_XX * x * c[8];
    *gy += SH_C2_XY * (x * c[4] - z * c[5]) - 2.0f * SH_C2_ZZ * y * c[6] - 2.0f * SH_C2_XX * y * c[8];
    *gz += -SH_C2_XY * (y * c[5] + x * c[7]) + 4.0f * SH_C2_ZZ * z * c[6];
    if (degree < 3)
        return;
    const VF xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    *gx += -SH_C3_0 * (6.0f * xy * c[9] + 3.0f * (xx - yy) * c[15]) + SH_C3_1 * yz * c[10] +
           SH_C3_2 * (2.0f * xy * c[11] - (4.0f * zz - 3.0f * xx - yy) * c[13]) +
           (-6.0f * SH_C3_3 * c[12] + 2.0f * SH_C3_5 * c[14]) * xz;
    *gy += -SH_C3_0 * (3.0f * (xx - yy) * c[9] - 6.0f * xy * c[15]) + SH_C3_1 * xz * c[10] -
           SH_C3_2 * ((4.0f * zz - xx - 3.0f * yy) * c[11] - 2.0f * xy * c[13]) -
           (6.0f * SH_C3_3 * c[12] + 2.0f * SH_C3_5 * c[14]) * yz;
    *gz += SH_C3_1 * xy * c[10] - 8.0f * SH_C3_2 * (yz * c[11] + xz * c[13]) +
           3.0f * SH_C3_3 * (2.0f * zz - xx - yy) * c[12] + SH_C3_5 * (xx - yy) * c[14];
}

#endif
