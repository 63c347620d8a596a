"""Evaluate and transform moving Gaussians on the host.

The columns of the table are defined in clsplat/formats/splats.py, and the formulas in cl_kernels/motion.cl.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.quaternions import multiply, unit_quaternions
from clsplat.formats.splats import MOTION, STATIC_LOG_DURATION, Parameters, motion_fields

MIN_PRESENCE = 1 / 255  # opacity factor below which a Gaussian is invisible
MAX_LOGIT = 80.0  # larger logits are clamped before the opacity factor is applied


def static_motion(count: int, width: int) -> NDArray[np.float32]:
    """Return the motion of Gaussians that are always visible and never move, [count, width]."""
    table = np.zeros((count, width), np.float32)
    fields = motion_fields(width)
    table[:, fields["time_center"]], table[:, fields["log_duration"]] = 0.5, STATIC_LOG_DURATION
    return table


def presence(motion: NDArray[np.floating], time: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factor on each opacity, [N] in (0, 1].  time: one number, or one for each Gaussian, [N]."""
    fields, table = motion_fields(motion.shape[1]), motion.astype(np.float64)
    dt = np.reshape(time, (-1, 1)) - table[:, fields["time_center"]]
    with np.errstate(over="ignore"):
        return np.exp(-0.5 * np.square(dt * np.exp(np.minimum(-table[:, fields["log_duration"]], MAX_LOGIT))))[:, 0]


def evaluate_at(parameters: Parameters, time: float) -> Parameters:
    """Return the Gaussians that are visible at a time, as static Gaussians."""
    motion = parameters[MOTION].astype(np.float64)
    fields, factor = motion_fields(motion.shape[1]), presence(motion, time)
    is_visible = factor >= MIN_PRESENCE
    tables = {name: table[is_visible] for name, table in parameters.items() if name != MOTION}
    motion, factor = motion[is_visible], factor[is_visible, None]
    dt = time - motion[:, fields["time_center"]]
    means = tables["means"].astype(np.float64)
    for order, name in enumerate(("velocity", "acceleration", "jerk"), 1):
        if name in fields:
            means = means + motion[:, fields[name]] * dt**order
    with np.errstate(over="ignore", invalid="ignore"):  # Model.at rejects such values
        tables["means"] = means.astype(np.float32)
    if "turn" in fields:
        tables["quats"] = (tables["quats"] + motion[:, fields["turn"]] * dt).astype(np.float32)
    logit = tables["logit_opacity"].astype(np.float64)
    clamped_logit = np.minimum(logit, MAX_LOGIT)
    faded_logit = clamped_logit + np.log(factor) - np.log1p(np.exp(clamped_logit) * (1 - factor))
    tables["logit_opacity"] = np.where(factor < 1, faded_logit, logit).astype(np.float32)
    return tables


def transform_motion(motion: NDArray[np.floating], scale: float, rotation: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the motion after x -> scale · rotation x.  rotation: [3, 3]."""
    fields, result = motion_fields(motion.shape[1]), motion.astype(np.float64)
    for name in fields.keys() & {"velocity", "acceleration", "jerk"}:
        result[:, fields[name]] = scale * result[:, fields[name]] @ rotation.T
    if "turn" in fields:
        result[:, fields["turn"]] = multiply(unit_quaternions(rotation.astype(np.float64)), result[:, fields["turn"]])
    return result


def with_motion(tables: Sequence[Parameters], names: Sequence[str]) -> list[Parameters]:
    """Return the tables of each model; if any model moves, the others get static motion.

    Raises DataError if their motions have different columns.
    """
    names_by_width = {
        table[MOTION].shape[1]: name for table, name in zip(tables, names, strict=True) if MOTION in table
    }
    if len(names_by_width) > 1:
        first, second, *_ = names_by_width.values()
        raise DataError(
            f"{second}: its motion and that of {first} differ in degree or rotation; convert both to the same time "
            "first (`clsplat convert MODEL OUT --time T`), then merge them"
        )
    return [
        {**table, MOTION: table.get(MOTION, static_motion(len(table["means"]), *names_by_width))}
        if names_by_width
        else table
        for table in tables
    ]
