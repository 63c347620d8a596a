/* Blending for GPUs: the formulas of splat.h, as in blend_wide.cl, with one item per pixel in the forward pass and one
 * item per splat in the backward pass.  Compiled with LANES = 1. */
#include "splat.h"

#define PIXELS (TILE * TILE)
#define BATCH PIXELS  // splats in local memory: each item loads one
#define STATE (4 + INVERSE_DEPTH)  // floats of a pixel in front of a bucket: transmittance, color, inverse depth
#if INVERSE_DEPTH
#define QUADS 4       // groups of four floats: the full splat record
#else
#define QUADS 3       // groups of four floats: the part of a splat record that blending reads
#endif

/* Load a record in aligned quads.  With three quads, the last field is SPLAT_POWER_MIN (BOX_TURNED with PIXEL_BOX)
 * instead of SPLAT_X_MIN, which blending does not read. */
static inline void load_quads(__global const float *splats, const uint splat, float4 *quads)
{
    __global const float4 *record = (__global const float4 *)splats + (size_t)splat * (RECORD / 4);
    for (uint k = 0; k < QUADS; k++)
        quads[k] = record[k];
#if QUADS == 3
    quads[QUADS - 1].w = record[SPLAT_POWER_MIN / 4].y;
#endif
}

static inline void unpack_quads(const float4 *quads, float *splat)
{
    for (uint k = 0; k < QUADS; k++)
        vstore4(quads[k], k, splat);
#if QUADS == 3
    splat[SPLAT_POWER_MIN] = quads[QUADS - 1].w;
#endif
}

#if PIXEL_BOX
#define SPLAT_AT(splat, row, pixel) splat_on_line(splat, row, pixel)

static inline row_splat_t splat_on_line(const float *splat, const float row, const float pixel)
{
    row_splat_t s = splat_at_pixels(splat, splat[BOX_TURNED] > 0.0f, row, pixel);
    line_of(splat, s.turned ? pixel : row, &s.line, &s.slopes);
    return s;
}
#else
#define SPLAT_AT(splat, row, pixel) splat_at_row(splat, row)
#endif

/* The number of the bucket that starts at pair `begin`, in a tile whose pairs start at `first`.  Later buckets of all
 * tiles have different numbers: pair n * BUCKET is in the tile of bucket n, at the bucket's start or shortly before. */
static inline size_t bucket_of(const uint first, const uint begin) { return first / BUCKET + (begin - first) / BUCKET; }

static inline void store_state(__global float *state, const pixels_t *p)
{
    state[0] = p->t;
    state[PIXELS] = p->red;
    state[2 * PIXELS] = p->green;
    state[3 * PIXELS] = p->blue;
#if INVERSE_DEPTH
    state[4 * PIXELS] = p->inverse_depth;
#endif
}

static inline void load_state(__global const float *state, pixels_t *p)
{
    p->t = state[0];
    p->red = state[PIXELS];
    p->green = state[2 * PIXELS];
    p->blue = state[3 * PIXELS];
#if INVERSE_DEPTH
    p->inverse_depth = state[4 * PIXELS];
#endif
}

