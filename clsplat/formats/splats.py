"""What a model file holds, and what the formats share: names and widths of tables, activations, axes.

    means [3] scene units · quats [4] (w, x, y, z), unnormalized · log_scales [3] log of scene units
    logit_opacity [1] · sh_base [3] band 0 · sh_rest [(K-1)*3] the other bands, coefficient-major
    filter_variance [1] scene units², the world filter; only in our own PLY, as is
    motion [5 or more], where Gaussians move

Axes are those of the PLY of 3DGS: x right, y down, z ahead.
"""

import logging
import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError

# The table `motion` of Gaussians that move: its columns, and their names in a PLY.

MOTION = "motion"
FIELDS = {"velocity": 3, "time_center": 1, "log_duration": 1, "acceleration": 3, "jerk": 3, "turn": 4}
TURN = 4  # columns of the turn
MAX_DEGREE = 3
EXPECTED_TIME = "expected a number from 0, the first moment of the scene, to 1, its last"
STATIC_LOG_DURATION = 12.0  # log of a duration: what is there always, exp(-1/2 exp(-24)) being 1 in float32


def is_timestamp(time: float) -> bool:
    """Return whether a number is a moment of a scene."""
    return math.isfinite(time) and 0 <= time <= 1


def motion_width(degree: int, turns: bool) -> int:
    """Return the number of columns for polynomials of a degree from 1 to 3."""
    return 2 + 3 * degree + TURN * turns


WIDTHS = {
    motion_width(degree, turns): (degree, turns) for degree in range(1, MAX_DEGREE + 1) for turns in (False, True)
}


def motion_degree(width: int) -> int:
    """Return the degree of the polynomials of a table with so many columns."""
    return WIDTHS[width][0]


def motion_fields(width: int) -> dict[str, slice]:
    """Return the columns of each field in a table with so many columns, by name, in their order."""
    degree, turns = WIDTHS[width]
    present = ["velocity", "time_center", "log_duration", *("acceleration", "jerk")[: degree - 1], *["turn"] * turns]
    ends: dict[str, slice] = {}
    start = 0
    for name in present:
        ends[name] = slice(start, start + FIELDS[name])
        start += FIELDS[name]
    return ends


def motion_columns(width: int) -> tuple[str, ...]:
    """Return the names of the columns in a PLY."""
    names = []
    for name in motion_fields(width):
        names += [name] if FIELDS[name] == 1 else [f"{name}_{i}" for i in range(FIELDS[name])]
    return tuple(names)


def find_motion_columns(names: Collection[str]) -> tuple[str, ...] | None:
    """Return the columns of the motion among the properties of a file; () of none, None of some but no whole table."""
    own = {column for width in WIDTHS for column in motion_columns(width)} & set(names)
    return next((motion_columns(width) for width in WIDTHS if set(motion_columns(width)) == own), None) if own else ()


PARAMETERS = ("means", "quats", "log_scales", "logit_opacity", "sh_base", "sh_rest")
SH_C0 = 0.28209479177387814  # basis function of band 0
NEAR, VARIANCE = 0.2, 0.3  # scene units and px²: nearest distance and screen filter of 3DGS
MIP_VARIANCE = 0.1  # px², of files that say no more than `mip` (Yu et al. 2024)
MAX_FILE = 1 << 33  # bytes
MAX_VALUE = 1e15  # of LIMITED: beyond it neither viewers nor codebooks hold anything
LIMITED = ("log_scales", "sh_base", "sh_rest", MOTION)
MIN_ALPHA = 1e-6  # opacities of 0 and 1 have no logit
MAX_EXPONENT = 700.0  # of e in float64
MAX_LOG = 88.7  # of a scale in float32
FLAT_LOG_SCALE = -13.815511  # log 1e-6: of the third axis of a disc
FLIP_SH = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)  # y and z change sign: bands 1 to 3
Quality = Literal["small", "balanced", "high"]  # how finely SPZ and SOG are rounded
Parameters = dict[str, NDArray[np.float32]]  # by the names of PARAMETERS, each [N, components]
Floats = NDArray[np.floating]
LOG = logging.getLogger("clsplat")


