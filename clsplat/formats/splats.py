"""Define the parameters, activations, axes, and checks that all formats share.

    means [3] scene units · quats [4] (w, x, y, z), unnormalized · log_scales [3] log of scene units
    logit_opacity [1] · sh_base [3] band 0 · sh_rest [(K-1)*3] the other bands, coefficient-major
    filter_variance [1] scene units², the world filter; only in clsplat's PLY
    motion [5 or more], for moving Gaussians; only in clsplat's PLY

Axes are those of a 3DGS PLY: x right, y down, z forward.
"""

import logging
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, MemoryLimitError
from clsplat.core.harmonics import rotate_sh
from clsplat.core.machine import available_memory
from clsplat.core.quaternions import multiply, unit_quaternions

# The columns of the table `motion` and their names in a PLY.

MOTION = "motion"
FIELDS = {"velocity": 3, "time_center": 1, "log_duration": 1, "acceleration": 3, "jerk": 3, "turn": 4}
TURN = 4  # columns of the time derivative of the quaternion
MAX_DEGREE = 3
EXPECTED_TIME = "expected a timestamp from 0, the start of the scene, to 1, its end"
STATIC_LOG_DURATION = 12.0  # log duration of a Gaussian that is always visible: exp(-1/2 exp(-24)) is 1 in float32


def is_timestamp(time: float) -> bool:
    """Return whether a number is a valid timestamp, in [0, 1]."""
    return math.isfinite(time) and 0 <= time <= 1


def motion_width(degree: int, has_turn: bool) -> int:
    """Return the number of columns of a motion table.

    degree: degree of the polynomials, 1 to 3; has_turn: whether Gaussians rotate.
    """
    return 2 + 3 * degree + TURN * has_turn


WIDTHS = {motion_width(degree, turn): (degree, turn) for degree in range(1, MAX_DEGREE + 1) for turn in (False, True)}


def motion_degree(width: int) -> int:
    """Return the polynomial degree of a motion table with `width` columns."""
    return WIDTHS[width][0]


def motion_fields(width: int) -> dict[str, slice]:
    """Return the column slices of the fields of a motion table with `width` columns, by field name, in order."""
    degree, has_turn = WIDTHS[width]
    names = ["velocity", "time_center", "log_duration", *("acceleration", "jerk")[: degree - 1], *["turn"] * has_turn]
    ends = accumulate(FIELDS[name] for name in names)
    return {name: slice(end - FIELDS[name], end) for name, end in zip(names, ends, strict=True)}


def motion_columns(width: int) -> tuple[str, ...]:
    """Return the PLY property names of a motion table with `width` columns."""
    names = []
    for name in motion_fields(width):
        names += [name] if FIELDS[name] == 1 else [f"{name}_{i}" for i in range(FIELDS[name])]
    return tuple(names)


def find_motion_columns(names: Collection[str]) -> tuple[str, ...] | None:
    """Return the motion columns in a file's properties; () if there are none, and None if some are missing."""
    columns = {column for width in WIDTHS for column in motion_columns(width)} & set(names)
    return next((table for table in ((), *map(motion_columns, WIDTHS)) if set(table) == columns), None)


