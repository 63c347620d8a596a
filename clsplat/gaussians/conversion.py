"""Convert model files to other formats, and merge, transform, crop, and reduce them on the way."""

import logging
import math
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, quote
from clsplat.core.files import check_not_run_file, path_exists, raising_output_error, scratch_folder
from clsplat.core.quaternions import rotation_matrix
from clsplat.formats.mesh import read_collider
from clsplat.formats.ply import MAX_NUMBER
from clsplat.formats.splats import (
    EXPECTED_TIME,
    MAX_DEGREE,
    SH_C0,
    Parameters,
    Quality,
    ReadOptions,
    WriteOptions,
    is_timestamp,
    normalize_quats,
    sh_coefficients,
    with_degree,
)
from clsplat.formats.table import format_from_name, model_bytes, writing_format
from clsplat.gaussians.mixture import merge_neighbors
from clsplat.gaussians.model import Model, exported_model_path, load, model_path
from clsplat.gaussians.motion import static_motion, with_motion
from clsplat.gaussians.sky import sample_texels, sky_path
from clsplat.scene.scene import PointCloud
from clsplat.scene.similarity import UP, Similarity, level
from clsplat.scene.viewpoint import ground_plane

# Merging models.

LOG = logging.getLogger("clsplat")
SHARED = ("near", "screen_variance", "background", "alpha")  # rendering parameters that are taken from the first model


def merge_models(models: Sequence[Model], names: Sequence[str]) -> Model:
    """Merge all Gaussians into one model, with the first model's rendering parameters and the largest SH degree.

    World filters are baked unless all models have one.  If some models move, the others get static motion.
    Raises DataError if the models use different screen filters or incompatible motions.
    """
    first = models[0]
    origin = next((model.origin for model in models if model.origin.any()), first.origin)
    if len(models) == 1:
        return first
    for model, name in zip(models, names, strict=True):
        filters = [_describe_filter(m) for m in (first, model)]
        if filters[0] != filters[1]:
            raise DataError(f"{name}: is {filters[1]}, but {names[0]} is {filters[0]}; merge only models of one kind")
        values, first_values = model.rendering.comment(), first.rendering.comment()
        different_keys = [key for key in SHARED if values.get(key) != first_values.get(key)]
        if differences := [f"{key} = {values.get(key, 'not set')}" for key in different_keys]:
            LOG.warning("%s: has %s; the values of %s are used", name, ", ".join(differences), names[0])
    models = [model.with_origin(origin) for model in models]
    if any(model.filter_variance is None for model in models):
        models = [model.baked() for model in models]
    degree = max(model.sh_degree for model in models)
    tables = with_motion([with_degree(model.tables(), degree) for model in models], names)
    merged_tables: dict[str, Any] = {n: np.concatenate([t[n] for t in tables]) for n in tables[0]}
    return Model(**merged_tables, rendering=first.rendering, sky=first.sky, origin=origin)


def _describe_filter(model: Model) -> str:
    """Describe the screen filter of a model."""
    if model.rendering.pixel_box:
        return "a model with a pixel box filter"
    return "a mip model" if model.rendering.compensate else "a plain model"


OPERATIONS = ("scale", "rotate", "translate")
QUALITIES = get_args(Quality)
SkyForm = Literal["splats", "none"]


