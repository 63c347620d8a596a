"""Locate points that are marked in photos, and read control points, scale bars, and GPS positions."""

import csv
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, quote
from clsplat.core.reading import read_text
from clsplat.scene.images import read_exif_position
from clsplat.scene.points import BELOW_MAX, MAX_VALUE
from clsplat.scene.reprojection import project_points
from clsplat.scene.scene import Scene
from clsplat.scene.similarity import fit_without_outliers
from clsplat.scene.view import NO_FILE, View, photo_lens

Floats = NDArray[np.float64]

# Points that are marked in photos.

MIN_ANGLE = math.radians(1)  # smallest angle between two rays to a point that determines its depth
MAX_MARK_ERROR = 10.0  # px from a mark to the point of the scene that it selects
MIN_ERROR = 2.0  # px: a mark with a smaller error is not an outlier


@dataclass(frozen=True)
class Mark:
    """A point marked in a photo."""

    photo: str  # name of the view
    pixel: tuple[float, float]  # px of the original photo; the top left corner of the image is (0, 0)


@dataclass(frozen=True)
class LocatedMark:
    """A mark, and its distance from the projection of the located point."""

    mark: Mark
    error: float  # px
    is_outlier: bool = False


@dataclass(frozen=True)
class MarkedPoint:
    """A point with its marks, and its coordinates if they are known."""

    name: str
    marks: tuple[Mark, ...] = ()
    coordinates: tuple[float, float, float] | None = None

    def locate(self, scene: Scene) -> tuple[Floats, list[LocatedMark]]:
        """Return the position of the point in the coordinates of `scene`, [3], and each mark with its error.

        Two or more marks are triangulated.  A single mark selects the structure-from-motion point whose projection is
        nearest to the mark, among the points that the photo shows.
        Raises DataError if the marks do not determine a position.
        """
        views = [find_view(scene, mark.photo) for mark in self.marks]
        pixels = np.array([mark.pixel for mark in self.marks])
        sizes = [(photo.width, photo.height) for photo in (view.lens or view.camera for view in views)]
        for i in np.flatnonzero(((pixels < 0) | (pixels > sizes)).any(axis=1)):
            raise DataError(f"point {quote(self.name)}: its mark in {self.marks[i].photo} is outside the photo; fix it")
        if len(views) == 1:
            return self._find_nearest_point(scene, views[0], pixels)
        rays = [_ray(view, pixel) for view, pixel in zip(views, pixels, strict=True)]
        directions = np.stack([direction for _, direction in rays])
        if not (directions @ directions.T).min() <= math.cos(MIN_ANGLE):
            raise DataError(
                f"point {quote(self.name)}: its photos show it from almost the same direction; mark it in another photo"
            )

        def errors(position: Floats) -> Floats:
            offsets = np.concatenate([project_points(view, position[None]) for view in views]) - pixels
            return np.asarray(np.nan_to_num(np.linalg.norm(offsets, axis=1), nan=np.inf))

        def fit(rows: NDArray[np.intp]) -> Floats:
            return _triangulate([views[i] for i in rows], pixels[rows], [rays[i] for i in rows])

        position, is_outlier = fit_without_outliers(fit, errors, len(views), 2, MIN_ERROR)
        distances = errors(position)
        if not np.isfinite(distances[~is_outlier]).all():
            raise DataError(f"point {quote(self.name)}: its rays do not meet in front of the cameras; fix its marks")
        rows = zip(self.marks, distances.tolist(), is_outlier.tolist(), strict=True)
        return position, [LocatedMark(*row) for row in rows]

    def _find_nearest_point(self, scene: Scene, view: View, pixels: Floats) -> tuple[Floats, list[LocatedMark]]:
        rows = scene.tracks.rows.get(view.name) if scene.tracks else None
        if scene.tracks is None or rows is None or not len(rows):
            raise DataError(
                f"point {quote(self.name)}: has only one mark, in {self.marks[0].photo}; mark it in another photo"
            )
        positions = scene.tracks.positions[rows].astype(np.float64)
        errors = np.nan_to_num(np.linalg.norm(project_points(view, positions) - pixels, axis=1), nan=np.inf)
        nearest = int(errors.argmin())
        if not errors[nearest] <= MAX_MARK_ERROR:
            raise DataError(
                f"point {quote(self.name)}: no point of the scene is within {MAX_MARK_ERROR:g} px of its mark in "
                f"{self.marks[0].photo}; mark it in another photo, too"
            )
        return positions[nearest], [LocatedMark(self.marks[0], float(errors[nearest]))]