PARAMETERS = ("means", "quats", "log_scales", "logit_opacity", "sh_base", "sh_rest")
MAX_STORED_DEGREE = 4  # largest SH degree in files; bands beyond MAX_DEGREE are dropped
SH_C0 = 0.28209479177387814  # basis function of band 0
VARIANCE = 0.3  # px²: screen filter of 3DGS
NEAR_FRACTION = 0.04  # default near plane, relative to the median distance of the means from their center
MIP_VARIANCE = 0.1  # px²: screen filter of files that only say `mip` (Yu et al. 2024)
MAX_FILE = 1 << 33  # bytes of the largest file
MAX_VALUE = 1e15  # largest absolute value in the tables of BOUNDED; viewers and codebooks fail beyond it
BOUNDED = ("log_scales", "sh_base", "sh_rest", MOTION)
APPLY_TRANSFORM = "apply it in the program that exported the file, and export again"  # remedy in errors
MIN_ALPHA = 1e-6  # opacities of 0 and 1 have no logit
# fraction of out-of-range values above which another unit is assumed; mirrored axes also have negative scales
MIN_OUTSIDE = 0.5
MAX_EXPONENT = 700.0  # largest argument of exp in float64
MAX_LOG = 88.7  # largest log scale in float32; exp overflows beyond it
FLAT_LOG_SCALE = -13.815511  # log 1e-6: for the third axis of a 2DGS disc
FLATNESS = -6.907755  # log 1e-3: largest ratio of that axis to the others
# for each basis function of bands 1 to 3, the axes along which it is odd
PARITY = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
FLIP = (1.0, -1.0, -1.0)  # converts between y down, z forward and y up, z back
FLIP_4 = np.diag([*FLIP, 1.0])  # the same for matrices, [4, 4]
Quality = Literal["small", "balanced", "high"]  # precision of SPZ and SOG
Parameters = dict[str, NDArray[np.float32]]  # by the names in PARAMETERS, each [N, components]
Floats = NDArray[np.floating]
LOG = logging.getLogger("clsplat")


@dataclass(frozen=True)
class SplatFile:
    """The content of a model file: the parameters and the rendering settings."""

    parameters: Parameters  # including filter_variance and motion if the file has them
    rendering: dict[str, Any] = field(default_factory=dict)
    mode: str = "default"  # `mip`: a screen filter reduces opacities to conserve energy
    placement: NDArray[np.float64] | None = None  # [4, 4], a transform still to be applied

    def __len__(self) -> int:
        return len(self.parameters["means"])

    @property
    def sh_degree(self) -> int:
        """The SH degree."""
        return columns_to_sh_degree(self.parameters["sh_rest"].shape[1])

    @property
    def has_sky(self) -> bool:
        """Whether some Gaussians represent the sky, as marked by clsplat/gaussians/conversion.py."""
        return bool(self.rendering.get("sky") == "splats")

    def rows(self, indices: Any) -> "SplatFile":
        """Return the Gaussians at the given rows, in that order."""
        return replace(self, parameters={name: table[indices] for name, table in self.parameters.items()})


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a model."""

    not_finite: Literal["refuse", "drop", "keep"] = "refuse"  # what to do with Gaussians that contain NaN or infinity
    quiet: bool = False  # do not log about the axes of an SPZ file


@dataclass(frozen=True)
class WriteOptions:
    """Options for writing a model."""

    quality: Quality = "balanced"  # precision of SPZ and SOG files
    quiet: bool = False  # do not warn about what the format does not store
    world: bool = False  # write world coordinates, and no origin
    collider: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None  # for OpenUSD: world vertices, [V, 3]; faces


def sh_coefficients(degree: int) -> int:
    """Return the number K of basis functions up to `degree`."""
    return (degree + 1) ** 2


def columns_to_sh_degree(columns: int) -> int:
    """Return the SH degree of a table sh_rest with `columns` columns."""
    degree: int = round((1 + columns / 3) ** 0.5) - 1
    return degree


def with_degree(parameters: Parameters, degree: int) -> Parameters:
    """Return the parameters with SH bands up to `degree`; missing bands are zero."""
    columns = 3 * (sh_coefficients(degree) - 1)
    rest = parameters["sh_rest"][:, :columns]
    padding = np.zeros((len(rest), columns - rest.shape[1]), np.float32)
    return {**parameters, "sh_rest": np.concatenate([rest, padding], axis=1)}


def concatenate(parts: Sequence[Parameters]) -> Parameters:
    """Concatenate the Gaussians of several models, with their largest SH degree."""
    degree = max(columns_to_sh_degree(part["sh_rest"].shape[1]) for part in parts)
    tables = [with_degree(part, degree) for part in parts]
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def logits(alpha: Floats) -> NDArray[np.float32]:
    """Convert opacities in [0, 1] to logits.  0 and 1 are replaced with MIN_ALPHA and 1 - MIN_ALPHA."""
    clipped_alpha = np.clip(alpha.astype(np.float64), MIN_ALPHA, 1 - MIN_ALPHA)
    return np.asarray(np.log(clipped_alpha / (1 - clipped_alpha)), np.float32)


def opacities(logit: Floats) -> NDArray[np.float64]:
    """Convert logits to opacities in [0, 1], accurate to 1e-16."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * logit.astype(np.float64)))


