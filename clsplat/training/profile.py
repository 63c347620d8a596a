"""The time of a training step on the device, by stage."""

import time
from collections import defaultdict

from clsplat.opencl.timings import Timings

STAGES = {
    "project_forward": "project",
    "count_large": "pairs",
    "permute": "pairs",
    "emit_pairs": "pairs",
    "emit_large": "pairs",
    "find_tile_offsets": "pairs",
    "scan_blocks": "sort",
    "scan_offsets": "sort",
    "radix_count": "sort",
    "radix_scatter": "sort",
    "count_pairs": "sort",
    "fill_tiles": "sort",
    "sort_tiles": "sort",
    "blend_forward": "blend",
    "unpack_pixels": "loss",
    "pixel_loss": "loss",
    "ssim_maps": "loss",
    "ssim_gradient": "loss",
    "weight_entropy": "loss",
    "lay_over": "blend",
    "look_behind": "blend backward",
    "sky_matches": "loss",
    "sky_cover": "loss",
    "sky_forward": "blend",
    "sky_backward": "blend backward",
    "sky_gather": "sum records",
    "sky_update": "update",
    "apply_mask": "loss",
    "change_background": "loss",
    "measure_residuals": "loss",
    "mask_transients": "loss",
    "covariance_trace": "loss",
    "anisotropy": "loss",
    "blend_backward": "blend backward",
    "sum_records": "sum records",
    "project_backward": "update",
    "pose_gradient": "update",
    "adam_step": "update",
    "update_gaussians": "update",
    "replay_updates": "update",
    "note_update": "update",
    "count_seen": "statistics",
    "accumulate_norm": "statistics",
    "accumulate_error": "statistics",
    "accumulate_gain": "statistics",
    "view_error": "statistics",
    "sum_errors": "statistics",
    "accumulate_sum": "statistics",
    "accumulate_pixel_sum": "statistics",
    "accumulate_radius": "statistics",
    "accumulate_splitting": "statistics",
    "sample_magnitude": "statistics",
    "image_gradient": "statistics",
    "hide_masked": "statistics",
    "sampling_interval": "filter",
    "filter_variance": "filter",
    "draw_pixels": "cones",
    "cast_rays": "cones",
    "spread_edges": "cones",
    "resample_edges": "cones",
    "encode_frustums": "encode",
    "encode_directions": "encode",
    "grid_places": "encode",
    "grid_forward": "encode",
    "dense_forward": "network",
    "composite_forward": "colours of rays",
    "composite_backward": "colours of rays, backward",
    "dense_backward": "network backward",
    "dense_weights": "network, weights",
    "dense_biases": "network, weights",
    "dense_sums": "network, weights",
    "grid_backward": "grid backward",
    "dense_update": "update",
}
ORDER = tuple(dict.fromkeys(STAGES.values()))


def stage_milliseconds(timings: Timings, steps: int = 1) -> dict[str, float]:
    """Average milliseconds of each stage over the `steps` sampled since the last call, in the order of a step."""
    totals: dict[str, float] = defaultdict(float)
    for (label, section), seconds in timings.take().items():
        totals[STAGES.get(label.partition(":")[2], section)] += 1e3 * sum(seconds) / steps
    return {name: totals[name] for name in (*ORDER, "other") if name in totals}


def clocks() -> tuple[float, float]:
    """Return the time, and that of all threads of this process, in s."""
    return time.perf_counter(), time.process_time()