@dataclass(frozen=True)
class SplatFile:
    """A model file: the parameters, and the numbers of its comment for rendering them."""

    parameters: Parameters  # filter_variance too, where the file has it
    rendering: dict[str, Any] = field(default_factory=dict)
    mode: str = "default"  # `mip` where a screen filter reduces opacities to keep their energy
    placement: NDArray[np.float64] | None = None  # [4, 4], by which the Gaussians are still to be moved

    def __len__(self) -> int:
        return len(self.parameters["means"])

    @property
    def sh_degree(self) -> int:
        """Highest degree of the spherical harmonics."""
        return sh_degree_of(self.parameters["sh_rest"].shape[1])

    @property
    def has_sky(self) -> bool:
        """Whether some Gaussians are a sky, as clsplat/gaussians/conversion.py notes in the comment."""
        return bool(self.rendering.get("sky") == "splats")

    def rows(self, chosen: Any) -> "SplatFile":
        """Return some of the Gaussians, in the order that is given."""
        return replace(self, parameters={name: table[chosen] for name, table in self.parameters.items()})


@dataclass(frozen=True)
class Reading:
    """What a file does not say about itself."""

    axes: Literal["spz", "ply"] = "spz"  # of an SPZ file: as its specification says, or those of a PLY, unturned
    not_finite: Literal["refuse", "drop", "keep"] = "refuse"  # Gaussians with NaN or infinity
    quiet: bool = False  # no line about the axes of an SPZ file: whoever reads it wrote it


@dataclass(frozen=True)
class Writing:
    """How a model is written, where a format leaves a choice."""

    sh_bits: tuple[int, int] | None = None  # SPZ: bits of band 1 and of the others, from 1 to 8; None: as `quality`
    axes: Literal["spz", "ply"] = "spz"  # SPZ: as its specification says, or those of the PLY, for readers that differ
    quality: Quality = "balanced"  # SPZ and SOG
    quiet: bool = False  # no line about what the format does not keep: it was said


def sh_coefficients(degree: int) -> int:
    """Return the number K of basis functions up to `degree`."""
    return (degree + 1) ** 2


def sh_degree_of(columns: int) -> int:
    """Return the SH degree of a table sh_rest with so many columns."""
    degree: int = round((1 + columns / 3) ** 0.5) - 1
    return degree


def with_degree(parameters: Parameters, degree: int) -> Parameters:
    """Return the Gaussians with more or fewer SH bands."""
    columns = 3 * (sh_coefficients(degree) - 1)
    rest = parameters["sh_rest"][:, :columns]
    padding = np.zeros((len(rest), columns - rest.shape[1]), np.float32)
    return {**parameters, "sh_rest": np.concatenate([rest, padding], axis=1)}


def logits(alpha: Floats) -> NDArray[np.float32]:
    """Return the logits of opacities in [0, 1]; 0 and 1 become MIN_ALPHA and 1 - MIN_ALPHA."""
    inside = np.clip(alpha.astype(np.float64), MIN_ALPHA, 1 - MIN_ALPHA)
    return np.asarray(np.log(inside / (1 - inside)), np.float32)


def opacities(logit: Floats) -> NDArray[np.float64]:
    """Return opacities in [0, 1] of logits, to 1e-16."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * logit.astype(np.float64)))


def inverse_opacities(logit: Floats) -> NDArray[np.float64]:
    """Return 1 / opacity of logits, in which faint ones keep their digits; finite for all that are."""
    return np.asarray(1 + np.exp(np.minimum(-logit.astype(np.float64), MAX_EXPONENT)))


def logs(scales: Floats) -> NDArray[np.float32]:
    """Return the logarithms of scales; those of 0 become FLAT_LOG_SCALE."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.log(scales.astype(np.float64))
    return np.where(scales == 0, FLAT_LOG_SCALE, found).astype(np.float32)


def unit(quats: Floats) -> NDArray[np.float64]:
    """Return unit quaternions [N, 4]; those of length 0 become (1, 0, 0, 0)."""
    wide = quats.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length > 0, wide / length, [1.0, 0, 0, 0])


def flip_axes(parameters: Parameters) -> Parameters:
    """Return the Gaussians in axes whose y and z point the other way: up and back for down and ahead, or back again."""
    signs = _signs(parameters)
    return {name: table * signs[name] if name in signs else table for name, table in parameters.items()}


def flip_axes_in_place(parameters: Parameters) -> None:
    """Turn the Gaussians as `flip_axes` does, in place."""
    for name, signs in _signs(parameters).items():
        parameters[name] *= signs


