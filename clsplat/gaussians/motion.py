"""Gaussians that move, on the host: one moment of them, and the motion of those that stand still.

The columns of the table are described in clsplat/formats/splats.py, and the formulas in cl_kernels/motion.cl.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.quaternions import multiply, unit_quaternions
from clsplat.formats.splats import MOTION, STATIC_LOG_DURATION, Parameters, motion_fields

FAINTEST = 1 / 255  # of a presence: what is fainter is nowhere to be seen
LOGIT = 80.0  # of an opacity, at most where it fades


def static_motion(count: int, width: int) -> NDArray[np.float32]:
    """Return the motion of Gaussians that are there always and never move, [count, width]."""
    table = np.zeros((count, width), np.float32)
    fields = motion_fields(width)
    table[:, fields["time_center"]], table[:, fields["log_duration"]] = 0.5, STATIC_LOG_DURATION
    return table


def presence(motion: NDArray[np.floating], time: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factor of each opacity at a time, or at a time of its own, [N]; it is [N] in (0, 1]."""
    fields, table = motion_fields(motion.shape[1]), motion.astype(np.float64)
    dt = np.reshape(time, (-1, 1)) - table[:, fields["time_center"]]
    with np.errstate(over="ignore"):
        return np.exp(-0.5 * np.square(dt * np.exp(np.minimum(-table[:, fields["log_duration"]], LOGIT))))[:, 0]


def at_time(parameters: Parameters, time: float) -> Parameters:
    """Return the tables of static Gaussians as moving ones are at a time: those that are there, without motion."""
    motion = parameters[MOTION].astype(np.float64)
    fields, factor = motion_fields(motion.shape[1]), presence(motion, time)
    there = factor >= FAINTEST
    tables = {name: table[there] for name, table in parameters.items() if name != MOTION}
    motion, factor = motion[there], factor[there, None]
    dt = time - motion[:, fields["time_center"]]
    moved = tables["means"].astype(np.float64)
    for order, name in enumerate(("velocity", "acceleration", "jerk"), 1):
        if name in fields:
            moved = moved + motion[:, fields[name]] * dt**order
    with np.errstate(over="ignore", invalid="ignore"):  # of what Model.at refuses
        tables["means"] = moved.astype(np.float32)
    if "turn" in fields:
        tables["quats"] = (tables["quats"] + motion[:, fields["turn"]] * dt).astype(np.float32)
    logit = tables["logit_opacity"].astype(np.float64)
    bounded = np.minimum(logit, LOGIT)
    faded = bounded + np.log(factor) - np.log1p(np.exp(bounded) * (1 - factor))
    tables["logit_opacity"] = np.where(factor < 1, faded, logit).astype(np.float32)
    return tables


def transformed_motion(motion: NDArray[np.floating], scale: float, turn: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the motion after x -> scale · turn x; turn: [3, 3], a rotation."""
    fields, moved = motion_fields(motion.shape[1]), motion.astype(np.float64)
    for name in fields.keys() & {"velocity", "acceleration", "jerk"}:
        moved[:, fields[name]] = scale * moved[:, fields[name]] @ turn.T
    if "turn" in fields:
        moved[:, fields["turn"]] = multiply(unit_quaternions(turn.astype(np.float64)), moved[:, fields["turn"]])
    return moved


def with_motion(tables: Sequence[Parameters], names: Sequence[str]) -> list[Parameters]:
    """Return the tables of models with a motion in all of them where some move: the others stand still.

    Raises DataError where they move in different ways.
    """
    widths = {one[MOTION].shape[1]: name for one, name in zip(tables, names, strict=True) if MOTION in one}
    if len(widths) > 1:
        first, second, *_ = widths.values()
        raise DataError(
            f"{second}: moves by a polynomial of another degree than {first}, or one of them turns; expected the same: "
            "take one moment of them (`clsplat convert MODEL OUT --time T`)"
        )
    return [
        {**one, MOTION: one.get(MOTION, static_motion(len(one["means"]), *widths))} if widths else one for one in tables
    ]


def shift_time_center(
    tables: Mapping[str, NDArray[np.float64]], by: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return means, quaternions and motion of the same paths, told from centers that are `by`, [N], later in time."""
    motion, way = tables[MOTION].copy(), by[:, None]
    fields, still_there = motion_fields(motion.shape[1]), np.zeros((len(by), 3))
    first, second, third = (
        motion[:, fields[name]].copy() if name in fields else still_there
        for name in ("velocity", "acceleration", "jerk")
    )
    means = tables["means"] + first * way + second * way**2 + third * way**3
    motion[:, fields["time_center"]] += way
    motion[:, fields["velocity"]] = first + 2 * second * way + 3 * third * way**2
    if "acceleration" in fields:
        motion[:, fields["acceleration"]] = second + 3 * third * way
    quats = tables["quats"] + (motion[:, fields["turn"]] * way if "turn" in fields else 0)
    return {"means": means, "quats": quats, MOTION: motion}