@dataclass(frozen=True)
class Changes:
    """Changes to a model, applied in the order of these fields."""

    drop_below: float = 0.0  # opacity below which Gaussians are dropped
    filter_floaters: bool = False
    transform: NDArray[np.float64] | None = None  # [4, 4], a uniform scale, rotation, and translation
    level: bool = False  # turn the model so that its ground is at y = 0, with up = -y
    crop: tuple[float, ...] | None = None  # x0, y0, z0, x1, y1, z1, world coordinates; Gaussians outside are dropped
    sh_degree: int | None = None  # higher bands are dropped
    time: float | None = None  # of a moving model: the timestamp to extract
    world: bool = False  # write world coordinates instead of an origin
    sky: SkyForm | None = None  # write a sky as Gaussians, or remove it; None: leave it as it is
    splats: int | None = None  # number of Gaussians, without the sky, to which neighbors are merged
    collider: Path | None = None  # a mesh in the coordinates of the model, for OpenUSD

    def apply(self, model: Model) -> Model:
        """Return the converted model.  Raises DataError if no Gaussian remains, ConfigError for extreme transforms."""
        return self.apply_with_matrix(model)[0]

    def apply_with_matrix(self, model: Model) -> tuple[Model, NDArray[np.float64]]:
        """Return the converted model, and the matrix, [4, 4], that moved it in world coordinates."""
        matrix = np.eye(4) if self.transform is None else self.transform
        model = model if self.time is None else _extract_frame(model, self.time)
        model = without_sky(model) if self.sky == "none" else model
        if self.sky == "splats" and model.sky is None and model.is_scene.all():
            raise ConfigError("--sky splats: the model has no sky; omit the option")
        result = model[model.opacities >= self.drop_below] if self.drop_below else model
        if self.filter_floaters:
            result = without_floaters(result)
        if self.transform is not None:
            scale = round(float(np.cbrt(np.linalg.det(self.transform[:3, :3]))), 12)
            try:
                result = result.transformed(scale, self.transform[:3, :3] / scale, self.transform[:3, 3])
            except ValueError as error:
                raise ConfigError(f"--transform: {error}") from error
        if self.level:
            similarity = find_leveling(result)
            result = result.transformed(1.0, similarity.rotation, similarity.translation)
            matrix = similarity.matrix @ matrix
        if self.crop is not None:
            low, high = np.array(self.crop, np.float64).reshape(2, 3) - result.origin
            is_inside = ((result.means >= low) & (result.means <= high)).all(axis=1)
            result = result[is_inside | ~result.is_scene if self.sky == "splats" else is_inside]
        if self.sh_degree is not None and self.sh_degree < result.sh_degree:
            result = replace(result, sh_rest=with_degree(result.tables(), self.sh_degree)["sh_rest"])
        if self.splats is not None:
            result = merged(result, self.splats)
        if not len(result):
            fault = f"none of {len(model):,} Gaussians is left; use a larger crop or a lower opacity threshold"
            raise DataError(fault if len(model) else "the model has no Gaussians, or none with valid values")
        return with_sky_splats(result) if self.sky == "splats" else result, matrix


def merged(model: Model, count: int) -> Model:
    """Merge neighbors until at most `count` Gaussians remain, without counting the sky.  Raises ConfigError."""
    if count < 1:
        raise ConfigError(f"--splats {count}: expected a number of Gaussians of at least 1")
    if model.motion is not None:
        raise ConfigError("--splats needs a static model; add --time T")
    is_scene = model.is_scene
    return merge_models([merge_neighbors(model[is_scene], count), model[~is_scene]], ["the scene", "the sky"])


SOLID = 0.5  # smallest opacity of the Gaussians that may be ground


def solid_means(model: Model) -> NDArray[np.float32]:
    """Return the means of the opaque Gaussians that are not sky, [M, 3]."""
    return model.means[model.is_scene & (model.opacities >= SOLID)]


def find_leveling(model: Model) -> Similarity:
    """Return the transform that turns a model about its center so that its ground is at y = 0 and up is -y.

    Raises DataError if it has no ground within 45 degrees of level.
    """
    points = solid_means(model)
    up, height = ground_plane(points, UP)
    transform = level(up, np.median(points, axis=0) + model.origin, height + float(up @ model.origin))
    LOG.info("the ground was tilted by %.1f degrees", math.degrees(math.acos(min(1.0, float(up @ UP)))))
    return transform


# Floaters, found without photos.

NEIGHBORS = 16
REACH = 2.0  # standard deviations within which two Gaussians touch
MIN_GROUP = 10  # Gaussians that touch each other; smaller groups are isolated
LARGE, FAINT = 8.0, 0.3  # times the size of the neighbors, and opacity
MAX_FLOATERS = 0.25  # fraction of the Gaussians
OUTSIDE = 3.0  # times the 99th percentile of the distances from the center


def without_floaters(model: Model) -> Model:
    """Return a model without floaters, and log their number.  Sky Gaussians are kept.

    Floaters are large and faint compared with their neighbors, belong to small groups that touch nothing else, or are
    far from the scene.  Raises ConfigError for a moving model, and DataError if too many Gaussians would be floaters.
    """
    if model.motion is not None:
        raise ConfigError("--filter-floaters needs a static model; add --time T")
    rows = np.flatnonzero(model.is_scene)
    if len(rows) <= NEIGHBORS:
        return model
    is_faint, is_isolated, is_outside = _find_floaters(model[rows])
    is_floater = is_faint | is_isolated | is_outside
    if is_floater.mean() > MAX_FLOATERS:
        raise DataError(
            f"{is_floater.mean():.0%} of the Gaussians would be floaters, because few touch each other; "
            "omit --filter-floaters"
        )
    LOG.info(
        "removed %s of %s Gaussians as floaters: %s large and faint, %s isolated, %s far from the scene",
        *(
            f"{count:,}"
            for count in (is_floater.sum(), len(model), is_faint.sum(), is_isolated.sum(), is_outside.sum())
        ),
    )
    is_kept = np.ones(len(model), np.bool_)
    is_kept[rows[is_floater]] = False
    return model[is_kept]


