"""One wrong constant or sign in any kernel is caught by the checks of `clsplat doctor`."""

import itertools
import re

import pytest

from clsplat.conformance.check import Check, Note
from clsplat.conformance.checks import BITONIC, ESSENTIAL_CHECKS, KERNELS, SPEED_CHECKS
from clsplat.core.resources import resource_dir
from clsplat.opencl import device as program
from clsplat.opencl.device import Device, parse_kernels
from clsplat.opencl.discovery import choose_device
from tests.support.devices import NAMES

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("cache_references")]  # most programs are built anew

FAULTS = {  # kernel -> file, text, wrong text
    "adam_step": ("adam.h", "EPSILON 1.0e-15f", "EPSILON 1.0e-5f"),
    "replay_updates": ("deferred.cl", "u = first; u < updates", "u = first + 1; u < updates"),
    "note_update": ("deferred.cl", "done[block] = update + 1", "done[block] = update"),
    "update_gaussians": ("adam.cl", "basis[0] * g[v].color", "basis[1] * g[v].color"),
    "blend_forward wide": ("blend_wide.cl", "(p.blue + t * background[2])", "(p.blue + t * background[1])"),
    "blend_backward wide": ("blend_wide.cl", "p.blue * VLOAD(image + 2 * plane", "p.blue * VLOAD(image + plane"),
    "blend_forward simt": ("blend_simt.cl", "? p.red + t * background[0]", "? p.red - t * background[0]"),
    "blend_backward simt": ("blend_simt.cl", "{m->power, m->x, m->y", "{m->power, -m->x, m->y"),
    "blur_rows": ("blur.cl", "column <= last", "column < last"),
    "blur_columns": ("blur.cl", "row <= last", "row < last"),
    "colors_forward": ("colors.cl", "br * r + bg * g + bb * b + b1, one", "br * r + bg * g + bb * b, one"),
    "colors_backward": ("colors.cl", "rg * passed_r + gg * passed_g", "rg * passed_r + gr * passed_g"),
    "color_grid_forward": ("color_grid.cl", "a[9] * g + a[10] * b + a[11]), one", "a[9] * g + a[10] * b), one"),
    "color_grid_backward": ("color_grid.cl", "a[5] * p[1] + a[9] * p[2]", "a[4] * p[1] + a[9] * p[2]"),
    "color_grid_row_sums": ("color_grid.cl", "total[4 * c + 1] += part * g", "total[4 * c + 1] += part * b"),
    "color_grid_gather": ("color_grid.cl", "0.0f ? weight * sums[y]", "0.0f ? sums[y]"),
    "color_grid_smoothness": ("color_grid_table.cl", "(before - after)", "(before + after)"),
    "color_grid_update": ("color_grid_table.cl", "grad_grid[e] + grad_smoothness[e]", "grad_grid[e]"),
    "color_grid_center": ("color_grid_table.cl", "((float)positions * (float)photographs)", "(float)positions"),
    "sky_forward": ("sky.cl", "+ seen * color", "- seen * color"),
    "sky_matches": ("sky.cl", "total_difference <= 3.0f * difference", "total_difference <= difference"),
    "sky_cover": ("sky.cl", "-scale * (chosen * t)", "-scale * chosen"),
    "sky_backward": ("sky.cl", "sums[k * 3 + channel] += weights[k]", "sums[k * 3 + channel] += weights[0]"),
    "sky_gather": ("sky.cl", "run_sums[entries[k] * 3 + channel]", "run_sums[entries[k] * 3]"),
    "sky_update": ("sky.cl", "sqrt(v / bias2)", "sqrt(v)"),
    "most_alike": ("clusters.cl", "product[j] > best", "product[j] >= best"),
    "share_mean": ("members.cl", "start + sum / total", "sum / total"),
    "count_not_finite": ("check.cl", "<= FLT_MAX", "<= INFINITY"),
    "count_seen": ("density.cl", "seen[i] += 1.0f", "seen[i] += 1.001f"),
    "accumulate_norm": ("density.cl", "sqrt(x * x + y * y)", "sqrt(x * x - y * y * 0.5f)"),
    "accumulate_sum": ("density.cl", "half_height * fabs(planes[(first + 1)", "half_width * fabs(planes[(first + 1)"),
    "accumulate_error": ("density.cl", "total[i] += error[0]", "total[i] = error[0]"),
    "accumulate_gain": ("density.cl", "- 2.0f * xy * x * y", "+ 2.0f * xy * x * y"),
    "accumulate_pixel_sum": ("density.cl", "pixel_sums[pixel_sum * stride", "pixel_sums[(pixel_sum - 1) * stride"),
    "accumulate_radius": ("density.cl", "total[i] += radius[i]", "total[i] = radius[i]"),
    "start_edit": ("density.cl", "old_rows[i] = 1;", "old_rows[i] = 0;"),
    "mark_rule": ("density.cl", "gradient >= gradient_above", "gradient <= gradient_above"),
    "mark_chosen": ("density.cl", "copies[i] = outcome[i] - 1", "copies[i] = outcome[i]"),
    "list_rows": ("density.cl", "copy >= old_rows[i] ? 1", "copy > old_rows[i] ? 1"),
    "spawn_children": ("density.cl", "2.0f * (y * z - w * x) * ez", "2.0f * (y * z + w * x) * ez"),
    "share_opacity": ("density.cl", "/ (float)copies[source[i]]", "/ (float)(copies[source[i]] + 1)"),
    "cap_opacity": ("density.cl", "limit / sqrt(energy2)", "limit / energy2"),
    "draw_left_out": ("dropout.cl", "(uint4)(i, step, 2, 0)", "(uint4)(i, step, 1, 0)"),
    "paint_depth": ("depth.cl", "row[2] * means[2 * stride + i]", "row[2] * means[stride + i]"),
    "integrate_view": ("fusion.cl", "a + right * (b - a)", "a + right * (d - a)"),
    "count_free": ("fusion.cl", "- z >= voxel", "- z >= 0.0f"),
    "fill_words": ("fill.cl", "(uint16)(word)", "(uint16)(word & 0xfffffffeu | 2u)"),
    "sampling_interval": ("filter.cl", "z * (1.0f / focal[view])", "z * (1.0f / focal[0])"),
    "filter_variance": ("filter.cl", "variance * sampled * sampled", "variance * sampled"),
    "sum_records": ("pair_sums.h", "pair < first + pairs", "pair + 1 < first + pairs"),
    "haar_forward": ("haar.cl", "u * block.xz + v", "u * block.xz - v"),
    "haar_backward": ("haar.cl", "const float2 before = low + u * high", "const float2 before = low - u * high"),
    "gather_rows": ("gather.cl", "zero_fresh && fresh[i]", "zero_fresh || fresh[i]"),
    "set_rows": ("gather.cl", "values[i * components + plane]", "values[i * components]"),
    "zero_rows": ("gather.cl", "rows[i]] = 0.0f", "rows[i]] = 1.0f"),
    "inverse_depth_loss": ("inverse_depth.cl", "(difference < 0.0f ? -1.0f", "(difference < 0.0f ? 1.0f"),
    "sum_inverse_depths": ("inverse_depth.cl", "accumulate ? sums[i] : 0.0f", "0.0f"),
    "inverse_depth_backward": ("inverse_depth.cl", "-sums[i] * inverse * inverse", "-sums[i] * inverse"),
    "view_error": ("loss.cl", "fabs(VLOAD(gradient + row + x) * difference)", "VLOAD(gradient + row + x) * difference"),
    "sum_errors": ("loss.cl", "total += row_errors[i]", "total = row_errors[i]"),
    "unpack_pixels": ("loss.cl", "pixels + (channel * height + y)", "pixels + (channel * height)"),
    "change_background": ("loss.cl", "(behind[channel] - background[channel])", "(behind[channel] - background[0])"),
    "apply_mask": ("loss.cl", "mask[pixel] == 0.0f", "mask[pixel] != 0.0f"),
    "pixel_loss": ("loss.cl", "(2.0f * l2)", "(1.99f * l2)"),
    "ssim_maps": ("ssim.cl", "SSIM_C2 9.0e-4f", "SSIM_C2 9.1e-4f"),
    "ssim_gradient": ("ssim.cl", "+ b * covariance)", "- b * covariance)"),
    "count_large": ("large.cl", "tile_count[i] = total;", "tile_count[i] = total / 2;"),
    "emit_large": ("large.cl", "corner + row * tiles_x", "corner + row * (tiles_x - 1)"),
    "emit_pairs": ("pairs.cl", "tile += tiles_x;", "tile += tiles_x - 1;"),
    "find_tile_offsets": ("pairs.cl", "sorted_tile[pair - 1] + 1", "sorted_tile[pair - 1] + 2"),
    "peak_fma": ("peak.cl", "c = c * m + step", "c = c * m - step"),
    "peak_exp": ("peak.cl", "y = x - 0.5f", "y = x - 0.51f"),
    "peak_copy": ("peak.cl", "= *(__global const piece_t *)(values", "= 1.0001f * *(__global const piece_t *)(values"),
    "covariance_trace": ("penalty.cl", "2.0f * weight", "weight"),
    "anisotropy": ("penalty.cl", "(up - down)", "(up + down)"),
    "mean_scale": ("penalty.cl", "total += scale;", "total += 2.0f * scale;"),
    "min_scale": ("penalty.cl", "scales[k] == shortest ? weight", "scales[k] != shortest ? weight"),
    "mean_opacity": ("penalty.cl", "opacity * (1.0f - opacity)", "opacity * (1.0f + opacity)"),
    "opacity_pressure": ("penalty.cl", "(above ? (VF)(weight) : zero)", "(VF)(weight)"),
    "draw_pixels": ("rays.cl", "RANDOM_PIXELS, 0), (uint2)(seed, 0)).x", "RANDOM_PIXELS, 0), (uint2)(seed, 0)).y"),
    "cast_rays": ("rays.cl", "cone[6] = CONE_RADIUS / camera", "cone[6] = 0.5f / camera"),
    "spread_edges": ("rays.cl", "ray_edges[k] = near + width * position", "ray_edges[k] = near - width * position"),
    "resample_edges": ("rays.cl", "0.5f * (low + high) + BLUR_PADDING", "0.5f * (low + high)"),
    "encode_frustums": ("frustum.h", "(12.0f * m2 - h2)", "(12.0f * m2 + h2)"),
    "encode_directions": ("encode.cl", "cone[3 + axis] / cone[7]", "cone[3 + axis]"),
    "dense_forward": ("dense.cl", "larger(sums[k * BLOCK + v], (VF)(lower_bound))", "sums[k * BLOCK + v]"),
    "dense_backward": ("dense.cl", "<= lower_bound ? (VF)(0.0f)", "< lower_bound ? (VF)(0.0f)"),
    "dense_weights": ("dense.cl", "? tiles - first : CHUNK", "? tiles - first : CHUNK - 1"),
    "dense_biases": ("dense.cl", "sum += VLOAD(grad_outputs", "sum = VLOAD(grad_outputs"),
    "dense_sums": ("dense.cl", "sum += VLOAD(partials", "sum = VLOAD(partials"),
    "dense_update": ("dense.cl", "correction2, epsilon)", "correction2, 1.0e-15f)"),
    "grid_places": ("grid.cl", "+ 2.0f * f.across)", "+ f.across)"),
    "grid_forward": ("grid.cl", "(down ? dy : 1.0f - dy)", "(down ? dy : 1.0f - dx)"),
    "grid_backward": ("grid.cl", "grad.z == 0.0f && grad.w == 0.0f))", "grad.z == 0.0f || grad.w > 0.0f))"),
    "composite_forward": ("composite.cl", "weight * color_of(raw_colors", "weight * logistic(raw_colors"),
    "composite_backward": ("composite.cl", "k] * grad_weight - behind", "k] * grad_weight + behind"),
    "place_colors": ("composite.cl", "= colors[ray * 3 + channel];", "= colors[ray * 3];"),
    "add_noise": ("noise.cl", "scale * scale * turned", "scale * turned"),
    "project_forward": ("gaussian.h", "2.0f * (x * y - w * z)", "2.0f * (x * y + w * z)"),
    "move_forward": ("motion.cl", "bounded + m.log_presence -", "bounded + 0.99f * m.log_presence -"),
    "turn_forward": ("motion.cl", "(first + k) * stride + i) * dt", "first * stride + i) * dt"),
    "move_backward": ("motion.cl", "(power * (float)order)", "power"),
    "turn_backward": ("motion.cl", "grad_center - grad_quat * VLOAD", "grad_center + grad_quat * VLOAD"),
    "motion_step": ("motion.cl", "smaller(larger(value, (VF)(lowest))", "smaller(larger(value, (VF)(-FLT_MAX))"),
    "pose_gradient": ("poses.cl", "- (d[m] * gd[n] - d[n] * gd[m])", "+ (d[m] * gd[n] - d[n] * gd[m])"),
    "project_backward": ("backward.h", "energy2 = larger(1.0f + compensate", "energy2 = larger(1.0f - compensate"),
    "accumulate_splitting": ("saddle.cl", "c * c * yy - power * c", "c * c * yy - power * a"),
    "add_to_average": ("average.cl", "(number[i] + 1.0f)", "(number[i] + 1.1f)"),
    "count_step": ("average.cl", "number[i] += 1.0f", "number[i] += 2.0f"),
    "take_average": ("average.cl", "number[i] > 0.0f)", "number[i] > 2.5f)"),
    "scan_blocks": ("scan.cl", "total += sums[i]", "total = sums[i] + 1"),
    "scan_offsets": ("scan.cl", "offset[count] = limited(sum)", "offset[count] = limited(sum) - 1"),
    "fill_tiles": ("sort_bitonic.cl", "= depth_key[pair_splat[pair]]", "= pair_splat[pair]"),
    "sort_tiles": ("sort_bitonic.cl", "is_before(other_key, other_pair, key", "is_before(key, other_pair, other_key"),
    "merge_runs": ("sort_bitonic.cl", "is_before(tile_depth[middle]", "is_before(tile_depth[low]"),
    "radix_count": ("sort_radix.cl", "blocks + block] = sum;", "blocks + block] = sum / 2;"),
    "radix_scatter": ("sort_radix.cl", "value = first_pass ? i : values[i]", "value = i"),
    "camera_response": ("camera_response.cl", "(2.0f * numbers[1]", "(numbers[1]"),
    "lay_over": ("layer.cl", "total += inside * (1.0f - t)", "total += 1.0f - t"),
    "look_behind": ("layer.cl", "t * VLOAD(values)", "VLOAD(values)"),
    "measure_residuals": ("transients.cl", "(red + green + blue)", "(red + green + green)"),
    "mask_transients": ("transients.cl", "2 * below >= counted", "2 * below > counted"),
    "image_gradient": ("texture.cl", "0.587f * VLOAD", "0.578f * VLOAD"),
    "hide_masked": ("texture.cl", "row <= y + 1", "row <= y"),
    "sample_magnitude": ("texture.cl", "magnitude[row * stride + column]", "magnitude[row * stride]"),
}  # fmt: skip
OPEN = "ANY((one.t > 0.0f) | (other.t > 0.0f))"
MORE = {  # that smaller pictures do not show
    "colors_backward, what is cut": ("colors.cl", "+ g1 < 1.0f ? inside : zero", "+ g1 < 1.0f ? inside : inside"),
    "colors_backward, a sum of another": ("colors.cl", "total[9] += passed_b * g", "total[9] += passed_b * r"),
    "camera_response, light beyond white": ("camera_response.cl", "larger(light - one, zero)", "zero"),
    "color_grid_backward, what is cut": ("color_grid.cl", "(changed < 1.0f ? inside : zero)", "inside"),
    "color_grid_backward, through the luminance": ("color_grid.cl", "(float)(nz - 1) * between", "between"),
    "color_grid_center, one photograph": (
        "color_grid_table.cl",
        "entries[p * photograph_stride + i] -= mean",
        "entries[i] -= mean",
    ),
    "blend_forward wide, dim pixels": (
        "blend_wide.cl",
        f"bool open = {OPEN}",
        f"bool open = {OPEN}".replace("0.0", "0.01"),
    ),
    "grid_forward, entries that are shared": ("grid.cl", "HASH_Z 805459861u", "HASH_Z 805459863u"),
    "grid_forward, the weight of a level": ("grid.cl", "TWO_PI * size * size", "TWO_PI * size"),
    "grid_forward, outside of the cube": ("grid.cl", "(y <= 1.0f)", "(y <= 1.5f)"),
    "grid_backward, sums in parts": ("grid.cl", "entry[corner] - begin < size", "entry[corner] - begin <= size"),
    "dense_backward, rows of a grid": (
        "dense.cl",
        "accumulate ? VLOAD(block",
        "accumulate ? 0.0f * VLOAD(block",
    ),
    "blend_forward simt, dim pixels": ("blend_simt.cl", "if (p.t > 0.0f)", "if (p.t > 0.01f)"),
    "pixel_loss, pixels that are equal": ("loss.cl", "difference < 0.0f ? -inside", "difference <= 0.0f ? -inside"),
    "scan_offsets simt, a sum that wraps": ("scan.cl", "(uint)min(sum, (ulong)UINT_MAX)", "(uint)sum"),
    "pose_gradient, the shape": ("poses.cl", "by_position + 0.5f * by_rotation", "by_position + by_rotation"),
    "pose_gradient, the focal length": ("backward.h", "+ s->ray_x * ray_x + s->ray_y", "- s->ray_x * ray_x + s->ray_y"),
    "emit_large simt, one row an item": ("large.cl", "each = (rows + TEAM - 1) / TEAM", "each = 1"),
    "emit_large simt, the same rows": ("large.cl", "begin = get_local_id(0) * each", "begin = get_local_id(0)"),
    "emit_large wide, a tile outside": ("large.cl", "pair_tile[slot] = last;", "pair_tile[slot] = last + 12345;"),
    "project_forward simt, a bit too few": ("tiles.h", "(float)BOX_TILES_MAX;", "(float)(BOX_TILES_MAX + 1);"),
    "blend_backward simt, a later batch": (
        "blend_simt.cl",
        "active = begin + item < last",
        "active = begin + item < first + PIXELS",
    ),
    "blend_backward simt, the end of the last batch": ("blend_simt.cl", "begin < last + PIXELS &&", "begin < last &&"),
}
OPTIONAL = {  # in what few runs compute: doctor notices them, the check before every run has no time for it
    "blend_backward simt, the color in front of a bucket": (
        "blend_simt.cl",
        "p->green = state[2 *",
        "p->green = state[3 *",
    ),
    "blend_backward wide, numbers of pixels": ("splat.h", "m->blended += k.blended ?", "m->blended += k.hit ?"),
    "blend_backward simt, squares": (
        "splat.h",
        "passes ? s.opacity * grad_alpha",
        "passes ? k.uncapped * grad_alpha",
    ),
    "project_forward, what a view leaves out": ("project.cl", " & (left_out == 0)", ""),
    "project_forward, the views of another plane": ("project.cl", "hidden_plane * stride + i", "i"),
    "project_forward, opacities beside what is dropped": ("project.cl", " * opacity_factor", ""),
    "draw_left_out, what the view hides": ("dropout.cl", "drawn || bits", "drawn"),
    "adam_step, rows not seen": ("adam.cl", "(i & ~first)) != -1", "(i & ~first)) != 0"),
    "adam_step, rows that wait": ("adam.cl", "first = every & undrawn", "first = every"),
    "replay_updates, factors": ("deferred.cl", "factors[2 * u], factors", "factors[0], factors"),
    "note_update, factors": ("deferred.cl", "[2 * update] = rate", "[2 * update] = correction2"),
    "motion_step, rows not seen": ("motion.cl", "!= -1) | (VI)((int)every)", "!= 0) | (VI)((int)every)"),
    "update_gaussians, rows not seen": ("adam.cl", "].touched | (VI)((int)every)", "].touched | (VI)(-1)"),
    "ssim_gradient, L1 of equal pixels": ("ssim.cl", "difference < 0.0f ? -part", "difference <= 0.0f ? -part"),
    "ssim_gradient, value of the L1": ("ssim.cl", "magnitude(difference) * inside", "difference * inside"),
    "ssim_maps simt, runs of rows": (
        "ssim.cl",
        "* RUN;\n        const uint x = left + v - MARGIN;  //",
        "* 1;\n        const uint x = left + v - MARGIN;  //",
    ),
    "update_gaussians, sums of pairs": ("adam.cl", "pixel_sums, 0, stride", "pixel_sums, 1, stride"),
    "update_gaussians, views": ("adam.cl", "visible ? views + 1.0f", "true ? views + 1.0f"),
    "update_gaussians, norms": ("adam.cl", "x *= half_width, y *= half_height", "x *= half_width, y *= half_width"),
    "update_gaussians, norms of absolute values": ("adam.cl", "y = m[SUM_ABS_Y]", "y = m[SUM_ABS_X]"),
    "update_gaussians, moments not seen": ("adam.h", "(updated ? v : v_before)", "v"),
    "blend_forward wide, inverse depth": ("blend_wide.cl", "p.inverse_depth * inside", "p.inverse_depth * t"),
    "blend_forward simt, inverse depth": ("blend_simt.cl", "inside ? p.inverse_depth", "inside ? t * p.inverse_depth"),
    "blend_forward, weights of the inverse depth": (
        "splat.h",
        "p->inverse_depth += k.weight * color",
        "p->inverse_depth += p->t * color",
    ),
    "blend_forward wide, median depths": ("splat.h", "(p->t >= 0.5f)", "(p->t >= 0.4f)"),
    "blend_forward simt, median depths": ("splat.h", "(k.next < 0.5f)", "(k.next < 0.6f)"),
    "blend_backward wide, inverse depth": ("blend_wide.cl", "+ p.inverse_depth * VLOAD", "- p.inverse_depth * VLOAD"),
    "blend_backward simt, inverse depth": (
        "blend_simt.cl",
        "own.rest + own.inverse_depth * (image",
        "own.rest - own.inverse_depth * (image",
    ),
    "sum_inverse_depths wide, records": ("blend_wide.cl", "last = m.inverse_depth", "last = m.red"),
    "sum_inverse_depths simt, records": ("blend_simt.cl", "last = m->inverse_depth", "last = m->red"),
    "blend_backward, shade of the inverse depth": (
        "splat.h",
        "* p->inverse_depth;\n#endif\n    p->rest",
        "* 2.0f * p->inverse_depth;\n#endif\n    p->rest",
    ),
    "project_forward, inverse depth": ("project.cl", "power_min, s.inverse_z", "power_min, s.z"),
    **{
        f"{kernel} {schedule}, {what} of the pixel's box": (file, text, wrong)
        for schedule, (kernel, what, file, text, wrong) in zip(
            itertools.cycle(("wide", "simt")),  # of what both share
            (
                ("blend_forward", "normal distribution", "pixel_box.h", "QUINTIC (-5.9", "QUINTIC (-6.5"),
                ("blend_forward", "width", "pixel_box.h", "(1.0f + r - w2)", "(1.0f + r)"),
                ("blend_forward", "variance", "pixel_box.h", "variance = c - tilt2", "variance = c + tilt2"),
                ("blend_backward", "slope", "pixel_box.h", "= 24.0f * k * y.variance", "= 12.0f * k * y.variance"),
                ("blend_backward", "blur", "pixel_box.h", "-(1.0f - r / w2) *", "-(1.0f + r / w2) *"),
                ("blend_backward", "shift", "pixel_box.h", "? -mean_s : mean_s", "? mean_s : mean_s"),
                ("blend_backward", "variance by size", "pixel_box.h", "s * s * (2.0f * part", "s * s * (part"),
                ("project_forward", "turned splats", "project.cl", "turned ? (VF)(1.0f)", "!turned ? (VF)(1.0f)"),
                (
                    "project_backward",
                    "covariance",
                    "backward.h",
                    "+ g_short * slope * slope",
                    "- g_short * slope * slope",
                ),
                ("emit_large", "tiles", "tiles.h", "-k * longer * inverse", "k * longer * inverse"),
            ),
            strict=False,
        )
    },
    "blend_backward wide, what is left": (
        "blend_wide.cl",
        "p.rest + VLOAD(behind + at)",
        "p.rest - VLOAD(behind + at)",
    ),
    "blend_backward simt, what no pixel blends": ("blend_simt.cl", "uint k = last + item", "uint k = end + item"),
    "blend_backward simt, what is left": ("blend_simt.cl", "own.rest + behind[at]", "own.rest - behind[at]"),
    "sky_forward, the lower half": ("sky.cl", "a = (x - run->sign_x * below)", "a = (x + run->sign_x * below)"),
    "sky_cover, most of nine": ("sky.cl", "MATCH_FRACTION 0.6f", "MATCH_FRACTION 0.5f"),
    "project_backward, needles": (
        "backward.h",
        "v0 += g_det0 * by_normal[k];\n        v1 += g_det0 * by_normal[3 + k];",
        "v0 += g_det0 * (s->yy * s->v[k] - s->xy * s->v[3 + k]);"  # the same without rounding
        "v1 += g_det0 * (s->xx * s->v[3 + k] - s->xy * s->v[k]);",
    ),
    "project_backward, needles by the inverse": (
        "backward.h",
        "-(a * ga + b * gb + c",
        "-(a * ga + 0.999f * b * gb + c",
    ),
}


