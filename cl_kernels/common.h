/* Definitions for all kernels: the names that the host may set with -D, the constants of the method, the camera.
 *
 * Letters in comments: N Gaussians, S stride of the planes (capacity, a multiple of 64), P (tile, Gaussian) pairs,
 * T tiles, H, W image, K spherical harmonics coefficients. */
#ifndef CLSPLAT_COMMON_H
#define CLSPLAT_COMMON_H

/* ---- names that the host may set; nothing else is passed with -D ---- */
#ifndef LANES
#define LANES 16  // Gaussians or pixels per item: 16 or 8 on CPUs, 1 on GPUs
#endif
#ifndef VECTORS
#define VECTORS 1  // vectors of LANES Gaussians that one item updates together: 4 on CPUs
#endif
#ifndef GROUP
#define GROUP 64  // items per work-group of one-dimensional kernels
#endif
#ifndef TILE
#define TILE 16  // pixels per tile side
#endif
#ifndef TEAM
#define TEAM 1  // items of a work-group in scans, sorts and losses: 1 on CPUs
#endif
#ifndef DIGIT_BITS
#define DIGIT_BITS 11  // widest radix digit: its table is TEAM << DIGIT_BITS counters of local memory
#endif
#ifndef COUNT_TILES
#define COUNT_TILES 0  // 1: the pairs of each tile are counted as they are listed, for the bitonic sort
#endif
#ifndef BITONIC_GROUP
#define BITONIC_GROUP 128  // items that sort a run in the bitonic sort
#endif
#ifndef SORT_CAPACITY
#define SORT_CAPACITY 1024  // pairs of a run that the bitonic sort holds in local memory, 8 bytes each
#endif
#ifndef BUCKET
#define BUCKET 512  // pairs of a tile that one group of the backward pass takes in simt: a multiple of TILE * TILE
#endif
#ifndef PIXEL_SUMS
#define PIXEL_SUMS 9  // sums in a gradient record (splat.h): 11, 13 or 15 if a density statistic needs more
#endif
#ifndef PIXEL_BOX
#define PIXEL_BOX 0  // 1: a splat is integrated over the box of each pixel (pixel_box.h)
#endif
#ifndef SH_SLOTS
#define SH_SLOTS 0  // 1: harmonics are in slots that the host fills for each view (slots.h)
#endif
#ifndef INVERSE_DEPTH
#define INVERSE_DEPTH 0  // 1: the image has a fourth plane, the blended inverse depth (splat.h)
#endif
#ifndef MEDIAN_DEPTH
#define MEDIAN_DEPTH 0  // 1: red is the depth of each splat, and the third plane is the median depth (splat.h)
#endif
#ifndef GRAD_BEHIND
#define GRAD_BEHIND 0  // 1: the loss depends on the transmittance of a pixel in addition to its color (splat.h)
#endif

/* ---- constants of the method (Kerbl et al. 2023); tests change the first three to make blending smooth ---- */
#ifndef ALPHA_MIN
#define ALPHA_MIN (1.0f / 255.0f)  // fainter contributions are skipped, since they do not change an 8-bit image
#endif
#ifndef ALPHA_MAX
#define ALPHA_MAX 0.99f  // keeps 1 - alpha >= 0.01, so that dividing by it is safe
#endif
#ifndef TRANSMITTANCE_MIN
#define TRANSMITTANCE_MIN 1.0e-4f  // a pixel is finished when the next splat would leave less
#endif
#define POWER_MIN (-80.0f)      // exp_power is valid from here to 0
#define DEPTH_MAX 1.0e10f       // scene units; also rejects infinities
#define QUAT_NORM2_MIN 1.0e-12f // shorter quaternions have no direction
#define RAY_MARGIN 0.3f         // rays are clamped 30 % beyond the image: the linear projection fails further out
#define LAMBDA_FLOOR 0.1f       // px^2, under the root of the 3-sigma radius
#define EXTENT_SLACK 0.02f      // added to the squared radius of a splat: rounding never cuts a visible pixel

#define RECORD 16  // floats per splat record and per gradient record: one 64-byte line

typedef struct {
    float world_to_camera[12];  // row-major [3,4]
    float position[3];          // scene units
    float fx, fy, cx, cy;       // px
    float ray_x_min, ray_x_max, ray_y_min, ray_y_max;  // limits of x/z and y/z in the linearized projection
    uint width, height;         // px
    uint tiles_x, tiles_y;
} camera_t;

#endif
