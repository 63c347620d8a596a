"""Model files into one of another format: merged, moved, cropped, and with fewer Gaussians or harmonics."""

import logging
import math
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, quote
from clsplat.core.files import check_not_run_file, path_exists, raising_output_error, scratch_folder
from clsplat.formats.ply import MAX_NUMBER
from clsplat.formats.splats import (
    EXPECTED_TIME,
    MAX_DEGREE,
    SH_C0,
    Parameters,
    Quality,
    Reading,
    Writing,
    is_timestamp,
    sh_coefficients,
    with_degree,
)
from clsplat.formats.table import format_of_name, model_bytes, writing_format
from clsplat.gaussians.model import Model, load, model_path
from clsplat.gaussians.motion import static_motion, with_motion
from clsplat.gaussians.sky import sample_texels, sky_path
from clsplat.scene.scene import PointCloud

# Several models as one.

LOG = logging.getLogger("clsplat")
KEPT = ("near", "screen_variance", "background", "alpha")  # of the first model


def merge_models(models: Sequence[Model], names: Sequence[str]) -> Model:
    """Return one model of all Gaussians, with the numbers of the first for rendering and the largest SH degree.

    Where one has a world filter and another has none, it is baked; where some move, the others stand still.  Raises
    DataError where some are mip models and others are not, or of the pixel's box, for one filter serves all, and where
    they move in different ways.
    """
    first = models[0]
    if len(models) == 1:
        return first
    for model, name in zip(models, names, strict=True):
        kinds = [_kind(m) for m in (first, model)]
        if kinds[0] != kinds[1]:
            raise DataError(f"{name}: is {kinds[1]}, {names[0]} is {kinds[0]}; expected the same: one filter draws all")
        own, kept = model.rendering.comment(), first.rendering.comment()
        if other := [f"{one} = {own.get(one, 'not given')}" for one in KEPT if own.get(one) != kept.get(one)]:
            LOG.warning("%s: has %s; what %s says is kept", name, ", ".join(other), names[0])
    if any(model.filter_variance is None for model in models):
        models = [model.baked() for model in models]
    degree = max(model.sh_degree for model in models)
    tables = with_motion([with_degree(model.tables(), degree) for model in models], names)
    merged: dict[str, Any] = {n: np.concatenate([t[n] for t in tables]) for n in tables[0]}
    return Model(**merged, rendering=first.rendering, sky=first.sky)


def _kind(model: Model) -> str:
    """Say whether a model is a mip model."""
    if model.rendering.pixel_box:
        return "one of the pixel's box"
    return "a mip model" if model.rendering.compensate else "none"


WORDS = ("scale", "rotate", "translate")
QUALITIES = get_args(Quality)


@dataclass(frozen=True)
class Changes:
    """What is done to a model, in this order."""

    drop_below: float = 0.0  # opacity: fainter Gaussians go
    transform: NDArray[np.float64] | None = None  # [4, 4], one scale, a rotation and a translation
    crop: tuple[float, ...] | None = None  # x0, y0, z0, x1, y1, z1, scene units: means outside go
    sh_degree: int | None = None  # at most
    time: float | None = None  # of a moving model: that moment of it

    def apply(self, model: Model) -> Model:
        """Return the changed model.  Raises DataError where nothing is left, ConfigError for a transform too far."""
        model = model if self.time is None else _at(model, self.time)
        kept = model[model.opacities >= self.drop_below] if self.drop_below else model
        if self.transform is not None:
            scale = round(float(np.cbrt(np.linalg.det(self.transform[:3, :3]))), 12)
            try:
                kept = kept.transformed(scale, self.transform[:3, :3] / scale, self.transform[:3, 3])
            except ValueError as error:
                raise ConfigError(f"--transform: {error}") from error
        if self.crop is not None:
            low, high = np.array(self.crop, np.float64).reshape(2, 3)
            kept = kept[((kept.means >= low) & (kept.means <= high)).all(axis=1)]
        if self.sh_degree is not None and self.sh_degree < kept.sh_degree:
            kept = replace(kept, sh_rest=with_degree(kept.tables(), self.sh_degree)["sh_rest"])
        if not len(kept) and len(model):
            raise DataError(f"none of {len(model):,} Gaussians is left; expected some inside of the crop and as opaque")
        return kept


def writing_options(out: Path, quality: Quality) -> Writing:
    """Return how a file is written.  Raises ConfigError for a quality that there is not, or that its format has not."""
    if quality not in QUALITIES:
        raise ConfigError(f"--quality {quote(quality)}: expected one of {', '.join(QUALITIES)}")
    if quality != "balanced" and not writing_format(out).has_quality:
        raise ConfigError(f"{out}: --quality is of SPZ and SOG; expected a name that ends in .spz or .sog")
    return Writing(quality)


