"""Measure the properties of a dataset that determine whether and how well it can be trained on."""

import logging
import os
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.progress import captured_log, counted, log_level
from clsplat.prepare.gather import MIN_PHOTOGRAPHS, failure_reason, list_photographs
from clsplat.scene.camera import BORDER_POINTS, Lens
from clsplat.scene.detect import find_dataset, read_scene
from clsplat.scene.identity import ImageFile, decode_all, require_content
from clsplat.scene.images import (
    CameraExposure,
    is_image,
    read_exif_camera,
    read_exif_exposure,
    read_gray,
    read_header,
)
from clsplat.scene.points import MAX_VALUE
from clsplat.scene.quality import SIDE, is_blank, is_blurred, sharpness_values
from clsplat.scene.reader import Parts
from clsplat.scene.reprojection import reprojection_errors, require_points_in_front
from clsplat.scene.scene import camera_extent, have_same_center, outlier_cameras
from clsplat.scene.times import distinct_times, group_by_camera
from clsplat.scene.view import NO_FILE, View, fits_camera, load_exposures

# Compare the photographs with each other: find blurred ones, duplicates, and jumps of the exposure.

THUMBNAIL = 32  # px, each side
MAX_DUPLICATE_RMS = 1.0  # gray levels; frames of a video differ by 9, two encodings of one photograph by 0.3
MAX_STOPS = 1.0  # from one photograph to the next
MAX_BRIGHTNESS_RATIO = 2.0  # from one photograph to the next; at most 1.4 in five captures with a fixed exposure


@dataclass(frozen=True)
class PhotographMeasures:
    """Measurements of a photograph."""

    sharpness: NDArray[np.float64]  # [2], as sharpness_values returns them
    brightness: NDArray[np.float64]  # [2], mean and median, gray levels
    thumbnail: NDArray[np.float32]  # [THUMBNAIL²], gray levels
    is_blank: bool  # black, of one color, or transparent


@dataclass(frozen=True)
class ComparisonFacts:
    """The names of photographs with visible faults, and of photographs that look the same."""

    blurred: list[str]  # much blurrier than the others
    same: list[list[str]]  # groups of photographs that look the same
    jumps: list[tuple[str, str, float]]  # a photograph, the next one, and the stops between their EXIF exposures
    steps: list[tuple[str, str, float]]  # as `jumps`, with the ratio of brightness, for photographs without exposures
    unreadable: dict[str, str]  # photographs that cannot be decoded, by name, with the reason
    blank: list[str]  # black or of one color


def compare_views(parts: Parts, missing_files: Container[Path]) -> ComparisonFacts:
    """Compare the photographs of a dataset's views, or all photographs in its folder if it has no views.

    missing_files: paths of photographs that do not exist.
    """
    views = [view for view in parts.views if view.image_path != NO_FILE and view.image_path not in missing_files]
    if not views:
        return compare_photos({os.path.relpath(f, parts.path).replace(os.sep, "/"): f for f in parts.disk_files})
    exposures: list[CameraExposure | None] = [None] * len(views)
    with suppress(DataError):
        exposures = load_exposures(views)
    files = {view.name: view.image_path for view in views}
    return compare_photos(files, {view.name: exposure for view, exposure in zip(views, exposures, strict=True)})


