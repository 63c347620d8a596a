"""Look at a model file: what it is, whether its numbers can be, and how many of its Gaussians show nothing."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.splats import Reading, motion_fields, not_finite, too_large_message
from clsplat.formats.streamed_sog import LOD_META, find_level_faults
from clsplat.formats.table import detect, format_of_name, model_file
from clsplat.gaussians.model import Model, load

ENOUGH = 16  # Gaussians, from which their numbers tell something
FLAT = 1e-6  # scene units: a smaller scale is that of a disc or a needle
FAINT = 0.999 / 255  # opacity: less is not drawn
LARGE = 0.05  # of the model's extent: linear scales, taken for logarithms, become larger
NEARLY_ALL = 0.99
DEGENERATE = {"not_finite": "not finite", "no_rotation": "without rotation", "flat": "flat", "invisible": "invisible"}


def is_model(path: Path) -> bool:
    """Return whether a path is a model, by its content or its name; pipeline files are none."""
    place = model_file(path)
    if place.suffix in (".yaml", ".yml"):
        return False
    return bool(format_of_name(place) or (place.is_file() and detect(place)))


def examine(path: Path) -> dict[str, Any]:
    """Return what a model file holds: `model` (its path), `format`, `gaussians`, `sh_degree`, `mode`, if it `moves`,
    `ranges`, `bounds` in scene units, `degenerate` counts, `findings` in words, if it is `valid`: without them.

    Raises DataError where it cannot be read.
    """
    codec = detect(model_file(path))
    model = load(path, Reading(not_finite="keep"))
    bad = not_finite(model.tables())
    whole = model[~bad] if bad.any() else model
    findings = [f"{int(bad.sum()):,} of {len(model):,} Gaussians hold values that are not finite"] if bad.any() else []
    findings += [told] if (told := too_large_message(whole.tables())) else []
    findings += _activated(whole)
    length = np.linalg.norm(whole.quats.astype(np.float64), axis=1)
    if zero := int((length == 0).sum()):
        findings.append(f"{zero} quaternions have no length")
    if not len(model):
        findings.append("it holds no Gaussians")
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
        "ranges": _ranges(whole),
        "bounds": [whole.means.min(axis=0).tolist(), whole.means.max(axis=0).tolist()] if len(whole) else [],
        "degenerate": {
            "not_finite": int(bad.sum()),
            "no_rotation": zero,
            "flat": int((whole.log_scales < np.log(FLAT)).any(axis=1).sum()),
            "invisible": int((whole.opacities < FAINT).sum()),
        },
        "findings": findings,
        "valid": not findings,
    }


def lines(found: dict[str, Any]) -> str:
    """Return what `examine` found, a line for each fact."""
    marks = " (mip)" * (found["mode"] == "mip") + " (filter_3D)" * found["world_filter"] + " (moves)" * found["moves"]
    rows = [
        f"{found['model']}: {found['format']}, {found['gaussians']:,} Gaussians, SH degree {found['sh_degree']}{marks}"
    ]
    for name, (low, middle, high) in found["ranges"].items():
        rows.append(f"  {name:<12} {low:.4g} to {high:.4g}, median {middle:.4g}")
    for low, high in [found["bounds"]] if found["bounds"] else []:
        text = (", ".join(f"{value:.4g}" for value in corner) for corner in (low, high))
        rows.append(f"  {'bounds':<12} ({next(text)}) to ({next(text)})")
    counts = found["degenerate"]
    rows.append(f"  {'degenerate':<12} " + ", ".join(f"{counts[name]} {words}" for name, words in DEGENERATE.items()))
    return "\n".join(rows)


def verdict(found: dict[str, Any]) -> str:
    """Return a sentence about what `examine` found."""
    if found["valid"]:
        return f"{found['model']}: valid"
    if not found["gaussians"]:
        return f"{found['model']}: it holds no Gaussians; export it again"
    remedy = "write it again" if found["format"] == "streamed SOG" else "export it again"
    if found["degenerate"]["not_finite"]:
        remedy += ", or drop those that are not finite with `clsplat convert`"
    return f"{found['model']}: {'; '.join(found['findings'])}; {remedy}"


def _activated(model: Model) -> list[str]:
    """What looks as if it were activated already, which viewers do again."""
    if len(model) < ENOUGH:
        return []
    found = []
    extent = float(np.linalg.norm(np.ptp(model.means.astype(np.float64), axis=0)))
    middle = float(np.exp(min(float(np.median(model.log_scales)), 80)))
    if (model.log_scales >= 0).mean() > NEARLY_ALL and middle > LARGE * extent:
        found.append("its scales look like scales, not logarithms of them")
    logit = model.logit_opacity
    if ((logit >= 0) & (logit <= 1)).mean() > NEARLY_ALL:
        found.append("its opacities look like opacities, not logits of them")
    base = model.sh_base
    if ((base >= 0) & (base <= 1)).mean() > NEARLY_ALL and np.ptp(base) > 0:
        found.append("its base colors look like colors, not coefficients around gray")
    return found


def _ranges(model: Model) -> dict[str, list[float]]:
    """Least, median and largest of each quantity after activation."""
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
