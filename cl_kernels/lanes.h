/* VF, VI and VB: a float, an int and a byte in each of LANES lanes.  One source serves CPUs, where an item computes 16
 * or 8 Gaussians or pixels, as many as the vector unit has lanes, and GPUs, where an item computes one.
 *
 * Comparisons give -1 in vectors and 1 in scalars, so masks are only combined with & and | and used as m ? a : b.
 * Inner loops use operators only: some CPU runtimes call built-in functions out of line. */
#ifndef CLSPLAT_LANES_H
#define CLSPLAT_LANES_H
#include "common.h"

#if LANES == 16
typedef float16 VF;
typedef int16 VI;
typedef uchar16 VB;
#define as_VF as_float16
#define as_VI as_int16
#define LANE_INDEX ((VI)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#define to_VF convert_float16
#elif LANES == 8
typedef float8 VF;
typedef int8 VI;
typedef uchar8 VB;
#define as_VF as_float8
#define as_VI as_int8
#define LANE_INDEX ((VI)(0, 1, 2, 3, 4, 5, 6, 7))
#define to_VF convert_float8
#else
typedef float VF;
typedef int VI;
typedef uchar VB;
#define as_VF as_float
#define as_VI as_int
#define LANE_INDEX 0
#define to_VF convert_float
#endif

/* Vectors in memory may start at any value.  They are read and written through an unaligned type instead of vload and
 * vstore, which some CPU runtimes call out of line or split into four parts. */
typedef VF __attribute__((aligned(4))) VF_in_memory;
typedef VI __attribute__((aligned(4))) VI_in_memory;
typedef VB __attribute__((aligned(1))) VB_in_memory;
#define VLOAD(pointer) (*(__global const VF_in_memory *)(pointer))
#define VSTORE(value, pointer) (*(__global VF_in_memory *)(pointer) = (value))
#define VLOAD_INT(pointer) (*(__global const VI_in_memory *)(pointer))
#define VSTORE_INT(value, pointer) (*(__global VI_in_memory *)(pointer) = (value))
#define VLOAD_BYTES(pointer) (*(__global const VB_in_memory *)(pointer))
#define VLOAD_LOCAL(pointer) (*(__local const VF_in_memory *)(pointer))
#define VSTORE_LOCAL(value, pointer) (*(__local VF_in_memory *)(pointer) = (value))
#define VLOAD_PRIVATE(pointer) (*(const VF_in_memory *)(pointer))
#define VSTORE_PRIVATE(value, pointer) (*(VF_in_memory *)(pointer) = (value))
#define VSTORE_INT_PRIVATE(value, pointer) (*(VI_in_memory *)(pointer) = (value))

#if LANES == 1
#define ANY(mask) (mask)
#define first_lane(v) (v)
#else
#define ANY(mask) any_lane(mask)
#define first_lane(v) ((v).s0)
#endif

#define ROUND_MAGIC 12582912.0f  // 1.5 * 2^23: after adding it, the low mantissa bits are the nearest integer
#define LOG2_E 1.44269504f
#define LN_2 0.693147181f

/* Whether a mask holds in any lane; the built-in functions may be called out of line. */
#if LANES == 16
static inline bool any_lane(const VI mask)
{
    const int8 a = mask.lo | mask.hi;
    const int4 b = a.lo | a.hi;
    const int2 c = b.lo | b.hi;
    return (c.x | c.y) < 0;
}
#elif LANES == 8
static inline bool any_lane(const VI mask)
{
    const int4 b = mask.lo | mask.hi;
    const int2 c = b.lo | b.hi;
    return (c.x | c.y) < 0;
}
#endif

/* Sum of the lanes, by halves: the same order on every device. */
#if LANES == 16
static inline float sum_lanes(const VF v)
{
    const float8 a = v.lo + v.hi;
    const float4 b = a.lo + a.hi;
    const float2 c = b.lo + b.hi;
    return c.x + c.y;
}
#elif LANES == 8
static inline float sum_lanes(const VF v)
{
    const float4 b = v.lo + v.hi;
    const float2 c = b.lo + b.hi;
    return c.x + c.y;
}
#else
static inline float sum_lanes(const VF v) { return v; }
#endif

/* Lane j of v[i] becomes lane i of v[j]: log2(LANES) perfect shuffles of the LANES vectors. */
static inline void transpose(VF *v)
{
#if LANES > 1
    for (uint round = 1; round < LANES; round *= 2) {
        VF shuffled[LANES];
        for (uint k = 0; k < LANES / 2; k++) {
            shuffled[2 * k].even = v[k].lo;
            shuffled[2 * k].odd = v[k + LANES / 2].lo;
            shuffled[2 * k + 1].even = v[k].hi;
            shuffled[2 * k + 1].odd = v[k + LANES / 2].hi;
        }
        for (uint k = 0; k < LANES; k++)
            v[k] = shuffled[k];
    }
#endif
}

/* The integer in each lane, for integral values below 2^22 in magnitude. */
static inline VI to_VI(VF whole) { return as_VI(whole + ROUND_MAGIC) - 0x4b400000; }

/* NaN in the first argument gives NaN. */
static inline VF larger(VF a, VF b) { return b > a ? b : a; }
static inline VF smaller(VF a, VF b) { return b < a ? b : a; }

static inline VF magnitude(VF v) { return as_VF(as_VI(v) & 0x7fffffff); }

/* e^x for x in [POWER_MIN, 80]: 2^n from the exponent bits, 2^f by a minimax polynomial on [-1/2, 1/2].
 * Relative error 3e-7 near 0, 1.3e-6 at the ends.  Outside the range the result is undefined. */
static inline VF exp_power(VF x)
{
    const VF t = x * LOG2_E + ROUND_MAGIC;
    const VF n = t - ROUND_MAGIC;
    const VF f = x * LOG2_E - n;
    VF p = f * 1.32765e-3f + 9.67554e-3f;
    p = p * f + 5.550713e-2f;
    p = p * f + 2.4022120e-1f;
    p = p * f + 6.9314697e-1f;
    p = p * f + 1.0f;
    return as_VF(as_VI(p) + (as_VI(t) << 23));
}

/* e^x with x clamped to [-80, 80]; NaN stays NaN. */
static inline VF exp_clamped(VF x)
{
    const VF e = exp_power(smaller(larger(x, (VF)(-80.0f)), (VF)(80.0f)));
    return x == x ? e : x;
}

/* ln x for finite x > 0 (normal numbers): exponent bits plus 2 atanh((m-1)/(m+1)) for m in [0.7, 1.4]. */
static inline VF log_positive(VF x)
{
    const VI bits = as_VI(x) - 0x3f3504f3;  // 0x3f3504f3 is sqrt(1/2): centers the mantissa on 1
    const VI exponent = bits >> 23;
    const VF m = as_VF((bits & 0x007fffff) + 0x3f3504f3);
    const VF e = as_VF(exponent + 0x4b400000) - ROUND_MAGIC;  // int to float without a conversion call
    const VF s = (m - 1.0f) / (m + 1.0f);
    const VF z = s * s;
    VF p = z * 0.23325634f + 0.28551073f;
    p = p * z + 0.40000118f;
    p = p * z + 0.66666667f;
    return e * LN_2 + (p * z * s + 2.0f * s);
}

static inline VF sigmoid(VF x) { return 1.0f / (1.0f + exp_clamped(-x)); }

#endif
