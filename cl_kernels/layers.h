/* The layout of a network's layers in memory.
 *
 * Samples come in tiles of SAMPLES: a table of R features of S samples is [S / SAMPLES, R, SAMPLES].  A tile of 128
 * features is 32 KB, which stays in a cache while all outputs of it are computed.  One item computes a block of BLOCK
 * outputs for BLOCK vectors of LANES samples: 16 sums in registers for every 4 + 4 values that it reads. */
#ifndef CLSPLAT_LAYERS_H
#define CLSPLAT_LAYERS_H
#include "lanes.h"

#define SAMPLES 64         // samples in a tile
#define BLOCK 4            // outputs of an item; inputs and outputs of a layer are multiples of it
#define CHUNK 16           // tiles whose gradients are summed together
#define PARAMETER_LINE 64  // the parameters of a network are a multiple of it

#define COLUMNS (SAMPLES / (BLOCK * LANES))  // items that share a tile and a block of outputs

/* sums[output * BLOCK + vector] += weight * value over `count` rows of values.  values: the first of the item in
 * its row; weights of output k start at weights + k * by_output, by_row apart.  The sums are read
 * into variables of the function: some compilers keep an array that a loop indexes in memory. */
static inline void multiply_rows(VF *sums, __global const float *values, __global const float *weights,
                                 const uint by_output, const uint by_row, const uint count)
{
    VF a0 = sums[0], a1 = sums[1], a2 = sums[2], a3 = sums[3], b0 = sums[4], b1 = sums[5], b2 = sums[6], b3 = sums[7];
    VF c0 = sums[8], c1 = sums[9], c2 = sums[10], c3 = sums[11];
    VF d0 = sums[12], d1 = sums[13], d2 = sums[14], d3 = sums[15];
    for (uint row = 0; row < count; row++) {
        __global const float *v = values + row * SAMPLES, *w = weights + row * by_row;
        const VF v0 = VLOAD(v), v1 = VLOAD(v + COLUMNS * LANES);
        const VF v2 = VLOAD(v + 2 * COLUMNS * LANES), v3 = VLOAD(v + 3 * COLUMNS * LANES);
        const float wa = w[0], wb = w[by_output], wc = w[2 * by_output], wd = w[3 * by_output];
        a0 = wa * v0 + a0;
        a1 = wa * v1 + a1;
        a2 = wa * v2 + a2;
        a3 = wa * v3 + a3;
        b0 = wb * v0 + b0;
        b1 = wb * v1 + b1;
        b2 = wb * v2 + b2;
        b3 = wb * v3 + b3;
        c0 = wc * v0 + c0;
        c1 = wc * v1 + c1;
        c2 = wc * v2 + c2;
        c3 = wc * v3 + c3;
        d0 = wd * v0 + d0;
        d1 = wd * v1 + d1;
        d2 = wd * v2 + d2;
        d3 = wd * v3 + d3;
    }
    const VF totals[BLOCK * BLOCK] = {a0, a1, a2, a3, b0, b1, b2, b3, c0, c1, c2, c3, d0, d1, d2, d3};
    for (uint k = 0; k < BLOCK * BLOCK; k++)
        sums[k] = totals[k];
}

/* sums[k * BLOCK + m] += x[k] * y[m] for BLOCK rows of each, over the samples of some tiles; x_step, y_step: values
 * from one tile to the next. */
static inline void multiply_samples(VF *sums, __global const float *x, __global const float *y, const uint x_step,
                                    const uint y_step, const uint tiles)
{
    VF a0 = sums[0], a1 = sums[1], a2 = sums[2], a3 = sums[3], b0 = sums[4], b1 = sums[5], b2 = sums[6], b3 = sums[7];
    VF c0 = sums[8], c1 = sums[9], c2 = sums[10], c3 = sums[11];
    VF d0 = sums[12], d1 = sums[13], d2 = sums[14], d3 = sums[15];
    for (uint tile = 0; tile < tiles; tile++, x += x_step, y += y_step)
        for (uint at = 0; at < SAMPLES; at += LANES) {
            const VF y0 = VLOAD(y + at), y1 = VLOAD(y + SAMPLES + at);
            const VF y2 = VLOAD(y + 2 * SAMPLES + at), y3 = VLOAD(y + 3 * SAMPLES + at);
            const VF xa = VLOAD(x + at), xb = VLOAD(x + SAMPLES + at);
            const VF xc = VLOAD(x + 2 * SAMPLES + at), xd = VLOAD(x + 3 * SAMPLES + at);
            a0 = xa * y0 + a0;
            a1 = xa * y1 + a1;
            a2 = xa * y2 + a2;
            a3 = xa * y3 + a3;
            b0 = xb * y0 + b0;
            b1 = xb * y1 + b1;
            b2 = xb * y2 + b2;
            b3 = xb * y3 + b3;
            c0 = xc * y0 + c0;
            c1 = xc * y1 + c1;
            c2 = xc * y2 + c2;
            c3 = xc * y3 + c3;
            d0 = xd * y0 + d0;
            d1 = xd * y1 + d1;
            d2 = xd * y2 + d2;
            d3 = xd * y3 + d3;
        }
    const VF totals[BLOCK * BLOCK] = {a0, a1, a2, a3, b0, b1, b2, b3, c0, c1, c2, c3, d0, d1, d2, d3};
    for (uint k = 0; k < BLOCK * BLOCK; k++)
        sums[k] = totals[k];
}

/* Index of a value: feature `row` of sample `sample`, of a table with `rows` features. */
static inline uint feature_at(const uint sample, const uint row, const uint rows)
{
    return (sample / SAMPLES * rows + row) * SAMPLES + sample % SAMPLES;
}

#endif