def convert(
    sources: Sequence[Path], out: Path, changes: Changes | None = None, quality: Quality = "balanced"
) -> dict[str, Any]:
    """Read model files or run folders, and write one file of all their Gaussians, in the format of its name.

    Returns `file`, `format`, `gaussians`, `bytes` and the `bytes_read`.  Raises ConfigError, DataError, OutputError.
    """
    if not sources:
        raise ConfigError("convert: expected a model file to read, and one to write")
    check_output(sources, out)
    writing = writing_options(out, quality)
    return write_model(sources, (changes or Changes()).apply(read(sources)), out, writing)


def read(sources: Sequence[Path]) -> Model:
    """Return one model of all Gaussians of model files or run folders.  Raises DataError."""
    return merge_models(
        [load(source, Reading(not_finite="drop")) for source in sources], [str(source) for source in sources]
    )


def write_model(sources: Sequence[Path], model: Model, out: Path, writing: Writing) -> dict[str, Any]:
    """Write a model that was read from sources, and return what `convert` does.  Raises OutputError."""
    size = sum(model_bytes(model_path(source)) for source in sources)
    model.save(out, writing)
    kind = writing_format(out).name
    return {"file": str(out), "format": kind, "gaussians": len(model), "bytes": model_bytes(out), "bytes_read": size}


def check_output(sources: Sequence[Path], out: Path) -> None:
    """Raise ConfigError where the file to write is one of those that are read, or belongs to a run."""
    if any(_is_same(out, model_path(source)) for source in sources):
        raise ConfigError(f"{out}: is one of the files that are read; give another name")
    check_not_run_file(out)


def parse_transform(text: str) -> NDArray[np.float64]:
    """Return the matrix [4, 4] of words such as `scale=2 rotate=90,0,0 translate=0,1,0`, done from left to right.

    Rotations are in degrees about x, then y, then z.  12 or 16 numbers, with commas, are a matrix row by row.
    Raises ConfigError.
    """
    expected = (
        f"--transform {quote(text)}: expected scale=S, rotate=X,Y,Z (degrees) and translate=X,Y,Z with blanks "
        "between, or the 12 or 16 numbers of a matrix, row by row"
    )
    try:
        if "=" not in text:
            numbers = [float(part) for part in text.replace(",", " ").split()]
            bottom = [] if len(numbers) == 16 else [0, 0, 0, 1]
            matrix = np.array([*numbers, *bottom]).reshape(4, 4)
        else:
            matrix = np.eye(4)
            for part in text.split():
                word, _, values = part.partition("=")
                with np.errstate(over="ignore", invalid="ignore"):  # told below
                    matrix = _step(word, [float(value) for value in values.split(",")]) @ matrix
    except ValueError as error:
        raise ConfigError(expected) from error
    turned = matrix[:3, :3]
    if not np.abs(matrix).max() < MAX_NUMBER or not (np.abs(turned).max() or 1) > 1 / MAX_NUMBER:
        raise ConfigError(
            f"--transform {quote(text)}: expected a scale from {1 / MAX_NUMBER:g} to {MAX_NUMBER:g}, and a "
            "translation below that"
        )
    scale2 = turned @ turned.T
    if (
        not np.allclose(matrix[3], [0, 0, 0, 1])
        or np.linalg.det(turned) <= 0
        or not np.allclose(scale2, scale2[0, 0] * np.eye(3), atol=1e-5 * scale2[0, 0])
    ):
        raise ConfigError(f"--transform {quote(text)}: stretches or mirrors; expected one scale and a rotation")
    return matrix


def _step(word: str, values: list[float]) -> NDArray[np.float64]:
    """The matrix of one word.  Raises ValueError."""
    from scipy.spatial.transform import Rotation

    if word not in WORDS or len(values) != (1 if word == "scale" else 3):
        raise ValueError(word)
    matrix = np.eye(4)
    if word == "scale":
        matrix[:3, :3] *= values[0]
    elif word == "rotate":
        matrix[:3, :3] = Rotation.from_euler("xyz", values, degrees=True).as_matrix()
    else:
        matrix[:3, 3] = values
    return matrix