def find_view(scene: Scene, photo: str) -> View:
    """Return the view of a photo, given by its name in the dataset, its file name, or its stem.  Raises DataError."""
    for key in (str, lambda name: PurePosixPath(name).name, lambda name: PurePosixPath(name).stem):
        views = [view for view in scene.views if key(view.name) == key(photo)]
        if len(views) == 1:
            return views[0]
    matches = difflib.get_close_matches(photo, [view.name for view in scene.views], n=1)
    hint = f"; did you mean {quote(matches[0])}?" if matches else "; use a name from the dataset"
    fault = f"{len(views)} photos are" if views else "no photo is"
    raise DataError(f"{fault} named {quote(photo)}{hint}")


def _ray(view: View, pixel: Floats) -> tuple[Floats, Floats]:
    """Return the origin and the unit direction of the ray of a pixel, [3] each; NaN where undistortion fails."""
    u, v = photo_lens(view).undistort(pixel[:1], pixel[1:])
    direction = view.world_to_camera[:, :3].T @ np.array([u[0], v[0], 1.0])
    return view.position.astype(np.float64), direction / np.linalg.norm(direction)


def _triangulate(views: Sequence[View], pixels: Floats, rays: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return the position, [3], with the smallest sum of squared reprojection errors; NaN if the rays are parallel."""
    planes = np.stack([np.eye(3) - np.outer(direction, direction) for _, direction in rays])
    centers = np.stack([center for center, _ in rays])
    if not np.linalg.cond(planes.sum(axis=0)) < 1e8:
        return np.full(3, np.nan)
    start = np.linalg.solve(planes.sum(axis=0), np.einsum("vij,vj->i", planes, centers))

    def residuals(position: Floats) -> Floats:
        return np.concatenate([project_points(view, position[None]) for view in views]).ravel() - pixels.ravel()

    if not np.isfinite(residuals(start)).all():
        return np.full(3, np.nan)
    try:
        return np.asarray(scipy.optimize.least_squares(residuals, start, x_scale=np.ptp(centers, axis=0).max()).x)
    except ValueError:  # a step moved the point behind a camera
        return start


# Files of control points, and scale bars.

COLUMNS = ("point", "x", "y", "z", "photo", "u", "v")
MAX_CONTROL = 1 << 24  # bytes


def read_control(path: Path) -> dict[str, MarkedPoint]:
    """Read the points of a CSV file, one mark per row: point, x, y, z, photo, u, v; other columns are ignored.

    x, y, and z are the known coordinates of the point.  They may be empty in all but one row of a point, or in all rows
    if only scale bars use the point.  Raises DataError, which names the line.
    """
    reader = csv.DictReader(read_text(path, "a CSV file of control points", limit=MAX_CONTROL).splitlines())
    points: dict[str, MarkedPoint] = {}
    try:
        names = [name.strip().lower() for name in reader.fieldnames or ()]
        if missing_columns := [name for name in COLUMNS if name not in names]:
            raise DataError(f"{path}:1: has no column {missing_columns[0]}; expected the header {','.join(COLUMNS)}")
        reader.fieldnames = names
        for row in reader:
            source = f"{path}:{reader.line_num}"
            name, photo = ((row[key] or "").strip() for key in ("point", "photo"))
            if not name or not photo or set(name) & set(",;=:+"):
                raise DataError(
                    f"{source}: expected the name of a photo, and a name of a point without , ; = : +; correct this row"
                )
            pixel = [_parse_number(source, key, row[key]) for key in ("u", "v")]
            texts = [(row[key] or "").strip() for key in "xyz"]
            coordinates = None
            if any(texts):
                x, y, z = (_parse_number(source, key, text) for key, text in zip("xyz", texts, strict=True))
                coordinates = (x, y, z)
            old = points.get(name, MarkedPoint(name))
            if coordinates and old.coordinates and coordinates != old.coordinates:
                fault = f"point {quote(name)} has different coordinates in an earlier row"
                raise DataError(f"{source}: {fault}; correct one of them")
            mark = Mark(photo, (pixel[0], pixel[1]))
            points[name] = MarkedPoint(name, (*old.marks, mark), coordinates or old.coordinates)
    except csv.Error as error:
        raise DataError(f"{path}:{reader.line_num}: {error}; expected rows of {','.join(COLUMNS)}") from error
    return points


def _parse_number(source: str, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) < MAX_VALUE:
        raise DataError(f"{source}: {name} is {quote(text or '')}; expected {BELOW_MAX}")
    return value


@dataclass(frozen=True)
class ScaleBar:
    """A known distance between two points, each given by its coordinates or by marks in photos."""

    text: str
    ends: tuple[Floats | MarkedPoint, Floats | MarkedPoint]
    length: float  # the known distance

    @classmethod
    def parse(cls, text: str, points: Mapping[str, MarkedPoint]) -> "ScaleBar":
        """Parse `A;B=LENGTH`.  An end is x,y,z, or PHOTO:u,v+PHOTO:u,v, or the name of one of `points`.

        Two names may also be separated by a comma.  Raises ConfigError.
        """
        ends, _, length_text = text.rpartition("=")
        parts = ends.split(";") if ";" in ends else ends.split(",")
        try:
            length = float(length_text)
            if len(parts) != 2 or not 0 < length < MAX_VALUE:
                raise ValueError
            first, second = (_parse_end(part.strip(), points) for part in parts)
        except ValueError:
            raise ConfigError(
                f"--distance {quote(text)}: expected A;B=LENGTH with a LENGTH above 0, where A and B are x,y,z, or "
                "PHOTO:u,v+PHOTO:u,v, or names of points in the control file"
            ) from None
        return cls(text, (first, second), length)

    def measure(self, scene: Scene | None) -> float:
        """Return the distance between the ends in scene units.  Raises ConfigError or DataError."""
        positions = []
        for end in self.ends:
            if not isinstance(end, MarkedPoint):
                positions.append(end - (scene.origin if scene else 0.0))
            elif scene is None:
                raise ConfigError(f"--distance {quote(self.text)}: marks need the photos of a scene; add --scene")
            else:
                positions.append(end.locate(scene)[0])
        distance = float(np.linalg.norm(positions[0] - positions[1]))
        if not distance > 0:
            raise DataError(f"--distance {quote(self.text)}: both ends are the same point; use two different points")
        return distance


def _parse_end(text: str, points: Mapping[str, MarkedPoint]) -> Floats | MarkedPoint:
    """Parse one end of a scale bar.  Raises ValueError."""
    if text in points:
        return points[text]
    if ":" not in text:
        position = np.array([float(number) for number in text.split(",")])
        if position.shape != (3,) or not (np.abs(position) < MAX_VALUE).all():
            raise ValueError(text)
        return position
    marks = []
    for mark in text.split("+"):
        photo, _, pixel = mark.rpartition(":")
        u, v = (float(number) for number in pixel.split(","))
        marks.append(Mark(photo.strip(), (u, v)))
    return MarkedPoint(text, tuple(marks))


# GPS positions in map coordinates (WGS 84 / UTM).

SEMI_MAJOR_AXIS, FLATTENING, CENTRAL_SCALE = 6378137.0, 1 / 298.257223563, 0.9996  # m; of WGS 84 and UTM
FALSE_EASTING, FALSE_NORTHING = 500_000.0, 10_000_000.0  # m


@dataclass(frozen=True)
class GpsPositions:
    """The GPS positions of photos in one UTM zone."""

    views: list[View]  # one view of each photo with a position
    positions: Floats = field(repr=False)  # [N, 3] easting, northing, altitude, m
    epsg: int  # code of the coordinate system

    @classmethod
    def from_scene(cls, scene: Scene) -> "GpsPositions":
        """Read the positions from the EXIF data of the photos.  Raises DataError if no photo has one."""
        by_file = {view.image_path: view for view in scene.views if view.image_path != NO_FILE}
        rows = [(view, position) for file, view in by_file.items() if (position := read_exif_position(file))]
        if not rows:
            raise DataError(f"{scene.path}: no photo has a GPS position with altitude in EXIF; use --control instead")
        positions, epsg = to_utm(np.array([position for _, position in rows]))
        return cls([view for view, _ in rows], positions, epsg)


def to_utm(positions: Floats) -> tuple[Floats, int]:
    """Convert latitude, longitude (degrees) and altitude (m), [N, 3], to UTM, in the zone of their median longitude.

    Returns easting, northing, and altitude, [N, 3] m, and the EPSG code.  Krüger's series to the third order is
    accurate to a millimeter.
    """
    zone = int((np.median(positions[:, 1]) + 180) // 6) % 60 + 1
    is_south = float(np.median(positions[:, 0])) < 0
    latitude, longitude = np.radians(positions[:, 0]), np.radians(positions[:, 1] - (6 * zone - 183))
    n = FLATTENING / (2 - FLATTENING)
    radius = SEMI_MAJOR_AXIS / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    eccentricity = 2 * math.sqrt(n) / (1 + n)
    sine = np.clip(np.sin(latitude), -1 + 1e-15, 1 - 1e-15)
    t = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    sphere = np.arctan2(t, np.cos(longitude)) + 1j * np.arctanh(np.sin(longitude) / np.hypot(1, t))
    series = (n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3, 13 / 48 * n**2 - 3 / 5 * n**3, 61 / 240 * n**3)
    plane = sphere + sum(a * np.sin(2 * j * sphere) for j, a in enumerate(series, 1))
    easting = FALSE_EASTING + CENTRAL_SCALE * radius * plane.imag
    northing = CENTRAL_SCALE * radius * plane.real + FALSE_NORTHING * is_south
    return np.stack([easting, northing, positions[:, 2]], axis=1), (32700 if is_south else 32600) + zone
