/* Dense layers of a network, forward and backward, as matrix products on tiles of samples (layers.h):
 *
 *   forward   y = larger(b + W^T x, lower_bound)         lower_bound: 0 for a ReLU, -FLT_MAX for none
 *   backward  dL/dx = W dL/dy, 0 where x <= lower_bound  dL/dW = sum over samples of x dL/dy^T,  dL/db of dL/dy
 *
 * A weight is at [input, output].  Each sum has a fixed order: over rows, or over the samples of CHUNK tiles and then
 * over chunks.  So there are no atomics, and results do not depend on the number of threads.  No local memory. */
#include "adam.h"
#include "layers.h"

/* One item = BLOCK outputs of BLOCK vectors of samples; the outputs of a tile are consecutive. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void dense_forward(
    __global const float *restrict inputs,      // [T,input_rows,SAMPLES]
    __global const float *restrict parameters,  // [P] at first_parameter: weights [input_count,output_count], biases
    __global float *restrict outputs,           // [T,output_rows,SAMPLES]
    const uint first_parameter,
    const uint input_rows,
    const uint first_input,
    const uint input_count,
    const uint output_rows,
    const uint output_count,
    const float lower_bound,
    const uint count)                           // items: T * COLUMNS * output_count / BLOCK
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint blocks = output_count / BLOCK, column = i % COLUMNS * LANES;
    const uint output = i / COLUMNS % blocks * BLOCK, tile = i / (COLUMNS * blocks);
    __global const float *weights = parameters + first_parameter + output;
    __global const float *biases = weights + input_count * output_count;
    VF sums[BLOCK * BLOCK];
    for (uint k = 0; k < BLOCK; k++)
        for (uint v = 0; v < BLOCK; v++)
            sums[k * BLOCK + v] = (VF)(biases[k]);
    multiply_rows(sums, inputs + (tile * input_rows + first_input) * SAMPLES + column, weights, 1, output_count,
                  input_count);
    __global float *block = outputs + (tile * output_rows + output) * SAMPLES + column;
    for (uint k = 0; k < BLOCK; k++)
        for (uint v = 0; v < BLOCK; v++)
            VSTORE(larger(sums[k * BLOCK + v], (VF)(lower_bound)), block + k * SAMPLES + v * COLUMNS * LANES);
}

/* Gradients of derived_count inputs of a layer, in the rows of `inputs` from first_input on, whose weights start at
 * first_parameter.  accumulate: 1 to add to the existing values, before the gate; else 0.
 * One item = BLOCK inputs of BLOCK vectors of samples. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void dense_backward(
    __global const float *restrict grad_outputs,  // [T,output_rows,SAMPLES]
    __global const float *restrict parameters,    // [P] at first_parameter: weights [derived_count,output_count]
    __global const float *restrict inputs,        // [T,input_rows,SAMPLES]
    __global float *restrict grad_inputs,         // [T,derived_count,SAMPLES]
    const uint first_parameter,
    const uint input_rows,
    const uint first_input,
    const uint derived_count,
    const uint output_rows,
    const uint output_count,
    const float lower_bound,                      // inputs up to it have no gradient
    const uint accumulate,
    const uint count)                             // items: T * COLUMNS * derived_count / BLOCK
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint blocks = derived_count / BLOCK, column = i % COLUMNS * LANES;
    const uint input = i / COLUMNS % blocks * BLOCK, tile = i / (COLUMNS * blocks);
    __global float *block = grad_inputs + (tile * derived_count + input) * SAMPLES + column;
    __global const float *gate = inputs + (tile * input_rows + first_input + input) * SAMPLES + column;
    VF sums[BLOCK * BLOCK];
    for (uint k = 0; k < BLOCK; k++)
        for (uint v = 0; v < BLOCK; v++)
            sums[k * BLOCK + v] = accumulate ? VLOAD(block + k * SAMPLES + v * COLUMNS * LANES) : (VF)(0.0f);
    multiply_rows(sums, grad_outputs + tile * output_rows * SAMPLES + column,
                  parameters + first_parameter + input * output_count, output_count, 1, output_count);
    for (uint k = 0; k < BLOCK; k++)
        for (uint v = 0; v < BLOCK; v++) {
            const uint at = k * SAMPLES + v * COLUMNS * LANES;
            VSTORE((VLOAD(gate + at) <= lower_bound ? (VF)(0.0f) : sums[k * BLOCK + v]), block + at);
        }
}

/* Gradients of the weights of a layer: sums over the samples of a chunk of tiles.
 * One item = BLOCK inputs by BLOCK outputs of one chunk. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void dense_weights(
    __global const float *restrict inputs,      // [T,input_rows,SAMPLES]
    __global const float *restrict grad_outputs,  // [T,output_rows,SAMPLES]
    __global float *restrict partials,          // [chunks,P]
    const uint first_parameter,
    const uint parameter_count,                 // P
    const uint input_rows,
    const uint first_input,
    const uint input_count,
    const uint output_rows,
    const uint output_count,
    const uint tiles,                           // T
    const uint count)                           // items: chunks * input_count * output_count / BLOCK^2
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint output_blocks = output_count / BLOCK, input_blocks = input_count / BLOCK;
    const uint output = i % output_blocks * BLOCK, input = i / output_blocks % input_blocks * BLOCK;
    const uint chunk = i / (output_blocks * input_blocks);
    VF sums[BLOCK * BLOCK];
    for (uint k = 0; k < BLOCK; k++)
        for (uint m = 0; m < BLOCK; m++)
            sums[k * BLOCK + m] = (VF)(0.0f);
    const uint first = chunk * CHUNK, chunk_tiles = tiles - first < CHUNK ? tiles - first : CHUNK;
    multiply_samples(sums, inputs + (first * input_rows + first_input + input) * SAMPLES,
                     grad_outputs + (first * output_rows + output) * SAMPLES, input_rows * SAMPLES,
                     output_rows * SAMPLES,
                     chunk_tiles);
    __global float *block = partials + chunk * parameter_count + first_parameter + input * output_count + output;
    for (uint k = 0; k < BLOCK; k++)
        for (uint m = 0; m < BLOCK; m++)
            block[k * output_count + m] = sum_lanes(sums[k * BLOCK + m]);
}

/* Gradients of the biases of a layer: sums over the samples of a chunk of tiles.  One item = one output of one
 * chunk. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void dense_biases(
    __global const float *restrict grad_outputs,  // [T,output_rows,SAMPLES]
    __global float *restrict partials,          // [chunks,P]
    const uint first_parameter,                 // index of the first bias
    const uint parameter_count,                 // P
    const uint output_rows,
    const uint output_count,
    const uint tiles,                           // T
    const uint count)                           // items: chunks * output_count
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    const uint output = i % output_count, chunk = i / output_count;
    VF sum = (VF)(0.0f);
    for (uint tile = chunk * CHUNK; tile < (chunk + 1) * CHUNK && tile < tiles; tile++)
        for (uint at = 0; at < SAMPLES; at += LANES)
            sum += VLOAD(grad_outputs + (tile * output_rows + output) * SAMPLES + at);
    partials[chunk * parameter_count + first_parameter + output] = sum_lanes(sum);
}

/* Add the partial sums to the gradient, in the order of the chunks.  One item = LANES parameters. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void dense_sums(
    __global const float *restrict partials,  // [chunks,P]
    __global float *restrict gradient,        // [P]
    const uint chunks,
    const uint count)                         // P, a multiple of PARAMETER_LINE
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    VF sum = VLOAD(gradient + i);
    for (uint chunk = 0; chunk < chunks; chunk++)
        sum += VLOAD(partials + chunk * count + i);
    VSTORE(sum, gradient + i);
}

/* One update by Adam.  One item = LANES parameters. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void dense_update(
    __global float *restrict parameters,      // [P]
    __global float *restrict moment1,         // [P]
    __global float *restrict moment2,         // [P]
    __global const float *restrict gradient,  // [P]
    const float rate,                         // learning rate / (1 - BETA1^t)
    const float correction2,                  // 1 / (1 - BETA2^t)
    const float epsilon,                      // added to the root of the second moment
    const uint count)                         // P, a multiple of PARAMETER_LINE
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    adam_update(parameters + i, moment1 + i, moment2 + i, VLOAD(gradient + i), ALL_LANES, rate, correction2, epsilon);
}