/* One work-group = one tile, one item = one pixel.  Local memory: BATCH * QUADS * 16 + 4 bytes.  Deterministic. */
__kernel __attribute__((reqd_work_group_size(PIXELS, 1, 1)))
void blend_forward(
    __global const uint *restrict tile_offset,  // [T+1]
    __global const uint *restrict tile_pairs,   // [P] front to back inside a tile
    __global const uint *restrict pair_splat,   // [P]
    __global const float *restrict splats,      // [N,RECORD]
    __constant float *restrict background,      // [3]
    __constant camera_t *restrict camera,       // [1]
    __global float *restrict image,             // [3 + INVERSE_DEPTH,tiles_y*TILE,tiles_x*TILE]
    __global float *restrict transmittance,     // [tiles_y*TILE,tiles_x*TILE]
    __global uint *restrict tile_last,          // [T] pairs of the tile up to the last that any pixel blends
    __global uint *restrict bucket_tile,        // [capacity/BUCKET+1] tile of the pair at each multiple of BUCKET
    __global float *restrict states,            // [capacity/BUCKET+1,STATE,PIXELS] states in front of buckets
    const uint first_tile)                      // first tile of the launch
{
    __local float4 batch[BATCH][QUADS];
    __local uint open;  // pixels of the tile that are not finished
    const uint item = get_local_id(0), tile = first_tile + get_group_id(0);
    const uint tile_y = tile / camera->tiles_x, tile_x = tile - tile_y * camera->tiles_x;
    const uint column = tile_x * TILE + item % TILE, line = tile_y * TILE + item / TILE;
    const uint width = camera->tiles_x * TILE, plane = width * camera->tiles_y * TILE;
    const float pixel = column + 0.5f, row = line + 0.5f;
    const uint first = tile_offset[tile], end = tile_offset[tile + 1];

    for (uint bucket = (first + BUCKET - 1) / BUCKET + item; bucket * BUCKET < end; bucket += PIXELS)
        bucket_tile[bucket] = tile;
    pixels_t p = {1.0f, 0.0f, 0.0f, 0.0f};
    uint begin = first;
    bool unfinished = true;
    for (; begin < end && unfinished; begin += BATCH) {
        if (begin > first && (begin - first) % BUCKET == 0)
            store_state(states + bucket_of(first, begin) * (STATE * PIXELS) + item, &p);
        if (item == 0)
            open = 0;
        if (begin + item < end) {
            float4 quads[QUADS];
            load_quads(splats, pair_splat[tile_pairs[begin + item]], quads);
            for (uint k = 0; k < QUADS; k++)
                batch[item][k] = quads[k];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        const uint length = end - begin < BATCH ? end - begin : BATCH;
        /* a single condition: with two, a compiler used 40 registers instead of 32, and a quarter fewer groups fit */
        for (uint j = p.t > 0.0f ? 0 : BATCH; j < length; j = p.t > 0.0f ? j + 1 : BATCH) {
            float4 quads[QUADS];
            for (uint k = 0; k < QUADS; k++)
                quads[k] = batch[j][k];
            float splat[RECORD];
            unpack_quads(quads, splat);
            blend(&p, SPLAT_AT(splat, row, pixel), pixel, splat + SPLAT_RED);
        }
        if (p.t > 0.0f)
            atomic_inc(&open);
        barrier(CLK_LOCAL_MEM_FENCE);
        unfinished = open > 0;
        barrier(CLK_LOCAL_MEM_FENCE);
    }

    if (item == 0)
        tile_last[tile] = (begin < end ? begin : end) - first;
    const bool inside = (column < camera->width) & (line < camera->height);
    const uint at = line * width + column;
    const float t = magnitude(p.t);
    image[at] = inside ? p.red + t * background[0] : 0.0f;
    image[plane + at] = inside ? p.green + t * background[1] : 0.0f;
    image[2 * plane + at] = inside ? p.blue + t * background[2] : 0.0f;
    transmittance[at] = inside ? t : 0.0f;
#if INVERSE_DEPTH
    image[3 * plane + at] = inside ? p.inverse_depth : 0.0f;
#endif
}

static inline void write_sums(__global float *pair_sums, const uint pair, const pixel_sums_t *m)
{
#if INVERSE_DEPTH
    const float last = m->inverse_depth;
#else
    const float last = 0.0f;
#endif
    const float sums[RECORD] = {m->power, m->x, m->y, m->xx, m->xy, m->yy, m->red, m->green, m->blue,
                                m->abs_x, m->abs_y, m->weight, m->texture, m->blended, m->square, last};
    __global sums_part_t *record = (__global sums_part_t *)pair_sums + (size_t)pair * (RECORD / 4);
    for (uint k = 0; k < SUMS_PARTS; k++)
        record[k] = vload4(k, sums);
}

/* Find the first pair of a bucket, the end of its pairs, and the end of the pairs that a pixel may blend.  Bucket 0 is
 * the first bucket of each tile.  There are no pairs if the tile does not have the bucket. */
static inline void find_pairs(__global const uint *offset, const uint tile_last, const uint bucket, uint *first,
                              uint *last, uint *end)
{
    const uint start = offset[0], tile_end = offset[1], blended = start + tile_last;
    *first = start + (bucket > 0 ? (bucket - start / BUCKET) * BUCKET : 0);
    *end = tile_end < *first + BUCKET ? tile_end : *first + BUCKET;
    *last = blended < *first ? *first : blended < *end ? blended : *end;
    if (bucket > 0 && (*first == start || *first >= tile_end))
        *last = *end = *first;
}

/* One work-group = the first BUCKET pairs of a tile, or a later bucket, whose pixels start from the stored states, so
 * that the longest list does not delay the kernel.  Group end_tile + n - 1 takes bucket n, if it exists.
 *
 * One item owns one splat of a batch of PIXELS and adds up the tile's pixels one after another: at step s, item i
 * computes pixel s - i, which item i - 1 computed in the previous step, so that every pixel blends its splats front to
 * back.  After the last pixel, an item writes its sums and continues with its splat of the next batch, without
 * waiting.  No atomics, no sums across items.  Local memory, for each pixel: 72 bytes, 76 with a texture, 92 with
 * inverse depths, 96 with both.  Deterministic. */
__kernel __attribute__((reqd_work_group_size(PIXELS, 1, 1)))
void blend_backward(
    __global const uint *restrict tile_offset,  // [T+1]
    __global const uint *restrict tile_pairs,   // [P] front to back inside a tile
    __global const uint *restrict pair_splat,   // [P]
    __global const float *restrict splats,      // [N,RECORD]
    __constant camera_t *restrict camera,       // [1]
    __global const float *restrict image,       // [3 + INVERSE_DEPTH,tiles_y*TILE,tiles_x*TILE]
    __global const float *restrict grad_image,  // [3 + INVERSE_DEPTH,tiles_y*TILE,tiles_x*TILE]
    __global const float *restrict texture,     // [tiles_y*TILE,tiles_x*TILE] read where PIXEL_SUMS > SUM_WEIGHT
    __global const float *restrict behind,      // [tiles_y*TILE,tiles_x*TILE] T dL/dT, read where GRAD_BEHIND
    __global const uint *restrict tile_last,    // [T]
    __global float *restrict pair_sums,         // [P,RECORD] in emission order
    __global const uint *restrict bucket_tile,  // [capacity/BUCKET+1]
    __global const float *restrict states,      // [capacity/BUCKET+1,STATE,PIXELS]
    const uint first_tile,                      // first tile of the launch; from end_tile on, buckets
    const uint end_tile)
{
    __local grad_pixels_t pixels[PIXELS];
    __local float4 coming[PIXELS][QUADS];  // an item's splat of the next batch: only that item reads and writes it
    __local uint coming_pair[PIXELS];
    const uint item = get_local_id(0), group = first_tile + get_group_id(0);
    const uint bucket = group < end_tile ? 0 : group - end_tile + 1;
    const bool beyond = bucket * BUCKET >= tile_offset[camera->tiles_x * camera->tiles_y];
    const uint tile = bucket == 0 ? group : beyond ? 0 : bucket_tile[bucket];
    uint first, last, end;
    find_pairs(tile_offset + tile, tile_last[tile], bucket, &first, &last, &end);
    const uint tile_y = tile / camera->tiles_x, tile_x = tile - tile_y * camera->tiles_x;
    const uint width = camera->tiles_x * TILE, plane = width * camera->tiles_y * TILE;
    const uint at = (tile_y * TILE + item / TILE) * width + tile_x * TILE + item % TILE;
    pixels_t in_front = {1.0f, 0.0f, 0.0f, 0.0f};
    if (bucket > 0 && first < last)
        load_state(states + (size_t)bucket * (STATE * PIXELS) + item, &in_front);
    grad_pixels_t own;
    own.t = in_front.t;
    own.red = grad_image[at];
    own.green = grad_image[plane + at];
    own.blue = grad_image[2 * plane + at];
    own.rest = own.red * (image[at] - in_front.red) + own.green * (image[plane + at] - in_front.green) +
               own.blue * (image[2 * plane + at] - in_front.blue);
#if GRAD_BEHIND
    own.rest = own.rest + behind[at];
#endif
#if PIXEL_SUMS > SUM_WEIGHT
    own.texture = texture[at];
#endif
#if INVERSE_DEPTH
    own.inverse_depth = grad_image[3 * plane + at];
    own.rest = own.rest + own.inverse_depth * (image[3 * plane + at] - in_front.inverse_depth);
#endif
    pixels[item] = own;
    barrier(CLK_LOCAL_MEM_FENCE);

    float splat[RECORD];
    pixel_sums_t m = {0.0f};
    uint pair = 0;
    bool active = false;
    for (uint begin = first; begin < last + PIXELS && first < last; begin += PIXELS) {
        if (begin + item < last) {
            const uint next = tile_pairs[begin + item];
            float4 quads[QUADS];
            load_quads(splats, pair_splat[next], quads);
            for (uint k = 0; k < QUADS; k++)
                coming[item][k] = quads[k];
            coming_pair[item] = next;
        }
        /* after the last batch, until its last splat has reached the last pixel */
        const uint steps = begin < last ? PIXELS : PIXELS - 1 - (begin - last);
        for (uint step = 0; step < steps; step++) {
            if (step == item) {
                active = begin + item < last;
                if (active) {
                    float4 quads[QUADS];
                    for (uint k = 0; k < QUADS; k++)
                        quads[k] = coming[item][k];
                    unpack_quads(quads, splat);
                    pair = coming_pair[item];
                    m = (pixel_sums_t){0.0f};
                }
            }
            if (active) {
                const uint i = (step - item) % PIXELS;
                const float pixel = tile_x * TILE + i % TILE + 0.5f, row = tile_y * TILE + i / TILE + 0.5f;
                grad_pixels_t p = pixels[i];
                blend_backward_step(&p, SPLAT_AT(splat, row, pixel), pixel, splat + SPLAT_RED, &m);
                pixels[i] = p;
                if (i == PIXELS - 1)
                    write_sums(pair_sums, pair, &m);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
    }
    m = (pixel_sums_t){0.0f};
    for (uint k = last + item; k < end; k += PIXELS)  // no pixel blends these
        write_sums(pair_sums, tile_pairs[k], &m);
}