def _signs(parameters: Parameters) -> Parameters:
    rest = np.repeat(FLIP_SH, 3)[: parameters["sh_rest"].shape[1]]
    signs = {"means": (1, -1, -1), "quats": (1, 1, -1, -1), "sh_rest": rest}
    return {name: np.array(values, np.float32) for name, values in signs.items()}


def reorder_columns(table: NDArray[np.float32], outer: int, inner: int) -> NDArray[np.float32]:
    """Return columns in outer-major order as inner-major ones, [N, outer * inner]."""
    count = len(table)
    moved = table.reshape(count, outer, inner).transpose(0, 2, 1)
    return np.ascontiguousarray(moved.reshape(count, outer * inner))


def not_finite(parameters: Parameters) -> NDArray[np.bool_]:
    """Return which Gaussians hold NaN or infinity, [N]."""
    found = np.zeros(len(parameters["means"]), np.bool_)
    for table in parameters.values():
        found |= ~np.isfinite(table).all(axis=1)
    return found


def too_large(parameters: Parameters) -> NDArray[np.bool_]:
    """Return which Gaussians hold finite logarithms of scales, coefficients or motions beyond LARGEST, [N]."""
    return np.asarray(np.any([_beyond(parameters[name]) for name in LIMITED if name in parameters], axis=0))


def too_large_message(parameters: Parameters) -> str:
    """Say how many Gaussians hold values that are too large, and of which tables; '' of none."""
    if not (count := int(too_large(parameters).sum())):
        return ""
    names = ", ".join(name for name in LIMITED if name in parameters and _beyond(parameters[name]).any())
    return f"{count:,} of {len(parameters['means']):,} Gaussians hold {names} beyond {MAX_VALUE:g}"


def _beyond(table: Floats) -> NDArray[np.bool_]:
    """Which rows hold finite values beyond LARGEST, [N]."""
    size = np.abs(table)
    return np.asarray(((size > MAX_VALUE) & (size < np.inf)).any(axis=1))


def apply_not_finite(path: Path, splats: SplatFile, options: Reading) -> SplatFile:
    """Refuse, drop or keep Gaussians that are not finite; drop those that are too large, too.  Raises DataError."""
    bad = not_finite(splats.parameters)
    if options.not_finite == "drop":
        if told := too_large_message(splats.parameters):
            LOG.warning("%s: %s; they are dropped", path, told)
        if bad.any():
            LOG.warning("%s: dropped %s Gaussians with values that are not finite", path, f"{int(bad.sum()):,}")
        bad |= too_large(splats.parameters)
        return splats.rows(~bad) if bad.any() else splats
    if options.not_finite == "keep" or not bad.any():
        return splats
    names = [name for name, table in splats.parameters.items() if not_finite({"means": table}).any()]
    raise DataError(
        f"{path}: {', '.join(names)} hold values that are not finite; export the file again, or drop those Gaussians "
        "with `clsplat convert`"
    )


def require_in_range(path: Path, splats: SplatFile, name: str) -> None:
    """Raise DataError for values that the format `name` cannot hold."""
    if told := too_large_message(splats.parameters):
        raise DataError(f"{path}: {told}, which {name} cannot hold; `clsplat convert MODEL OTHER.ply` drops them")


def require_static(path: Path, splats: SplatFile, name: str) -> None:
    """Raise DataError for Gaussians that move, which the format `name` cannot hold."""
    if MOTION in splats.parameters:
        raise DataError(
            f"{path}: the Gaussians move, which {name} cannot hold; write a PLY, or one moment: `clsplat convert MODEL "
            "OUT --time T`, `--frames N` for several, or `model.at(time)`"
        )


def require_size(path: Path, held: int, expected: int, what: str) -> None:
    """Raise DataError where a file holds fewer bytes than its header declares."""
    if held < expected:
        raise DataError(
            f"{path}: holds {held} bytes, but its header declares {what}, {expected} bytes; "
            "the file is truncated: copy or export it again"
        )


def require_gaussians(path: Path, splats: SplatFile) -> None:
    """Raise DataError for a model without Gaussians, which most formats do not know."""
    if not len(splats):
        raise DataError(f"{path}: the model holds no Gaussians; a PLY can hold none")