CHECKS = {"doctor": [*KERNELS, *SPEED_CHECKS], "a run": [*ESSENTIAL_CHECKS, *BITONIC]}


def kernel_names() -> set[str]:
    """Names of all kernels, with the schedule if each schedule has a separate kernel."""
    actual = set()
    for path in resource_dir("cl_kernels").glob("*.cl"):
        own = re.search("_(wide|simt)$", path.stem)
        actual |= {f"{name} {own[1]}" if own else name for name in parse_kernels(path.read_text())}
    return actual


def checked_by(checks: list[Check]) -> set[str]:
    return {kernel for check in checks for kernel in check.kernels}


def test_every_kernel_has_a_check_and_a_planted_fault():
    checked = checked_by(CHECKS["doctor"])
    assert checked == {name.partition(" ")[0] for name in kernel_names()}
    assert FAULTS.keys() == kernel_names()
    assert checked_by(CHECKS["a run"]) < checked


def kernel_of(planted: str) -> tuple[str, str]:
    """The kernel of a fault, and its schedule or ''."""
    kernel, _, schedule = planted.partition(",")[0].partition(" ")
    return kernel, schedule


def first_failure(device: Device, planted: str, checks: list[Check]) -> str | None:
    """The first deviation beyond its bound in the checks of a fault's kernel; those named as the fault come first."""
    kernel, words = kernel_of(planted)[0], set(planted.split())
    for check in sorted(checks, key=lambda check: -len(words & set(check.name.split()))):
        for found in check.deviations(device) if kernel in check.kernels else ():
            if not isinstance(found, Note) and not found.passes:
                return found.text
    return None


@pytest.mark.parametrize("planted", [*FAULTS, *MORE, *OPTIONAL])
def test_planted_fault_is_caught(monkeypatch, planted):
    """The source is changed in memory only."""
    file, text, wrong = {**FAULTS, **MORE, **OPTIONAL}[planted]
    assert (resource_dir("cl_kernels") / file).read_text().count(text) == 1, "the place of the fault is not unique"
    flatten = program.flatten

    def with_the_fault(path, seen=None):
        flat = flatten(path, seen)
        return flat.replace(text, wrong) if path.name == file else flat

    monkeypatch.setattr(program, "flatten", with_the_fault)
    kernel, schedule = kernel_of(planted)
    device = Device(choose_device(NAMES[0] or None), schedule or "auto")
    for command, checks in CHECKS.items():
        if kernel in checked_by(checks) and not (planted in OPTIONAL and command == "a run"):
            assert first_failure(device, planted, checks), f"{command} does not notice a fault in {kernel}"
