"""The table `motion` of Gaussians that move: its columns, and their names in a PLY.

With t the time of a view, in [0, 1] from the first to the last moment of a scene, and dt = t - time_centre:

    velocity_0..2      v, scene units by the duration of the scene
    time_centre        at which a Gaussian is at its mean and most opaque
    log_duration       log of s: its opacity is that at the centre times exp(-1/2 (dt / s)²)
    acceleration_0..2  coefficients of dt², with polynomials of degree 2 and 3
    jerk_0..2          coefficients of dt³, with those of degree 3
    turn_0..3          change of the quaternion by time, where Gaussians turn

    mean(t) = mean + velocity dt + acceleration dt² + jerk dt³      quat(t) = quat + turn dt

The number of columns says which there are: 5, 8 or 11, and 4 more with turns (FreeTimeGS, Wang et al. 2025, has the
first 5; Spacetime Gaussians, Li et al. 2024, the polynomials and turns).
"""

import math
from collections.abc import Collection

MOTION = "motion"
FIELDS = {"velocity": 3, "time_centre": 1, "log_duration": 1, "acceleration": 3, "jerk": 3, "turn": 4}
TURN = 4  # columns of the turn
MAX_DEGREE = 3
EXPECTED = "expected a number from 0, the first moment of the scene, to 1, its last"
STILL = 12.0  # log of a duration: what is there always, exp(-1/2 exp(-24)) being 1 in float32


def is_moment(time: float) -> bool:
    """Return whether a number is a moment of a scene."""
    return math.isfinite(time) and 0 <= time <= 1


def width_of(degree: int, turns: bool) -> int:
    """Return the number of columns for polynomials of a degree from 1 to 3."""
    return 2 + 3 * degree + TURN * turns


WIDTHS = {width_of(degree, turns): (degree, turns) for degree in range(1, MAX_DEGREE + 1) for turns in (False, True)}


def degree_of(width: int) -> int:
    """Return the degree of the polynomials of a table with so many columns."""
    return WIDTHS[width][0]


def fields_of(width: int) -> dict[str, slice]:
    """Return the columns of each field in a table with so many columns, by name, in their order."""
    degree, turns = WIDTHS[width]
    present = ["velocity", "time_centre", "log_duration", *("acceleration", "jerk")[: degree - 1], *["turn"] * turns]
    ends: dict[str, slice] = {}
    start = 0
    for name in present:
        ends[name] = slice(start, start + FIELDS[name])
        start += FIELDS[name]
    return ends


def columns_of(width: int) -> tuple[str, ...]:
    """Return the names of the columns in a PLY."""
    names = []
    for name in fields_of(width):
        names += [name] if FIELDS[name] == 1 else [f"{name}_{i}" for i in range(FIELDS[name])]
    return tuple(names)


def columns_among(names: Collection[str]) -> tuple[str, ...] | None:
    """Return the columns of the motion among the properties of a file; () of none, None of some but no whole table."""
    own = {column for width in WIDTHS for column in columns_of(width)} & set(names)
    return next((columns_of(width) for width in WIDTHS if set(columns_of(width)) == own), None) if own else ()
