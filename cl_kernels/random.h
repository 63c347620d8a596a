/* Counter-based random numbers: Philox 4x32-10 (Salmon et al. 2011).  A number depends only on (seed, step, Gaussian),
 * not on numbers drawn before, so a resumed run and any number of cores give the same bits. */
#ifndef CLSPLAT_RANDOM_H
#define CLSPLAT_RANDOM_H

static inline uint4 philox(const uint4 start, const uint2 start_key)
{
    uint4 c = start;
    uint2 key = start_key;
    for (uint round = 0; round < 10; round++) {
        const uint high0 = mul_hi(0xD2511F53u, c.x), low0 = 0xD2511F53u * c.x;
        const uint high1 = mul_hi(0xCD9E8D57u, c.z), low1 = 0xCD9E8D57u * c.z;
        c = (uint4)(high1 ^ c.y ^ key.x, low1, high0 ^ c.w ^ key.y, low0);
        key += (uint2)(0x9E3779B9u, 0xBB67AE85u);
    }
    return c;
}

/* (0, 1]: never zero, so that its logarithm is finite. */
static inline float unit_interval(const uint bits) { return ((bits >> 8) + 1u) * (1.0f / 16777216.0f); }

/* Three independent standard normal numbers (Box and Muller 1958). */
static inline float3 normal3(const uint4 counter, const uint2 key)
{
    const uint4 bits = philox(counter, key);
    const float radius = sqrt(-2.0f * log(unit_interval(bits.x)));
    const float angle = 6.28318531f * unit_interval(bits.y);
    const float third = sqrt(-2.0f * log(unit_interval(bits.z))) * cos(6.28318531f * unit_interval(bits.w));
    return (float3)(radius * cos(angle), radius * sin(angle), third);
}

#endif