def compare_photos(
    files: Mapping[str, Path], exposures: Mapping[str, CameraExposure | None] | None = None
) -> ComparisonFacts:
    """Compare consecutive photographs, sorted by name.  exposures: by name, or None to read them from EXIF."""
    names = sorted(files)
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8), "comparing") as pool:
        results = counted(pool.map(_measure_photo, (files[name] for name in names)), "photos compared", len(names))
        measures = dict(zip(names, results, strict=True))
    photos = {name: result for name, result in measures.items() if not isinstance(result, DataError)}
    if exposures is None:
        exposures = {name: read_exif_exposure(files[name]) for name in photos}
    values = [(name, exposure.value) for name in names if (exposure := exposures.get(name))]
    stops = [(name, next_name, round(abs(y - x), 2)) for (name, x), (next_name, y) in pairwise(values)]
    median = np.median([photo.sharpness for photo in photos.values()], axis=0) if photos else np.zeros(2)
    return ComparisonFacts(
        blurred=[name for name, photo in photos.items() if is_blurred(photo.sharpness, median) and not photo.is_blank],
        same=_find_duplicates(list(photos), [photo.thumbnail for photo in photos.values()]),
        jumps=[jump for jump in stops if jump[2] > MAX_STOPS],
        steps=_find_brightness_steps(
            {name: photo.brightness for name, photo in photos.items()}, {name for name, _ in values}
        ),
        unreadable={
            name: failure_reason(files[name], error) for name, error in measures.items() if isinstance(error, DataError)
        },
        blank=[name for name, photo in photos.items() if photo.is_blank],
    )