def inverse_opacities(logit: Floats) -> NDArray[np.float64]:
    """Convert logits to 1 / opacity, precise for faint Gaussians and always finite."""
    return np.asarray(1 + np.exp(np.minimum(-logit.astype(np.float64), MAX_EXPONENT)))


def logs(scales: Floats) -> NDArray[np.float32]:
    """Return the logarithms of scales, with FLAT_LOG_SCALE for a scale of 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(scales.astype(np.float64))
    return np.where(scales == 0, FLAT_LOG_SCALE, log_scales).astype(np.float32)


def normalize_quats(quats: Floats) -> NDArray[np.float64]:
    """Normalize quaternions, [N, 4]; quaternions of length 0 become (1, 0, 0, 0)."""
    doubles = quats.astype(np.float64)
    length = np.linalg.norm(doubles, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length > 0, doubles / length, [1.0, 0, 0, 0])


def flip_axes(parameters: Parameters, axes: Sequence[float] = FLIP) -> Parameters:
    """Return the parameters with each axis multiplied by 1 or -1."""
    signs = _signs(parameters, axes)
    return {name: table * signs[name] if name in signs else table for name, table in parameters.items()}


def flip_axes_in_place(parameters: Parameters, axes: Sequence[float] = FLIP) -> None:
    """Multiply each axis by 1 or -1 as `flip_axes` does, in place."""
    for name, signs in _signs(parameters, axes).items():
        parameters[name] *= signs


def _signs(parameters: Parameters, axes: Sequence[float]) -> Parameters:
    """Return the factor, 1 or -1, of each column, for each table that changes when axes are flipped."""
    by_axis = dict(zip("xyz", axes, strict=True))
    (x, y, z), parities = axes, [math.prod(by_axis[axis] for axis in names) for names in PARITY]
    sh_signs = np.repeat(parities, 3)[: parameters["sh_rest"].shape[1]]
    signs = {"means": axes, "quats": (1, y * z, x * z, x * y), "sh_rest": sh_signs}
    return {name: np.array(values, np.float32) for name, values in signs.items()}


def transform(
    parameters: Parameters, scale: float, rotation: NDArray[np.float64], translation: Any
) -> dict[str, NDArray[np.float64]]:
    """Apply the transform x -> scale · rotation x + translation, and return the changed tables.

    Raises ValueError for a matrix that is not a rotation, and for a scale that is not positive.
    """
    if not scale > 0 or rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5):
        raise ValueError("expected a rotation with a uniform, positive scale")
    if np.linalg.det(rotation) < 0:
        raise ValueError("expected a rotation; this matrix is a reflection")
    return {
        "means": scale * parameters["means"].astype(np.float64) @ rotation.T + translation,
        "quats": multiply(unit_quaternions(rotation), parameters["quats"].astype(np.float64)),
        "log_scales": parameters["log_scales"] + np.log(scale),
        "sh_rest": rotate_sh(parameters["sh_rest"], rotation),
    }


def join_parts(
    path: Path, parts: Iterable[tuple[Parameters, NDArray[np.float64]]]
) -> tuple[Parameters, NDArray[np.float64] | None]:
    """Return the Gaussians of all parts relative to the first, and the placement of the first (None: the identity).

    parts: Gaussians in the axes of a PLY, and a matrix, [4, 4], in axes with y up and z back.  Raises DataError.
    """
    first, joined = None, []
    for part, matrix in parts:
        first = matrix if first is None else first
        if not np.allclose(matrix, first, rtol=1e-7):
            relative = FLIP_4 @ np.linalg.inv(first) @ matrix @ FLIP_4
            scale = float(np.cbrt(np.linalg.det(relative[:3, :3])))
            try:
                tables = transform(part, scale, relative[:3, :3] / (scale or 1), relative[:3, 3])
            except ValueError as error:
                fault = f"the transform of a node is not supported ({error})"
                raise DataError(f"{path}: {fault}; {APPLY_TRANSFORM}") from error
            part = part | {name: table.astype(np.float32) for name, table in tables.items()}
        joined.append(part)
    placement = np.eye(4) if first is None else FLIP_4 @ first @ FLIP_4
    return concatenate(joined), None if np.allclose(placement, np.eye(4)) else placement


def reorder_columns(table: NDArray[np.float32], outer: int, inner: int) -> NDArray[np.float32]:
    """Convert columns from outer-major to inner-major order, [N, outer * inner]."""
    count = len(table)
    transposed = table.reshape(count, outer, inner).transpose(0, 2, 1)
    return np.ascontiguousarray(transposed.reshape(count, outer * inner))


def not_finite(parameters: Parameters) -> NDArray[np.bool_]:
    """Return a mask of the Gaussians with NaN or infinity, [N]."""
    return np.asarray(np.any([~np.isfinite(table).all(axis=1) for table in parameters.values()], axis=0))


def typical_size(means: NDArray[np.floating]) -> float:
    """Return the median distance of means, [N, 3], from their center, scene units; if it is 0, the largest distance."""
    valid = means[np.isfinite(means).all(axis=1)].astype(np.float64)
    distances = np.linalg.norm(valid - np.median(valid, axis=0), axis=1) if len(valid) else np.zeros(1)
    return float(np.median(distances)) or float(distances.max()) or 1.0


def default_near(means: NDArray[np.floating]) -> float:
    """Return the default near plane for Gaussians with these means, [N, 3], scene units."""
    return NEAR_FRACTION * typical_size(means)


def exceeds_limit(parameters: Parameters) -> NDArray[np.bool_]:
    """Return a mask, [N], of the Gaussians with finite log scales, SH coefficients, or motions beyond MAX_VALUE."""
    return np.asarray(np.any([_row_exceeds_limit(parameters[name]) for name in BOUNDED if name in parameters], axis=0))


def too_large_message(parameters: Parameters) -> str:
    """Describe how many Gaussians have values that are too large, and in which tables; '' if there are none."""
    if not (count := int(exceeds_limit(parameters).sum())):
        return ""
    names = ", ".join(name for name in BOUNDED if name in parameters and _row_exceeds_limit(parameters[name]).any())
    return f"{count:,} of {len(parameters['means']):,} Gaussians have {names} beyond {MAX_VALUE:g}"


def _row_exceeds_limit(table: Floats) -> NDArray[np.bool_]:
    """Return a mask of the rows with finite values beyond MAX_VALUE, [N]."""
    magnitude = np.abs(table)
    return np.asarray(((magnitude > MAX_VALUE) & (magnitude < np.inf)).any(axis=1))


def clamp_limits(path: Path, splats: SplatFile, options: ReadOptions) -> SplatFile:
    """Replace infinite logits (opacities 0 and 1) and log scales (zero scales) with finite values, and warn."""
    logit, log_scales = (splats.parameters[name] for name in ("logit_opacity", "log_scales"))
    is_infinite, is_flat = np.isinf(logit), np.isneginf(log_scales)
    if not (count := int((is_infinite.any(axis=1) | is_flat.any(axis=1)).sum())):
        return splats
    if not options.quiet:
        fault = f"{count:,} Gaussians have an opacity of 0 or 1, or a scale of 0, whose logit or logarithm is infinite"
        LOG.warning("%s: %s; their opacities or scales are changed by %g", path, fault, MIN_ALPHA)
    finite_logit = np.where(is_infinite, logits((logit > 0).astype(np.float32)), logit)
    finite_scales = np.where(is_flat, np.float32(FLAT_LOG_SCALE), log_scales)
    finite_tables = {"logit_opacity": finite_logit, "log_scales": finite_scales}
    return replace(splats, parameters={**splats.parameters, **finite_tables})


def scales_to_logs(scales: Floats, notes: set[str]) -> NDArray[np.float32]:
    """Return the logarithms of scales.  If most are negative, assume that they are logarithms, and add a note."""
    if np.count_nonzero(scales < 0) > MIN_OUTSIDE * scales.size:
        notes.add("its scales are negative: they are read as logarithms")
        return scales.astype(np.float32)
    return logs(np.abs(scales))


def opacities_to_logits(alpha: Floats, notes: set[str]) -> NDArray[np.float32]:
    """Return the logits of opacities.  If most are outside [0, 1], assume that they are logits, and add a note."""
    if np.count_nonzero((alpha < 0) | (alpha > 1)) > MIN_OUTSIDE * alpha.size:
        notes.add("its opacities are outside of 0 to 1: they are read as logits")
        return alpha.astype(np.float32)
    return logits(alpha)


def handle_not_finite(path: Path, splats: SplatFile, options: ReadOptions) -> SplatFile:
    """Reject, drop, or keep Gaussians with NaN or infinity, depending on `options.not_finite`.

    "drop" also drops Gaussians with values that are too large, or with quaternions of length 0.  Raises DataError.
    """
    is_invalid = not_finite(splats.parameters)
    if options.not_finite == "drop":
        if message := too_large_message(splats.parameters):
            LOG.warning("%s: %s; they are dropped", path, message)
        if is_invalid.any():
            LOG.warning("%s: dropped %s Gaussians with values that are not finite", path, f"{int(is_invalid.sum()):,}")
        is_invalid |= exceeds_limit(splats.parameters)
        has_rotation = splats.parameters["quats"].any(axis=1)
        if count := int((~has_rotation).sum()):
            LOG.warning("%s: dropped %s Gaussians with quaternions of length 0", path, f"{count:,}")
        is_invalid |= ~has_rotation
        return splats.rows(~is_invalid) if is_invalid.any() else splats
    if options.not_finite == "keep" or not is_invalid.any():
        return splats
    names = [name for name, table in splats.parameters.items() if not_finite({"means": table}).any()]
    raise DataError(
        f"{path}: {', '.join(names)} have values that are not finite; export the file again, or drop those Gaussians "
        "with `clsplat convert`"
    )


def require_in_range(path: Path, splats: SplatFile, name: str) -> None:
    """Raise DataError for values that the format `name` cannot store."""
    if message := too_large_message(splats.parameters):
        raise DataError(f"{path}: {message}; {name} cannot store these: `clsplat convert MODEL OTHER.ply` drops them")


def require_static(path: Path, splats: SplatFile, name: str) -> None:
    """Raise DataError for moving Gaussians, which the format `name` cannot store."""
    if MOTION in splats.parameters:
        raise DataError(
            f"{path}: {name} cannot store moving Gaussians; write a PLY, or a single frame: `clsplat convert "
            "MODEL OUT --time T` (`--frames N` for several), or `model.at(time)` in Python"
        )


def require_size(path: Path, size: int, expected: int, content: str) -> None:
    """Raise DataError if a file has fewer bytes than its header declares."""
    if size < expected:
        raise DataError(
            f"{path}: has {size} bytes, but its header declares {content}, {expected} bytes; "
            "the file is truncated: copy or export it again"
        )


def require_memory(path: Path, count: int, degree: int = MAX_DEGREE) -> None:
    """Raise MemoryLimitError, before allocating, if the tables of `count` Gaussians exceed the free memory."""
    size, free = 4 * count * (11 + 3 * sh_coefficients(degree)), available_memory()
    if free is not None and size > free:
        raise MemoryLimitError(
            f"{path}: declares {count:,} Gaussians, which need {size / 2**30:.1f} GiB of memory, but only "
            f"{free / 2**30:.1f} GiB is free; use a machine with more memory, or a smaller model"
        )


def warn_dropped(path: Path, degree: int) -> None:
    """Log a warning about SH bands beyond MAX_DEGREE, which readers drop."""
    if degree > MAX_DEGREE:
        LOG.warning("%s: dropped the SH bands of degree %d", path, degree)


def require_gaussians(path: Path, splats: SplatFile) -> None:
    """Raise DataError for a model without Gaussians, which most formats cannot store."""
    if not len(splats):
        raise DataError(f"{path}: the model has no Gaussians; only a PLY can be empty")
