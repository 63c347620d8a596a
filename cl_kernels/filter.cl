/* World filter: a variance, in scene units^2, from the sampling of the training views (Yu et al. 2024, section 5.1).
 *
 * A camera of focal length f, px, at depth z, scene units, takes one sample every z / f scene units.  The smallest such
 * interval over the cameras that see a Gaussian bounds its frequencies; its filter is `variance` times that interval^2.
 * One item = LANES Gaussians.  No local memory.  Deterministic: a maximum does not depend on the order. */
#include "lanes.h"

#define VIEW_MARGIN 0.15f  // fraction of the image size beyond its edges that still counts as seen

/* Smallest sampling interval of each Gaussian, 0 where no camera sees it, and the bits of the largest interval. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sampling_interval(
    __global const float *restrict means,       // [3,S] scene units
    __global const camera_t *restrict cameras,  // [V]
    __global const float *restrict focal,       // [V] px
    __global float *restrict interval,          // [S] scene units
    __global uint *restrict largest,            // [1] bits of a float; starts at 0
    const float near_plane,                     // scene units
    const uint views,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VF px = VLOAD(means + i), py = VLOAD(means + stride + i), pz = VLOAD(means + 2 * stride + i);
    VF smallest = (VF)(DEPTH_MAX);
    for (uint view = 0; view < views; view++) {
        __global const camera_t *camera = cameras + view;
        __global const float *w = camera->world_to_camera;
        const VF x = w[0] * px + w[1] * py + w[2] * pz + w[3];
        const VF y = w[4] * px + w[5] * py + w[6] * pz + w[7];
        const VF z = w[8] * px + w[9] * py + w[10] * pz + w[11];
        const float width = camera->width, height = camera->height;
        /* without the division by z: u + margin >= 0 is fx x + (cx + margin) z >= 0 where z > 0 */
        const VF u = camera->fx * x, v = camera->fy * y;
        const VI sees = (z > near_plane) &
                        (u + (camera->cx + VIEW_MARGIN * width) * z >= 0.0f) &
                        (u + (camera->cx - (1.0f + VIEW_MARGIN) * width) * z <= 0.0f) &
                        (v + (camera->cy + VIEW_MARGIN * height) * z >= 0.0f) &
                        (v + (camera->cy - (1.0f + VIEW_MARGIN) * height) * z <= 0.0f);
        const VF step = z * (1.0f / focal[view]);
        smallest = sees ? smaller(smallest, step) : smallest;
    }
    const VI seen = (smallest < DEPTH_MAX) & ((LANE_INDEX + (int)i) < (int)count);
    float lanes[LANES], lane_max = 0.0f;
    VSTORE_PRIVATE((seen ? smallest : (VF)(0.0f)), lanes);
    for (uint lane = 0; lane < LANES; lane++)
        lane_max = lanes[lane] > lane_max ? lanes[lane] : lane_max;
    VSTORE(VLOAD_PRIVATE(lanes), interval + i);
    atomic_max(largest, as_uint(lane_max));  // positive floats have the order of their bits
}

/* Convert intervals to variances; Gaussians that no camera sees get the largest interval. */
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void filter_variance(
    __global const uint *restrict largest,  // [1] bits of a float
    __global float *restrict interval,      // [S] scene units; afterwards the variance, scene units^2
    const float variance,                   // in intervals^2
    const uint count)
{
    const uint i = get_global_id(0) * LANES;
    if (i >= count)
        return;
    const VF smallest = VLOAD(interval + i);
    const VF sampled = smallest > 0.0f ? smallest : (VF)(as_float(*largest));
    VSTORE(variance * sampled * sampled, interval + i);
}
