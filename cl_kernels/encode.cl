/* The inputs of a network for one sample: the integrated positional encoding of its conical frustum, and the encoding
 * of its viewing direction (Barron et al. 2021).
 *
 * A frustum is a normal distribution (frustum.h), and its features are the means of sin(2^l x) and cos(2^l x): the
 * sine and cosine of the mean, times exp(-4^l variance / 2) (equations 13 and 14).  Angles are in turns, so that
 * their integer part can be removed exactly.
 *
 * Features: sines of x, y, z for l = 0, 1, ...; then cosines; then zeros up to a multiple of BLOCK (layers.h).
 * One item = LANES samples of one ray.  No local memory. */
#include "frustum.h"
#include "layers.h"

#define FALL_MIN (-32.0f)  // e^x is 1e-14 there; such features are 0, since their gradients would be subnormal
#define TURN 0.159154943f  // 1 / (2 pi)

/* sin(2 pi x) for x in [-1/4, 1/4]: the Taylor polynomial of degree 13, error 1e-9 before rounding. */
static inline VF sine_of_turns(const VF x)
{
    const VF z = x * x;
    VF p = z * 3.8199526f - 15.094643f;
    p = p * z + 42.058693f;
    p = p * z - 76.705860f;
    p = p * z + 81.605249f;
    p = p * z - 41.341702f;
    p = p * z + 6.2831853f;
    return p * x;
}

/* Sine and cosine of an angle in turns; NaN if it is not finite. */
static inline void sine_and_cosine(const VF turns, VF *sine, VF *cosine)
{
    const VF part = turns - rint(turns), size = magnitude(part);
    const VF folded = size > 0.25f ? 0.5f - size : size;
    *sine = sine_of_turns(part < 0.0f ? -folded : folded);
    *cosine = sine_of_turns(0.25f - size);
}

/* Integrated positional encoding of samples. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void encode_frustums(
    __global const float *restrict cones,  // [rays,RAY_VALUES_READ]
    __global const float *restrict edges,  // [rays,samples + 1]
    __global float *restrict features,     // [T,rows,SAMPLES] from first_row on
    const uint samples,                    // samples of a ray: a multiple of LANES
    const uint degrees,
    const uint rows,
    const uint first_row,
    const uint written,                    // rows of the encoding, with those of zeros
    const uint count)                      // rays * samples
{
    const uint first = get_global_id(0) * LANES;
    if (first >= count)
        return;
    __global const float *cone = cones + first / samples * RAY_VALUES_READ;
    __global const float *t = edges + first / samples * (samples + 1) + first % samples;
    const frustum_t frustum = frustum_of(cone, VLOAD(t), VLOAD(t + 1));
    const uint at = feature_at(first, first_row, rows);
    for (uint axis = 0; axis < 3; axis++) {
        const float d = cone[3 + axis], d2 = d * d;
        const VF turns = (cone[axis] + d * frustum.distance) * TURN;
        VF fall = -0.5f * (d2 * frustum.along + (1.0f - d2 / (cone[7] * cone[7])) * frustum.across);
        float scale = 1.0f;
        for (uint l = 0; l < degrees; l++) {
            VF sine, cosine;
            sine_and_cosine(scale * turns, &sine, &cosine);
            const VF factor = fall < FALL_MIN ? (VF)(0.0f) : exp_clamped(fall);
            VSTORE(factor * sine, features + at + (3 * l + axis) * SAMPLES);
            VSTORE(factor * cosine, features + at + (3 * (degrees + l) + axis) * SAMPLES);
            scale *= 2.0f;
            fall *= 4.0f;
        }
    }
    for (uint row = 6 * degrees; row < written; row++)
        VSTORE((VF)(0.0f), features + at + row * SAMPLES);
}

/* The direction of the ray, as in the released code, and its sines and cosines. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void encode_directions(
    __global const float *restrict cones,  // [rays,RAY_VALUES_READ]
    __global float *restrict features,     // [T,rows,SAMPLES] from first_row on
    const uint samples,                    // samples of a ray: a multiple of LANES
    const uint degrees,
    const uint rows,
    const uint first_row,
    const uint written,                    // rows of the encoding, with those of zeros
    const uint count)                      // rays * samples
{
    const uint first = get_global_id(0) * LANES;
    if (first >= count)
        return;
    __global const float *cone = cones + first / samples * RAY_VALUES_READ;
    const uint at = feature_at(first, first_row, rows);
    for (uint axis = 0; axis < 3; axis++) {
        const float d = cone[3 + axis] / cone[7];
        VSTORE((VF)(d), features + at + axis * SAMPLES);
        float scale = TURN;
        for (uint l = 0; l < degrees; l++) {
            VF sine, cosine;
            sine_and_cosine((VF)(d * scale), &sine, &cosine);
            VSTORE(sine, features + at + (3 + 3 * l + axis) * SAMPLES);
            VSTORE(cosine, features + at + (3 + 3 * (degrees + l) + axis) * SAMPLES);
            scale *= 2.0f;
        }
    }
    for (uint row = 3 + 6 * degrees; row < written; row++)
        VSTORE((VF)(0.0f), features + at + row * SAMPLES);
}