def _measure_photo(file: Path) -> PhotographMeasures | DataError:
    """Return the measurements of a photograph, or the error if it cannot be read."""
    try:
        gray = read_gray(file, SIDE)[0]
    except DataError as error:
        return error
    thumbnail = cv2.resize(gray, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
    brightness = np.maximum([gray.mean(), np.median(gray)], 1.0)
    return PhotographMeasures(sharpness_values(gray), brightness, thumbnail.astype(np.float32).ravel(), is_blank(gray))


def _find_brightness_steps(
    brightness: Mapping[str, NDArray[np.float64]], names_with_exposure: Container[str]
) -> list[tuple[str, str, float]]:
    """Return adjacent photographs whose mean and median brightness both differ by a factor above MAX_BRIGHTNESS_RATIO.

    If only the content differs, often only the mean or the median differs.  names_with_exposure: photographs with known
    exposures; pairs of them are skipped.
    """
    steps = []
    for (name, x), (next_name, y) in pairwise(brightness.items()):
        ratios = y / x
        if name in names_with_exposure and next_name in names_with_exposure:
            continue
        if min(ratios) > MAX_BRIGHTNESS_RATIO or max(ratios) < 1 / MAX_BRIGHTNESS_RATIO:
            steps.append((name, next_name, round(float(ratios[0]), 2)))
    return steps


def _find_duplicates(names: Sequence[str], thumbnails: Sequence[NDArray[np.float32]]) -> list[list[str]]:
    """Return groups of photographs with nearly equal thumbnails; thumbnails without contrast are skipped."""
    groups: list[list[int]] = []
    for i, thumbnail in enumerate(thumbnails):
        if thumbnail.std() <= MAX_DUPLICATE_RMS:
            continue
        first_thumbnails = np.array([thumbnails[group[0]] for group in groups]).reshape(len(groups), len(thumbnail))
        matches = np.flatnonzero(((first_thumbnails - thumbnail) ** 2).mean(axis=1) < MAX_DUPLICATE_RMS**2)
        groups[matches[0]].append(i) if len(matches) else groups.append([i])
    return [[names[i] for i in group] for group in groups if len(group) > 1]


# Measure the sparse points of a dataset.

SAMPLE_SIZE = 20_000  # points that coverage is measured on
MAX_DISTANCE = 100.0  # camera extents from the median camera center; photographs resolve nothing beyond


@dataclass(frozen=True)
class PointFacts:
    """Measurements of the sparse points.  Fractions refer to SAMPLE_SIZE points, evenly spaced in the file."""

    count: int
    not_finite: int
    distant: int  # beyond MAX_DISTANCE camera extents
    error_mean: float | None  # px
    error_90: float | None  # px, the 90th percentile
    in_two: float | None  # fraction that projects into at least two images, occluded or not
    behind: float | None  # fraction behind all cameras


def measure_points(parts: Parts, extent: float | None, centers: NDArray[np.floating]) -> PointFacts:
    """Measure the sparse points of a dataset that has points.

    extent: the extent of the cameras in scene units.  centers: the camera centers, [N, 3].
    """
    assert parts.points is not None
    positions = parts.points.positions
    is_finite = (np.abs(positions) < MAX_VALUE).all(axis=1)
    errors = _point_errors(parts, np.asarray(is_finite))
    finite_positions = positions[is_finite].astype(np.float64)
    distance = np.linalg.norm(finite_positions - np.median(centers, axis=0), axis=1) if len(centers) else np.empty(0)
    sample = finite_positions[:: max(1, -(-len(finite_positions) // SAMPLE_SIZE))]
    views = list(parts.scene.views) if parts.scene else parts.views  # with the faces of wide photographs
    two_view_fraction, behind_fraction = _measure_coverage(sample, views) if len(sample) and views else (None, None)
    return PointFacts(
        count=len(positions),
        not_finite=int(np.count_nonzero(~is_finite)),
        distant=int(np.count_nonzero(distance > MAX_DISTANCE * extent)) if extent else 0,
        error_mean=float(errors.mean()) if len(errors) else None,
        error_90=float(np.quantile(errors, 0.9)) if len(errors) else None,
        in_two=two_view_fraction,
        behind=behind_fraction,
    )


def _point_errors(parts: Parts, is_finite: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Return the reprojection errors in px at the full size, computed from observations or read from the file."""
    errors = reprojection_errors(parts.scene.tracks, parts.scene.views) if parts.scene else None
    if errors is not None:
        return errors
    assert parts.points is not None
    error = parts.points.error[is_finite] if len(parts.points.error) else np.empty(0)
    valid_errors = error[np.isfinite(error) & (error > 0)]
    return valid_errors if len(np.unique(valid_errors)) > 1 else np.empty(0)  # equal errors are a placeholder


def _measure_coverage(points: NDArray[np.float64], views: Sequence[View]) -> tuple[float, float]:
    """Return the fractions of points, [M, 3], that project into at least two views, and that are behind all views."""
    visible_counts, ever_in_front = np.zeros(len(points), int), np.zeros(len(points), bool)
    for view in views:
        camera = view.camera
        x, y, z = view.world_to_camera[:, :3] @ points.T + view.world_to_camera[:, 3:]
        in_front = z > 0
        depth = np.where(in_front, z, 1)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        visible_counts += in_front & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        ever_in_front |= in_front
    return float((visible_counts >= min(2, len(views))).mean()), float((~ever_in_front).mean())


MIN_SEEN = 30  # points visible in a view; COLMAP does not register images with fewer inliers


@dataclass(frozen=True)
class CameraFacts:
    """Properties of a camera, and the number of views that share it."""

    views: int
    model: str
    width: int
    height: int
    focal: tuple[float, float]  # px
    distortion: float | None  # px, the largest displacement by the lens along the border; None if it is not finite
    kept: float  # fraction of the photograph that undistortion keeps
    centered: bool  # whether the principal point is inside the photograph
    faces: int  # number of views that a wide photograph is cut into; 0 for other photographs


@dataclass(frozen=True)
class PhotographFacts:
    """Facts about the image files and masks of the views, by name."""

    unreadable: dict[str, str]  # files that cannot be decoded, with the reason
    cut: list[str]  # files that cannot be decoded because their end is missing
    misfits: dict[str, str]  # files whose size differs from the camera's, with both sizes
    on_side: list[str]  # misfits whose width and height are swapped
    exif_turned: list[str]  # files that are read as stored although EXIF contains a rotation
    mask_count: int  # views with a mask
    blank: list[str]  # photographs of training views that are black, of one color, or transparent
    unusable_reason: str  # reason why training cannot use the files: masks exclude all pixels, or all are blank


@dataclass(frozen=True)
class CaptureFacts:
    """Facts from the headers of photographs without cameras.  Each value is a number of photographs."""

    sizes: dict[str, int]  # by size as stored
    cameras: dict[str, int]  # by make, model and focal length in EXIF
    located: int  # photographs with a GPS position


@dataclass(frozen=True)
class Facts:
    """All measurements of a dataset.  Names are names of views; paths are relative to the dataset."""

    path: str
    kind: str
    registered: int
    train: int | None  # None when the dataset cannot be read
    test: int | None
    on_disk: int
    missing: list[str]
    unregistered: list[str]
    folders: int  # number of folders that contain registered images
    submodels: dict[str, int]  # number of images of each COLMAP model; the first model is used
    cameras: list[CameraFacts]
    photos: PhotographFacts
    comparison: ComparisonFacts
    capture: CaptureFacts | None  # None when there are views
    points: PointFacts | None
    points_per_view: dict[str, int]  # number of sparse points that each view shows; empty if unknown
    extent: float | None  # of the cameras, in scene units
    origin: list[float]  # [3] world coordinates; not zero for a scene far from zero
    outlier_cameras: list[str]
    timestamps: int  # distinct times of the views; 0 for static scenes
    moving_cameras: int  # distinct cameras of a dynamic scene; 0 for static scenes
    same_center: bool  # whether all cameras have the same center
    same_pose: list[list[str]]  # groups of views with equal poses
    same_but_case: list[list[str]]  # groups of names that differ only in upper and lower case
    left_out: list[str]  # sentences about files that `prepare` does not read as photographs
    hint: str  # text that names similar files on disk, if files are missing
    notes: list[str]  # sentences about files that were not at the paths in the dataset but were found elsewhere
    faults: list[str]  # reasons why parts of the dataset cannot be read
    refusal: str  # reason why training does not start

    @property
    def is_unplaced(self) -> bool:
        """Whether the dataset consists of photographs without cameras, for use with `clsplat run photos`."""
        return (
            self.kind == "none"
            and not self.faults
            and self.on_disk - len(self.comparison.unreadable) >= MIN_PHOTOGRAPHS
        )

    @property
    def few_points(self) -> list[str]:
        """The names of the views that show fewer than MIN_SEEN points, in ascending order of the number of points."""
        counts = self.points_per_view
        return sorted((name for name, count in counts.items() if count < MIN_SEEN), key=counts.__getitem__)


def measure_dataset(parts: Parts) -> Facts:
    """Return all measurements of a dataset.  parts: as `read_parts` returns them."""
    views, expected = parts.views, parts.expected_files
    missing_files = [file for file in expected if not os.path.exists(file)]  # Path.exists may raise
    listed_files = {*expected, *(view.mask_path for view in views), *(view.static_path for view in views)}
    names = [view.name for view in views]
    centers = np.stack([view.position for view in views]) if views else np.empty((0, 3))
    extent = (
        parts.scene.extent
        if parts.scene
        else camera_extent(views, parts.points and parts.points.positions)
        if views
        else None
    )
    return Facts(
        path=str(parts.path),
        kind=parts.kind,
        registered=len(expected),
        train=len(parts.scene.train) if parts.scene else None,
        test=len(parts.scene.test) if parts.scene else None,
        on_disk=len(parts.disk_files),
        missing=[_relative_path(file, parts) for file in missing_files],
        unregistered=[_relative_path(file, parts) for file in parts.disk_files if file not in listed_files],
        folders=len({file.parent for file in expected}),
        submodels=parts.submodels,
        cameras=_measure_cameras(parts),
        photos=_measure_photographs(parts, set(missing_files)),
        comparison=compare_views(parts, set(missing_files)),
        capture=None if views else measure_capture(parts.disk_files),
        points=measure_points(parts, extent, centers) if parts.points else None,
        points_per_view=parts.observed if any(parts.observed.values()) else {},
        extent=extent,
        origin=parts.scene.origin.tolist() if parts.scene else [0.0] * 3,
        outlier_cameras=[view.name for view, is_far in zip(views, outlier_cameras(views), strict=True) if is_far]
        if views
        else [],
        timestamps=len(distinct_times(views)),
        moving_cameras=len(group_by_camera(views)) if distinct_times(views) else 0,
        same_center=len(views) > 1 and have_same_center(centers),
        same_pose=_equal_groups(names, [(v.time, v.downscale, *_pose(v, extent)) for v in views]),
        same_but_case=[group for group in _equal_groups(names, [n.casefold() for n in names]) if len(set(group)) > 1],
        left_out=parts.warnings,
        hint=parts.hint,
        notes=parts.notes,
        faults=parts.faults,
        refusal=parts.refusal,
    )


def measure_distortion(lens: Lens) -> float | None:
    """Return the largest displacement by the lens along the border, in px.  None if it is not finite."""
    camera, fractions = lens.camera, np.linspace(0, 1, BORDER_POINTS)
    zeros, ones = np.zeros(BORDER_POINTS), np.ones(BORDER_POINTS)
    x = np.concatenate([fractions, fractions, zeros, ones]) * lens.width
    y = np.concatenate([zeros, ones, fractions, fractions]) * lens.height
    with np.errstate(all="ignore"):
        distorted_x, distorted_y = lens.distort((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
        displacement = float(np.hypot(distorted_x - x, distorted_y - y).max())
    return displacement if np.isfinite(displacement) else None


def _relative_path(file: Path, parts: Parts) -> str:
    return os.path.relpath(file, parts.path).replace(os.sep, "/")


def _pose(view: View, extent: float | None) -> tuple[float, ...]:
    """Return the pose of a view, with the translation in units of the extent, rounded so that equal poses match."""
    return tuple((view.world_to_camera / [1, 1, 1, extent or 1]).ravel().round(9))


def _equal_groups(names: Sequence[str], keys: Iterable[object]) -> list[list[str]]:
    """Return the groups of two or more names that have the same key."""
    groups = defaultdict(list)
    for name, key in zip(names, keys, strict=True):
        groups[key].append(name)
    return [group for group in groups.values() if len(group) > 1]


def _measure_cameras(parts: Parts) -> list[CameraFacts]:
    views_by_camera: dict[object, list[View]] = defaultdict(list)
    for view in parts.views:
        views_by_camera[(view.lens or view.camera, parts.models.get(view.name))].append(view)
    cameras = []
    for views in views_by_camera.values():
        lens, camera = views[0].lens, views[0].camera
        original = lens.camera if lens else camera
        model = parts.models.get(views[0].name) or (lens.model if lens else "PINHOLE")
        area_fraction = camera.width * camera.height / (original.width * original.height)
        is_centered = 0 <= original.cx <= original.width and 0 <= original.cy <= original.height
        size, focal = (original.width, original.height), (original.fx, original.fy)
        faces = len(lens.faces) if lens and lens.is_wide else 0
        displacement, area_fraction = (0.0, 1.0) if faces or not lens else (measure_distortion(lens), area_fraction)
        cameras.append(CameraFacts(len(views), model, *size, focal, displacement, area_fraction, is_centered, faces))
    return sorted(cameras, key=lambda facts: -facts.views)


def measure_capture(files: Sequence[Path]) -> CaptureFacts:
    """Count the sizes, cameras and GPS positions in the headers of image files, skipping unreadable files."""
    sizes, cameras, located_count = Counter[str](), Counter[str](), 0
    for file in files:
        with suppress(DataError):
            header, (camera, has_position) = read_header(file), read_exif_camera(file)
            sizes[f"{header.width}x{header.height}"] += 1
            cameras[camera or "unknown"] += 1
            located_count += has_position
    return CaptureFacts(dict(sizes.most_common()), dict(cameras.most_common()), located_count)


def _measure_photographs(parts: Parts, missing_files: set[Path]) -> PhotographFacts:
    views = parts.views
    decoded_files = decode_all(view for view in views if view.image_path not in missing_files)
    blank, unusable_reason = list[str](), ""
    try:
        blank = require_content(parts.path, parts.scene.split("train") if parts.scene else views, decoded_files)
    except DataError as error:
        unusable_reason = str(error)
    mask_count = sum(view.mask_path is not None for view in views)
    facts = PhotographFacts({}, [], {}, [], [], mask_count, blank, unusable_reason)
    for view in views:
        files = {view.name: view.image_path, f"mask of {view.name}": view.mask_path}
        files[f"static mask of {view.name}"] = view.static_path
        for name, file in files.items():
            if file in decoded_files:
                _add_photograph(facts, view, name, file, decoded_files[file])
    return facts


def _add_photograph(facts: PhotographFacts, view: View, name: str, path: Path, file: ImageFile) -> None:
    """Add the faults of a view's photograph or mask to the facts.  name: the name of the file in the facts."""
    camera = view.lens or view.camera
    if file.is_truncated:
        facts.cut.append(name)
    elif file.size is None:
        facts.unreadable[name] = file.fault.removeprefix(f"{path}: ")
    elif file.fault and not fits_camera(view, file.size):
        facts.misfits[name] = f"{file.size[0]}x{file.size[1]}, its camera {camera.width}x{camera.height}"
        if fits_camera(view, file.size[::-1]):
            facts.on_side.append(name)
    elif file.orientation > 1 and fits_camera(view, file.size):
        facts.exif_turned.append(name)  # the reader rotates only files whose stored size does not fit


# Read a dataset in parts: a damaged part is recorded as a fault, and the other parts are still read.

LOG = logging.getLogger("clsplat")


def read_parts(path: Path) -> Parts:
    """Read a dataset like read_scene, but each part separately.  Raises DataError if the folder does not exist."""
    parts = Parts(path)
    with log_level(logging.ERROR):
        try:
            parts.scene = read_scene(path)
            if parts.scene.points:
                require_points_in_front(parts.scene.points, parts.scene)
        except DataError as error:
            if not path.is_dir():
                raise
            parts.refusal = str(error)
        if reader := parts.attempt(find_dataset, path):
            parts.path, parts.kind = reader.folder, reader.name
            reader.list_parts(parts)
            parts.path = path
            parts.notes += filter(None, [reader.note])
            if parts.scene and parts.points:
                parts.points = parts.points._replace(positions=parts.points.positions - parts.scene.origin)
    if parts.kind == "none":
        _list_photographs(parts)
    elif parts.image_folder or not parts.expected_files:
        folder = parts.image_folder or path / "images"
        parts.disk_files = list(list_image_files(folder if folder.is_dir() else path, recursive=True))
    else:
        folders = sorted({file.parent for file in parts.expected_files})
        parts.disk_files = [file for folder in folders for file in list_image_files(folder, recursive=False)]
    if parts.scene:  # list_parts may also list views that belong to no split
        parts.views = list({view.name: view for view in map(View.full_photograph, parts.scene.views)}.values())
    return parts


def _list_photographs(parts: Parts) -> None:
    """List the photographs in a folder without cameras, and the warnings that preparing them would log."""
    parts.disk_files = list(list_image_files(parts.path, recursive=True))
    with captured_log(logging.WARNING) as parts.warnings:
        try:
            list_photographs(parts.path)
        except DataError as error:
            if parts.disk_files or parts.warnings:
                parts.refusal = str(error)


def list_image_files(folder: Path, recursive: bool) -> Iterator[Path]:
    """Yield the image files in a folder, sorted by name; with `recursive`, also the files in its subfolders."""
    for parent, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if not f.startswith(".")) if recursive else []
        yield from (Path(parent) / n for n in sorted(names) if is_image(Path(n)) and not n.startswith("."))