def parse_crop(text: str) -> tuple[float, ...]:
    """Return the box of `x0,y0,z0,x1,y1,z1`.  Raises ConfigError."""
    try:
        box = tuple(float(part) for part in text.split(","))
    except ValueError:
        box = ()
    if len(box) != 6 or not all(low <= high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ConfigError(f"--crop {quote(text)}: expected x0,y0,z0,x1,y1,z1, the least first, in scene units")
    return box


def check_degree(degree: int | None) -> int | None:
    """Return an SH degree.  Raises ConfigError for one that there is not."""
    if degree is not None and not 0 <= degree <= MAX_DEGREE:
        raise ConfigError(f"--sh-degree {degree}: expected 0 to {MAX_DEGREE}")
    return degree


def _at(model: Model, time: float) -> Model:
    """A moment of a model that moves.  Raises ConfigError for one that does not, DataError where nothing is shown."""
    if model.motion is None:
        raise ConfigError("a moment was asked for, and the model does not move; leave --time and --frames out")
    shown = model.at(time)
    if not len(shown):
        raise DataError(f"none of {len(model):,} Gaussians is shown at the time {time:g}; expected another moment")
    return shown


def _is_same(one: Path, other: Path) -> bool:
    """Whether two names are of one file."""
    try:
        return one.samefile(other)
    except (OSError, ValueError):  # there is no such file
        return False


# A moving model as files that stand still: one of a moment, or one of each of many moments.

MAX_FRAMES = 10_000  # files


def check_time(time: float | None) -> float | None:
    """Return a time.  Raises ConfigError for one that is not of a scene."""
    if time is not None and not is_timestamp(time):
        raise ConfigError(f"--time {time:g}: {EXPECTED_TIME}")
    return time


def convert_frames(
    sources: Sequence[Path], out: Path, frames: int, changes: Changes, quality: Quality
) -> dict[str, Any]:
    """Write one static model of each of so many moments, evenly spaced from the first to the last.

    out: a folder, in which they are PLYs with a number for a name; or a file, to whose name a number is added.
    Returns what `convert` does, with the sums over files, the largest number of `gaussians`, and `files`.
    Raises ConfigError, DataError, OutputError.
    """
    if not 2 <= frames <= MAX_FRAMES:
        raise ConfigError(f"--frames {frames}: expected 2 to {MAX_FRAMES:,} moments; `--time T` writes one")
    if changes.time is not None:
        raise ConfigError("--frames and --time: expected one of them")
    folder, begin, end = _name_of(out)
    digits = max(4, len(str(frames - 1)))
    places = [folder / f"{begin}{number:0{digits}}{end}" for number in range(frames)]
    for place in places:
        check_output(sources, place)
    _require_no_others(folder, re.compile(re.escape(begin) + r"\d{4,}" + re.escape(end)), places)
    writing, model = writing_options(places[0], quality), read(sources)
    moments = [replace(changes, time=number / (frames - 1)) for number in range(frames)]
    for moment in moments:  # before anything is written
        try:
            moment.apply(model)
        except DataError as error:
            raise DataError(f"--frames {frames}: the moment {moment.time:g}: {error}; nothing was written") from error
    done: list[dict[str, Any]] = []
    with _all_or_as_before([*places, *map(sky_path, places)]):
        for place, moment in zip(places, moments, strict=True):
            done.append(write_model(sources, moment.apply(model), place, replace(writing, quiet=bool(done))))
    return {
        **done[0],
        "file": str(out),
        "files": [str(place) for place in places],
        "gaussians": max(one["gaussians"] for one in done),
        "bytes": sum(one["bytes"] for one in done),
    }


@contextmanager
def _all_or_as_before(places: Sequence[Path]) -> Iterator[None]:
    """Where the block fails, as on a disk that fills, give places in one folder what they had; a new folder goes.

    Raises OutputError.
    """
    folder = places[0].parent
    was_there = path_exists(folder)
    try:
        with scratch_folder(folder / "series") as kept, raising_output_error(folder):
            before = [place for place in places if place.is_file()]
            for place in before:
                _keep(place, kept / place.name)
            try:
                yield
            except BaseException:
                for place in places:
                    if place in before:
                        os.replace(kept / place.name, place)
                    elif place.is_file():
                        place.unlink()
                raise
    finally:
        if not was_there:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def _keep(place: Path, other: Path) -> None:
    """Give a file, which is replaced and not changed, another name; where a disk has no links, copy it."""
    try:
        os.link(place, other)
    except OSError:
        shutil.copy2(place, other)


def _require_no_others(folder: Path, names: re.Pattern[str], places: Sequence[Path]) -> None:
    """Raise ConfigError where a folder has frames of another series, which a player would take for this one's."""
    own = {place.name for place in places}
    with raising_output_error(folder):
        there = sorted(os.listdir(folder)) if folder.is_dir() else []
    if others := [name for name in there if names.fullmatch(name) and name not in own]:
        raise ConfigError(
            f"{folder / others[0]}: is not of {len(places):,} frames, and would be taken for one; give a new name"
        )


def _name_of(out: Path) -> tuple[Path, str, str]:
    """The folder of frames, and what stands before and after the number in their names."""
    if format_of_name(out) is None and out.suffix == "":
        return out, "", ".ply"
    codec = writing_format(out)
    ending = next((end for end in sorted(codec.endings, key=len, reverse=True) if out.name.lower().endswith(end)), "")
    if not ending.startswith("."):
        raise ConfigError(f"{out}: --frames adds a number to a name; expected a folder, or a name such as frame.spz")
    return out.parent, f"{out.name[: -len(ending)]}_", out.name[-len(ending) :]


# A sky as Gaussians on a far sphere, for programs that know no map of directions.

COUNT = 10_000  # Gaussians, 2 degrees from each other
RADIUS = 10.0  # of the sphere, by the distance that holds SHARE of the model (WildGaussians, Kulhanek et al. 2024)
SHARE = 0.97
WIDTH = 0.65  # standard deviation, by the distance of neighbors: gaps let 2 % through (ours)
FLAT = 0.1  # standard deviation along the ray, by that across
LOGIT = 6.0  # of the opacity


def with_sky_splats(model: Model, count: int = COUNT) -> Model:
    """Return a model without a sky, and with Gaussians in its place; one without a sky stays as it is."""
    if (sky := model.sky) is None:
        return model
    model = model.baked()
    means = model.means.astype(np.float64)
    center = np.median(means, axis=0)
    radius = RADIUS * float(np.quantile(np.linalg.norm(means - center, axis=1), SHARE))
    directions = fibonacci(count)
    across = np.log(radius * np.sqrt(4 * np.pi / count) * WIDTH)
    added: dict[str, NDArray[Any]] = {
        "means": center + radius * directions,
        "quats": _turns(directions),
        "log_scales": np.tile([across, across, across + np.log(FLAT)], (count, 1)),
        "logit_opacity": np.full((count, 1), LOGIT),
        "sh_base": (np.clip(sample_texels(sky.texels, directions), 0, 1) - 0.5) / SH_C0,
        "sh_rest": np.zeros((count, model.sh_rest.shape[1])),
    }
    tables: dict[str, Any] = {name: np.concatenate([getattr(model, name), rows]) for name, rows in added.items()}
    if model.motion is not None:
        tables["motion"] = np.concatenate([model.motion, static_motion(count, model.motion.shape[1])])
    notes = {**model.rendering.notes, "sky": "splats"}
    return replace(model, **tables, rendering=replace(model.rendering, notes=notes), sky=None)


def fibonacci(count: int) -> NDArray[np.float64]:
    """Return directions that lie evenly on a sphere, unit vectors, [count, 3]."""
    number = np.arange(count)
    z = 1 - (2 * number + 1) / count
    angle = number * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _turns(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions, [N, 4], that turn the z axis into unit vectors."""
    x, y, z = directions.T
    return np.stack([1 + z, -y, x, np.zeros_like(x)], axis=1)


# Gaussians of points.

MIN_DISTANCE2 = 1.0e-7  # scene units²: coincident points still get a size


def from_points(points: PointCloud, opacity: float, degree: int, scale: float = 1.0) -> Parameters:
    """Return one Gaussian for each point, `scale` times as large as the distance to its neighbors."""
    count = len(points)
    log_scales = 0.5 * np.log(neighbor_distance2(points.positions)) + math.log(scale)
    quats = np.zeros((count, 4))
    quats[:, 0] = 1
    return {
        "means": points.positions.astype(np.float32),
        "quats": quats.astype(np.float32),
        "log_scales": np.repeat(log_scales[:, None], 3, axis=1).astype(np.float32),
        "logit_opacity": np.full((count, 1), math.log(opacity / (1 - opacity)), np.float32),
        "sh_base": ((points.colors - 0.5) / SH_C0).astype(np.float32),
        "sh_rest": np.zeros((count, 3 * (sh_coefficients(degree) - 1)), np.float32),
    }


def neighbor_distance2(positions: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean squared distance to the three nearest neighbors, exact, [N] scene units²."""
    neighbors = min(4, len(positions))
    if neighbors < 2:
        return np.full(len(positions), 1.0)
    distance = scipy.spatial.cKDTree(positions).query(positions, k=neighbors, workers=-1)[0]
    squared: NDArray[np.float64] = np.square(distance[:, 1:]).mean(axis=1)
    return np.maximum(squared, MIN_DISTANCE2)
