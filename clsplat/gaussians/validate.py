"""Inspect a model file: its format, invalid values, and degenerate Gaussians."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.reading import open_file
from clsplat.formats.ply import MAX_HEADER
from clsplat.formats.splats import ReadOptions, motion_fields, not_finite, too_large_message, typical_size
from clsplat.formats.streamed_sog import LOD_META, find_level_faults
from clsplat.formats.table import detect, format_from_name, model_file
from clsplat.gaussians.model import Model, load
from clsplat.scene.scene import format_position

UNSUPPORTED = (".usd", ".usdc", ".usdz", ".obj", ".fbx", ".las", ".laz", ".rad", ".lcc")  # models that cannot be read
MIN_COUNT = 16  # Gaussians needed for statistics
FLAT = 1e-6  # relative to the typical size; Gaussians with smaller scales are discs or needles
FAINT = 0.999 / 255  # opacities below are not rendered
LARGE = 0.05  # relative to the extent; exceeded by linear scales that are read as logarithms
NEARLY_ALL = 0.99
DEGENERATE = {"not_finite": "not finite", "no_rotation": "without rotation", "flat": "flat", "invisible": "invisible"}


def is_model(path: Path) -> bool:
    """Return whether a path is a model and not a pipeline: by its name or content, or because it is a binary file."""
    file = model_file(path)
    if file.suffix in (".yaml", ".yml"):
        return False
    if format_from_name(file) or file.suffix.lower() in UNSUPPORTED:
        return True
    return file.is_file() and (detect(file) is not None or _is_binary(file))


def _is_binary(path: Path) -> bool:
    with open_file(path) as file:
        return b"\0" in file.read(MAX_HEADER)


def examine(path: Path) -> dict[str, Any]:
    """Return a summary of a model file.

    Its keys include `model` (the path), `format`, `gaussians`, `sh_degree`, `mode`, `moves`, `ranges`, `bounds` in
    scene units, counts of `degenerate` Gaussians, `findings` as text, and `valid` (True without findings).
    Raises DataError if the file cannot be read.
    """
    codec = detect(model_file(path))
    model = load(path, ReadOptions(not_finite="keep"))
    is_nonfinite = not_finite(model.tables())
    subset = model[~is_nonfinite] if is_nonfinite.any() else model
    fault = f"{int(is_nonfinite.sum()):,} of {len(model):,} Gaussians have values that are not finite"
    findings = [fault] if is_nonfinite.any() else []
    findings += [message] if (message := too_large_message(subset.tables())) else []
    findings += _find_activated(subset)
    lengths = np.linalg.norm(subset.quats.astype(np.float64), axis=1)
    if no_rotation := int((lengths == 0).sum()):
        findings.append(f"{no_rotation} quaternions have length 0")
    if not len(model):
        findings.append("it has no Gaussians")
    if model_file(path).name == LOD_META:
        findings += find_level_faults(model_file(path))
    return {
        "model": str(path),
        "format": codec.name if codec else "",
        "gaussians": len(model),
        "sh_degree": model.sh_degree,
        "mode": "box" if model.rendering.pixel_box else "mip" if model.rendering.compensate else "default",
        "world_filter": model.filter_variance is not None,
        "moves": model.motion is not None,
        "ranges": _ranges(subset),
        "bounds": [subset.means.min(axis=0).tolist(), subset.means.max(axis=0).tolist()] if len(subset) else [],
        **({"origin": model.origin.tolist()} if model.origin.any() else {}),
        "degenerate": {
            "not_finite": int(is_nonfinite.sum()),
            "no_rotation": no_rotation,
            "flat": int((subset.log_scales < np.log(FLAT * typical_size(subset.means))).any(axis=1).sum()),
            "invisible": int((subset.opacities < FAINT).sum()),
        },
        "findings": findings,
        "valid": not findings,
    }


def format_report(report: dict[str, Any]) -> str:
    """Format the result of `examine` as lines of text."""
    suffix = (
        " (mip)" * (report["mode"] == "mip") + " (filter_3D)" * report["world_filter"] + " (moves)" * report["moves"]
    )
    degree = f"SH degree {report['sh_degree']}{suffix}"
    rows = [f"{report['model']}: {report['format']}, {report['gaussians']:,} Gaussians, {degree}"]
    for name, (low, median, high) in report["ranges"].items():
        rows.append(f"  {name:<12} {low:.4g} to {high:.4g}, median {median:.4g}")
    for low, high in [report["bounds"]] if report["bounds"] else []:
        corners = (", ".join(f"{value:.4g}" for value in corner) for corner in (low, high))
        rows.append(f"  {'bounds':<12} ({next(corners)}) to ({next(corners)})")
    if origin := report.get("origin"):
        rows.append(f"  {'origin':<12} {format_position(np.array(origin))}, to which the bounds are relative")
    counts = report["degenerate"]
    rows.append(f"  {'degenerate':<12} " + ", ".join(f"{counts[name]} {label}" for name, label in DEGENERATE.items()))
    return "\n".join(rows)


def verdict(report: dict[str, Any]) -> str:
    """Summarize the result of `examine` in one sentence, with a remedy for a faulty model."""
    if report["valid"]:
        return f"{report['model']}: valid"
    if not report["gaussians"]:
        return f"{report['model']}: it has no Gaussians; export it again"
    remedy = "write it again" if report["format"] == "streamed SOG" else "export it again"
    if report["degenerate"]["not_finite"] or report["degenerate"]["no_rotation"]:
        remedy += ", or drop invalid Gaussians with `clsplat convert`"
    return f"{report['model']}: {'; '.join(report['findings'])}; {remedy}"


def _find_activated(model: Model) -> list[str]:
    """Return findings about values that seem to be stored after activation, such as scales instead of logarithms."""
    if len(model) < MIN_COUNT:
        return []
    findings = []
    extent = float(np.linalg.norm(np.ptp(model.means.astype(np.float64), axis=0)))
    median_scale = float(np.exp(min(float(np.median(model.log_scales)), 80)))
    if (model.log_scales >= 0).mean() > NEARLY_ALL and median_scale > LARGE * extent:
        findings.append("its scales look linear, not logarithmic")
    logit = model.logit_opacity
    if ((logit >= 0) & (logit <= 1)).mean() > NEARLY_ALL:
        findings.append("its opacities look like opacities, not logits")
    base = model.sh_base
    if ((base >= 0) & (base <= 1)).mean() > NEARLY_ALL and np.ptp(base) > 0:
        findings.append("its base colors look like colors, not SH coefficients")
    return findings


def _ranges(model: Model) -> dict[str, list[float]]:
    """Return the minimum, median, and maximum of each quantity after activation."""
    with np.errstate(over="ignore"):
        scales = np.exp(np.minimum(model.log_scales.astype(np.float64), 700))
    quantities: dict[str, NDArray[Any]] = {
        "scales": scales,
        "opacities": model.opacities,
        "colors": model.colors,
        "harmonics": model.sh_rest,
        "quaternions": np.linalg.norm(model.quats.astype(np.float64), axis=1),
    }
    if model.motion is not None:
        fields, motion = motion_fields(model.motion.shape[1]), model.motion.astype(np.float64)
        quantities["speeds"] = np.linalg.norm(motion[:, fields["velocity"]], axis=1)
        quantities["durations"] = np.exp(np.minimum(motion[:, fields["log_duration"]], 700))
    return {
        name: [float(table.min()), float(np.median(table)), float(table.max())]
        for name, table in quantities.items()
        if table.size
    }