def _find_floaters(model: Model) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return disjoint masks, [N], of Gaussians that are large and faint, isolated, or far from the scene."""
    means, scales = model.means.astype(np.float64), model.scales.astype(np.float64)
    center_distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    is_outside = center_distances > OUTSIDE * np.quantile(center_distances, 0.99)
    distances, neighbors = scipy.spatial.cKDTree(means).query(means, k=NEIGHBORS + 1, workers=-1)
    distances, neighbors = distances[:, 1:], neighbors[:, 1:]
    size = scales.max(axis=1)
    is_faint = (size > LARGE * np.median(size[neighbors], axis=1)) & (model.opacities < FAINT)
    axes = rotation_matrix(*normalize_quats(model.quats).T) * scales[:, None]
    pairs = []
    for distance, neighbor in zip(distances.T, neighbors.T, strict=True):
        direction = (means[neighbor] - means) / np.maximum(distance, 1e-300)[:, None]
        reach = sum(
            np.linalg.norm(np.einsum("nij,ni->nj", axes[i], direction), axis=1) for i in (slice(None), neighbor)
        )
        touches = np.flatnonzero((distance <= REACH * reach) & ~is_faint & ~is_faint[neighbor])
        pairs.append(np.stack([touches, neighbor[touches]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = scipy.sparse.coo_array((np.ones(len(first)), (first, second)), shape=(len(means), len(means)))
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    is_isolated = ~is_faint & (np.bincount(group)[group] < MIN_GROUP)
    return is_faint, is_isolated, is_outside & ~is_faint & ~is_isolated


def writing_options(out: Path, quality: Quality, changes: Changes) -> WriteOptions:
    """Return the options for writing a file.  Raises ConfigError if the quality is unknown or has no effect."""
    if quality not in QUALITIES:
        raise ConfigError(f"--quality {quote(quality)}: expected one of {', '.join(QUALITIES)}")
    if quality != "balanced" and not writing_format(out).has_quality:
        raise ConfigError(f"{out}: --quality is only for SPZ and SOG; use a name that ends in .spz or .sog")
    if changes.collider is None:
        return WriteOptions(quality, world=changes.world)
    if not writing_format(out).has_collider:
        raise ConfigError(f"{out}: --collider is only for OpenUSD; use a name that ends in .usdz or .usda")
    return WriteOptions(quality, world=changes.world, collider=read_collider(changes.collider))


def convert(
    sources: Sequence[Path], out: Path, changes: Changes | None = None, quality: Quality = "balanced"
) -> dict[str, Any]:
    """Read model files or run folders and write all their Gaussians to one file, in the format that its name implies.

    Returns a dictionary with `file`, `format`, `gaussians`, `bytes`, and `bytes_read`.
    Raises ConfigError, DataError, OutputError.
    """
    if not sources:
        raise ConfigError("convert: expected at least one model file to read, and one to write")
    check_output(sources, out)
    changes = changes or Changes()
    options = writing_options(out, quality, changes)
    model = read(sources, changes.sky)
    try:
        model, matrix = changes.apply_with_matrix(model)
    except DataError as error:
        raise DataError(f"{', '.join(map(str, sources))}: {error}") from error
    if options.collider:
        vertices, faces = options.collider
        options = replace(options, collider=(vertices @ matrix[:3, :3].T + matrix[:3, 3], faces))
    return write_model(sources, model, out, options)


def read(sources: Sequence[Path], sky: SkyForm | None = None) -> Model:
    """Read and merge model files or run folders, without Gaussians that are not finite.  Raises DataError.

    sky: with "none", a run folder's file without sky Gaussians is preferred.
    """
    find = model_path if sky == "none" else exported_model_path
    models = [load(find(source), ReadOptions(not_finite="drop")) for source in sources]
    return merge_models(models, [str(source) for source in sources])


def write_model(sources: Sequence[Path], model: Model, out: Path, options: WriteOptions) -> dict[str, Any]:
    """Write a model that was read from `sources`, and return the same dictionary as `convert`.  Raises OutputError."""
    size = sum(model_bytes(model_path(source)) for source in sources)
    model.save(out, options)
    name = writing_format(out).name
    return {"file": str(out), "format": name, "gaussians": len(model), "bytes": model_bytes(out), "bytes_read": size}


def check_output(sources: Sequence[Path], out: Path) -> None:
    """Raise ConfigError if the output is one of the sources or belongs to a run."""
    if any(_is_same(out, model_path(source)) for source in sources):
        raise ConfigError(f"{out}: is one of the input files; use another name")
    check_not_run_file(out)


def parse_transform(text: str) -> NDArray[np.float64]:
    """Parse a transform such as `scale=2 rotate=90,0,0 translate=0,1,0`, applied from left to right; return [4, 4].

    Rotations are in degrees about x, then y, then z.  A row-major matrix is given as 12 or 16 comma-separated numbers.
    Raises ConfigError.
    """
    message = (
        f"--transform {quote(text)}: expected scale=S, rotate=X,Y,Z (degrees), and translate=X,Y,Z separated by "
        "spaces, or the 12 or 16 numbers of a matrix, row by row"
    )
    try:
        if "=" not in text:
            elements = [float(element) for element in text.replace(",", " ").split()]
            last_row = [] if len(elements) == 16 else [0, 0, 0, 1]
            matrix = np.array([*elements, *last_row]).reshape(4, 4)
        else:
            matrix = np.eye(4)
            for token in text.split():
                operation, _, values = token.partition("=")
                with np.errstate(over="ignore", invalid="ignore"):  # checked below
                    matrix = _operation_matrix(operation, [float(value) for value in values.split(",")]) @ matrix
    except ValueError as error:
        raise ConfigError(message) from error
    linear = matrix[:3, :3]
    if not np.abs(matrix).max() < MAX_NUMBER or not (np.abs(linear).max() or 1) > 1 / MAX_NUMBER:
        raise ConfigError(
            f"--transform {quote(text)}: expected a scale from {1 / MAX_NUMBER:g} to {MAX_NUMBER:g} and a "
            "smaller translation"
        )
    scale2 = linear @ linear.T
    if (
        not np.allclose(matrix[3], [0, 0, 0, 1])
        or np.linalg.det(linear) <= 0
        or not np.allclose(scale2, scale2[0, 0] * np.eye(3), atol=1e-5 * scale2[0, 0])
    ):
        raise ConfigError(f"--transform {quote(text)}: stretches or mirrors; expected a uniform scale and a rotation")
    return matrix


def _operation_matrix(operation: str, values: list[float]) -> NDArray[np.float64]:
    """Return the matrix, [4, 4], of one operation of a transform.  Raises ValueError."""
    from scipy.spatial.transform import Rotation

    if operation not in OPERATIONS or len(values) != (1 if operation == "scale" else 3):
        raise ValueError(operation)
    matrix = np.eye(4)
    if operation == "scale":
        matrix[:3, :3] *= values[0]
    elif operation == "rotate":
        matrix[:3, :3] = Rotation.from_euler("xyz", values, degrees=True).as_matrix()
    else:
        matrix[:3, 3] = values
    return matrix


def parse_crop(text: str) -> tuple[float, ...]:
    """Parse a box `x0,y0,z0,x1,y1,z1` in world coordinates.  Raises ConfigError."""
    try:
        box = tuple(float(value) for value in text.split(","))
    except ValueError:
        box = ()
    if len(box) != 6 or not all(low <= high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ConfigError(f"--crop {quote(text)}: expected x0,y0,z0,x1,y1,z1, the minimum first, in world coordinates")
    return box


def check_degree(degree: int | None) -> int | None:
    """Return an SH degree unchanged.  Raises ConfigError if it is invalid."""
    if degree is not None and not 0 <= degree <= MAX_DEGREE:
        raise ConfigError(f"--sh-degree {degree}: expected 0 to {MAX_DEGREE}")
    return degree


def _extract_frame(model: Model, time: float) -> Model:
    """Return a moving model at one time, as a static model.

    Raises ConfigError if the model does not move, and DataError if no Gaussian is visible at that time.
    """
    if model.motion is None:
        raise ConfigError("the model does not move; omit --time and --frames")
    frame = model.at(time)
    if not len(frame):
        raise DataError(f"none of the {len(model):,} Gaussians is visible at time {time:g}; use another time")
    return frame


def _is_same(path: Path, other: Path) -> bool:
    """Return whether two paths are the same file."""
    try:
        return path.samefile(other)
    except (OSError, ValueError):  # one of them does not exist
        return False


# Static models of a moving model, at one or several timestamps.

MAX_FRAMES = 10_000  # files


def check_time(time: float | None) -> float | None:
    """Return a timestamp unchanged.  Raises ConfigError if it is invalid."""
    if time is not None and not is_timestamp(time):
        raise ConfigError(f"--time {time:g}: {EXPECTED_TIME}")
    return time


def convert_frames(
    sources: Sequence[Path], out: Path, frames: int, changes: Changes, quality: Quality
) -> dict[str, Any]:
    """Write static models at `frames` timestamps, evenly spaced from start to end.

    out: a folder for numbered PLY files, or a file name to which numbers are added.
    Returns the dictionary of `convert`, with `files`, their total `bytes`, and the largest number of `gaussians`.
    Raises ConfigError, DataError, OutputError.
    """
    if not 2 <= frames <= MAX_FRAMES:
        raise ConfigError(f"--frames {frames}: expected 2 to {MAX_FRAMES:,} frames; `--time T` writes one")
    if changes.time is not None or changes.collider:
        raise ConfigError("--frames cannot be combined with --time or --collider; omit one of them")
    folder, prefix, suffix = _split_name(out)
    digits = max(4, len(str(frames - 1)))
    files = [folder / f"{prefix}{number:0{digits}}{suffix}" for number in range(frames)]
    for file in files:
        check_output(sources, file)
    _require_no_other_frames(folder, re.compile(re.escape(prefix) + r"\d{4,}" + re.escape(suffix)), files)
    options, model = writing_options(files[0], quality, changes), read(sources, changes.sky)
    changes_by_frame = [replace(changes, time=number / (frames - 1)) for number in range(frames)]
    for change in changes_by_frame:  # check all before anything is written
        try:
            change.apply(model)
        except DataError as error:
            raise DataError(f"--frames {frames}: time {change.time:g}: {error}; nothing was written") from error
    results: list[dict[str, Any]] = []
    with _restore_on_failure([*files, *map(sky_path, files)]):
        for file, change in zip(files, changes_by_frame, strict=True):
            results.append(write_model(sources, change.apply(model), file, replace(options, quiet=bool(results))))
    return {
        **results[0],
        "file": str(out),
        "files": [str(file) for file in files],
        "gaussians": max(result["gaussians"] for result in results),
        "bytes": sum(result["bytes"] for result in results),
    }


@contextmanager
def _restore_on_failure(files: Sequence[Path]) -> Iterator[None]:
    """If the block fails, for example on a full disk, restore `files`, and remove their folder if it is new.

    Raises OutputError.
    """
    folder = files[0].parent
    is_new = not path_exists(folder)
    try:
        with scratch_folder(folder / "series") as backup, raising_output_error(folder):
            old_files = [file for file in files if file.is_file()]
            for file in old_files:
                _link_or_copy(file, backup / file.name)
            try:
                yield
            except BaseException:
                for file in files:
                    if file in old_files:
                        os.replace(backup / file.name, file)
                    elif file.is_file():
                        file.unlink()
                raise
    finally:
        if is_new:
            with suppress(OSError):  # not empty
                folder.rmdir()


def _link_or_copy(file: Path, target: Path) -> None:
    """Hard-link a file, or copy it if that fails.  Links suffice, as files are replaced, never changed in place."""
    try:
        os.link(file, target)
    except OSError:
        shutil.copy2(file, target)


def _require_no_other_frames(folder: Path, pattern: re.Pattern[str], files: Sequence[Path]) -> None:
    """Raise ConfigError if a folder has frames of another series, because players would show those frames, too.

    pattern: matches the frames' names.
    """
    frame_names = {file.name for file in files}
    with raising_output_error(folder):
        all_names = sorted(os.listdir(folder)) if folder.is_dir() else []
    if other_frames := [name for name in all_names if pattern.fullmatch(name) and name not in frame_names]:
        raise ConfigError(
            f"{folder / other_frames[0]}: has a frame's name, but is not one of the {len(files):,} frames; rename it"
        )


def _split_name(out: Path) -> tuple[Path, str, str]:
    """Return the folder of frames, and the text before and after the number in their names."""
    if format_from_name(out) is None and out.suffix == "":
        return out, "", ".ply"
    codec = writing_format(out)
    ending = next((end for end in sorted(codec.endings, key=len, reverse=True) if out.name.lower().endswith(end)), "")
    if not ending.startswith("."):
        raise ConfigError(f"{out}: --frames adds numbers to a name; use a folder, or a name such as frame.spz")
    return out.parent, f"{out.name[: -len(ending)]}_", out.name[-len(ending) :]


# A sky as Gaussians on a distant sphere, for programs without environment maps.

COUNT = 10_000  # Gaussians, 2 degrees apart
RADIUS = 10.0  # of the sphere, relative to the QUANTILE of distances from the center (WildGaussians, 2024)
QUANTILE = 0.97
WIDTH = 0.8  # standard deviation, relative to the distance between neighbors; gaps let 0.2 % of the light through
FLAT = 0.1  # standard deviation along the ray, relative to that across
LOGIT = 6.0  # of the opacity of sky Gaussians


def with_sky_splats(model: Model, count: int = COUNT, center: NDArray[np.floating] | None = None) -> Model:
    """Replace the sky of a model with Gaussians.  A model without a sky is returned unchanged.

    center: the center of the sphere, [3], from which the sky looks exact; by default, the median of the means.
    """
    if (sky := model.sky) is None:
        return model
    model = model.baked()
    means = model.means.astype(np.float64)
    center = np.median(means, axis=0) if center is None else center
    radius = RADIUS * float(np.quantile(np.linalg.norm(means - center, axis=1), QUANTILE))
    directions = fibonacci_sphere(count)
    log_scale = np.log(radius * np.sqrt(4 * np.pi / count) * WIDTH)
    sky_tables: dict[str, NDArray[Any]] = {
        "means": center + radius * directions,
        "quats": _rotations_to(directions),
        "log_scales": np.tile([log_scale, log_scale, log_scale + np.log(FLAT)], (count, 1)),
        "logit_opacity": np.full((count, 1), LOGIT),
        "sh_base": (np.clip(sample_texels(sky.texels, directions), 0, 1) - 0.5) / SH_C0,
        "sh_rest": np.zeros((count, model.sh_rest.shape[1])),
    }
    tables: dict[str, Any] = {name: np.concatenate([getattr(model, name), table]) for name, table in sky_tables.items()}
    if model.motion is not None:
        tables["motion"] = np.concatenate([model.motion, static_motion(count, model.motion.shape[1])])
    notes = {**model.rendering.notes, "sky": "splats"}
    return replace(model, **tables, rendering=replace(model.rendering, notes=notes), sky=None)


def without_sky(model: Model) -> Model:
    """Return a model without its sky and without sky Gaussians."""
    notes = {name: note for name, note in model.rendering.notes.items() if name != "sky"}
    return replace(model[model.is_scene], rendering=replace(model.rendering, notes=notes), sky=None)


def fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """Return evenly distributed unit vectors (a Fibonacci sphere), [count, 3]."""
    index = np.arange(count)
    z = 1 - (2 * index + 1) / count
    angle = index * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _rotations_to(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions, [N, 4], that rotate the z axis onto unit vectors."""
    x, y, z = directions.T
    return np.stack([1 + z, -y, x, np.zeros_like(x)], axis=1)


# Gaussians from points.

MIN_DISTANCE2 = 4.0e-9  # extents², so that coincident points still get a size: 1e-7 in 3DGS, at an extent of 5


def from_points(points: PointCloud, opacity: float, degree: int, scale: float = 1.0, extent: float = 1.0) -> Parameters:
    """Return one Gaussian for each point, `scale` times as large as the distance to its neighbors.

    extent: the extent of the scene in scene units, used instead of the distance if there is only one point.
    """
    count = len(points)
    log_scales = 0.5 * np.log(neighbor_distance2(points.positions, extent)) + math.log(scale)
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


def neighbor_distance2(positions: NDArray[np.floating], extent: float) -> NDArray[np.float64]:
    """Return each position's mean squared distance to its three nearest neighbors, [N] scene units².

    extent: the extent of the scene in scene units, used instead of the distance if there is only one point.
    """
    neighbors = min(4, len(positions))
    if neighbors < 2:
        return np.full(len(positions), extent**2)
    distances = scipy.spatial.cKDTree(positions).query(positions, k=neighbors, workers=-1)[0]
    mean_squares: NDArray[np.float64] = np.square(distances[:, 1:]).mean(axis=1)
    return np.maximum(mean_squares, MIN_DISTANCE2 * extent**2)
