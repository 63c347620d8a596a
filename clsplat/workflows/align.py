"""Give scenes and models a known scale, up direction, and position."""

import logging
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.text_table import text_table
from clsplat.formats.splats import WriteOptions
from clsplat.formats.table import format_from_name, model_file
from clsplat.gaussians.conversion import check_output, solid_means, write_model
from clsplat.gaussians.model import Model, load, model_path
from clsplat.runs.model_file import ModelSource, find_run, refuse_field
from clsplat.runs.state import has_pipeline
from clsplat.scene.camera_files import IMAGES, write_cameras
from clsplat.scene.control import GpsPositions, LocatedMark, MarkedPoint, ScaleBar, read_control
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Scene
from clsplat.scene.similarity import UP, Correspondences, Similarity, level
from clsplat.scene.viewpoint import ground_plane, up_direction
from clsplat.training.modules.base import apply_side_files

LOG = logging.getLogger("clsplat")
Floats = NDArray[np.float64]
Level = Literal["cameras", "ground"]


@dataclass(frozen=True)
class AlignOptions:
    """Options of an alignment: what is known about the scale, up direction, and position of a scene."""

    level: Level | None = None  # where the up direction comes from
    distances: tuple[str, ...] = ()  # scale bars, see clsplat/scene/control.py
    gps: bool = False  # positions of the cameras in the EXIF data of the photos
    control: Path | None = None  # a CSV file of marked points

    def __post_init__(self) -> None:
        if self.level not in (None, "cameras", "ground"):
            raise ConfigError(f"--level {self.level}: expected cameras or ground")
        if self.gps and self.control:
            raise ConfigError("--gps and --control cannot be combined; use --control, which is more precise")
        if not (self.level or self.distances or self.gps or self.control):
            raise ConfigError("align: expected --level, --distance, --gps, or --control")


@dataclass(frozen=True)
class AlignInput:
    """The scene to align, the model to align, or both.  Their coordinates are relative to the same origin."""

    path: Path
    scene: Scene | None = None
    model: Model | None = None

    @classmethod
    def read(cls, path: Path, scene: Path | None, needs_model: bool) -> "AlignInput":
        """Read a dataset folder, a run folder, or a model file.

        scene: the dataset folder of a model; default: that of its run, if any; must be None if `path` is a dataset
        folder.  Raises ConfigError, DataError.
        """
        if path.is_dir() and not has_pipeline(path) and not model_file(path).is_file():
            if scene is not None:
                raise ConfigError(f"{path}: is a scene; omit --scene, or name a model file")
            return cls(path, read_scene(path, holdout=0))
        refuse_field(path)
        if scene is None and find_run(path) is None:
            return cls(path, None, load(path))
        source = ModelSource.from_model(path, scene)
        original = read_scene(source.folder, source.settings.split)
        original = apply_side_files(source.file, original) if scene is None else original
        model = load(model_path(path)).with_origin(original.origin) if needs_model or path.is_file() else None
        return cls(path, original, model)

    @property
    def origin(self) -> Floats:
        """The world coordinates of the origin of the scene and the model, [3]."""
        return np.asarray(self.scene.origin if self.scene else self.model.origin if self.model else np.zeros(3))

    def require_scene(self, option: str) -> Scene:
        """Return the scene.  Raises ConfigError if a bare model has none."""
        if self.scene is None:
            raise ConfigError(f"{self.path}: {option} needs the cameras of a scene; add --scene")
        return self.scene

    def up(self, source: Level) -> tuple[Floats, Floats, float | None]:
        """Return the up direction, [3], a point to rotate about, [3], and the height of the ground, if known."""
        if source == "cameras":
            views = self.require_scene("--level cameras").views
            return up_direction(views), np.median([view.position for view in views], axis=0), None
        expected_up = up_direction(self.scene.views) if self.scene else UP
        candidates = [self.scene.points.positions] if self.scene and self.scene.points else []
        candidates += [solid_means(self.model)] if self.model is not None else []
        error = DataError("has no points, so the ground cannot be found; use --level cameras")
        for points in candidates:  # first the points of the scene, so that a run's model is leveled like its cameras
            try:
                up, height = ground_plane(points, expected_up)
            except DataError as failure:
                error = failure
            else:
                return up, np.median(points, axis=0).astype(np.float64), height
        raise DataError(f"{self.path}: {error}") from error


@dataclass(frozen=True)
class Residual:
    """The error of a point after the alignment, in the unit of its known coordinates."""

    name: str
    position: list[float]  # after the alignment
    error: list[float]  # aligned minus known coordinates
    distance: float  # length of `error`
    is_outlier: bool
    marks: list[LocatedMark]


@dataclass(frozen=True)
class Alignment:
    """The transform from the world coordinates of a scene to its new coordinates, and the remaining errors."""

    transform: Similarity
    residuals: list[Residual]
    bars: list[dict[str, Any]]  # of each scale bar: text, length, and measured length
    epsg: int | None = None  # of coordinates from GPS

    @classmethod
    def solve(cls, inputs: AlignInput, options: AlignOptions) -> "Alignment":
        """Return the transform that meets the options.

        Raises ConfigError for options that need a scene, and DataError for too few or contradictory measurements.
        """
        points = read_control(options.control) if options.control else {}
        bars = [ScaleBar.parse(text, points) for text in options.distances]
        bar_lengths = np.array([bar.measure(inputs.scene) for bar in bars])
        lengths = np.array([bar.length for bar in bars])
        scale = float(lengths @ bar_lengths / (bar_lengths @ bar_lengths)) if bars else None
        up, anchor, height = inputs.up(options.level) if options.level else (UP, np.zeros(3), None)
        targets = _gps_targets(inputs) if options.gps else _control_targets(inputs, options.control, points)
        if targets.names:
            known_up = up if options.level else None
            fit = Correspondences(targets.source + inputs.origin, targets.target, scale, known_up)
            transform, is_outlier = fit.fit_inliers()
            residuals = targets.residuals(transform, inputs.origin, is_outlier)
        elif bars or options.level:
            height = None if height is None else height + float(up @ inputs.origin)
            transform, residuals = level(up, anchor + inputs.origin, height, scale or 1.0), []
        else:
            raise DataError(f"{options.control}: no point has x, y, and z; add them, or use --distance between points")
        rows = [
            {"distance": bar.text, "length": bar.length, "measured": transform.scale * value}
            for bar, value in zip(bars, bar_lengths.tolist(), strict=True)
        ]
        return cls(transform, residuals, rows, targets.epsg)

    def data(self) -> dict[str, Any]:
        """Return the alignment as JSON values."""
        inlier_distances = [residual.distance for residual in self.residuals if not residual.is_outlier]
        return {
            "scale": self.transform.scale,
            "matrix": self.transform.matrix.tolist(),
            "epsg": self.epsg,
            "rms": math.sqrt(sum(d**2 for d in inlier_distances) / len(inlier_distances)) if inlier_distances else None,
            "outliers": [residual.name for residual in self.residuals if residual.is_outlier],
            "points": [asdict(residual) for residual in self.residuals],
            "distances": self.bars,
        }


@dataclass(frozen=True)
class Targets:
    """N points: their positions in the scene, `source`, and their known coordinates, `target`."""

    names: list[str]
    source: Floats  # [N, 3], relative to the origin of the scene
    target: Floats  # [N, 3]
    marks: list[list[LocatedMark]]
    epsg: int | None = None

    def residuals(self, transform: Similarity, origin: Floats, is_outlier: NDArray[np.bool_]) -> list[Residual]:
        """Return the error of each point, and log the names of outliers."""
        positions = transform.apply(self.source + origin)
        residuals = []
        for i, (name, error) in enumerate(zip(self.names, positions - self.target, strict=True)):
            distance = float(np.linalg.norm(error))
            row = Residual(name, positions[i].tolist(), error.tolist(), distance, bool(is_outlier[i]), self.marks[i])
            residuals.append(row)
            if row.is_outlier:
                LOG.warning("%s: is an outlier, %.3g from its known position, and is not used", name, distance)
            for mark in (mark for mark in row.marks if mark.is_outlier):
                LOG.warning("%s: its mark in %s is %.3g px off, and is not used", name, mark.mark.photo, mark.error)
        return residuals


def _gps_targets(inputs: AlignInput) -> Targets:
    """Return the cameras with GPS positions.  Raises ConfigError, DataError."""
    gps = GpsPositions.from_scene(inputs.require_scene("--gps"))
    source = np.stack([view.position for view in gps.views]).astype(np.float64)
    LOG.info("%d photos have a GPS position; coordinates are UTM, EPSG:%d", len(gps.views), gps.epsg)
    return Targets([view.name for view in gps.views], source, gps.positions, [[] for _ in gps.views], gps.epsg)


def _control_targets(inputs: AlignInput, file: Path | None, points: Mapping[str, MarkedPoint]) -> Targets:
    """Return the points with known coordinates, located in the scene.  Raises ConfigError, DataError."""
    controls = [point for point in points.values() if point.coordinates is not None]
    if not controls:
        return Targets([], np.zeros((0, 3)), np.zeros((0, 3)), [])
    scene = inputs.require_scene("--control")
    try:
        located = [point.locate(scene) for point in controls]
    except DataError as error:
        raise DataError(f"{file}: {error}") from error
    source, target = np.stack([position for position, _ in located]), np.array([p.coordinates for p in controls])
    return Targets([point.name for point in controls], source, target, [marks for _, marks in located])


def align(
    path: Path,
    out: Path,
    scene: Path | None,
    options: AlignOptions,
    format_: str = "colmap",
    images: str = "copy",
) -> dict[str, Any]:
    """Align a scene, a run, or a model file.  The name of `out` selects the output: a model file, or cameras.

    Returns the alignment as JSON values, and `files`.  Raises ClsplatError.
    """
    is_model = format_from_name(out) is not None
    inputs = AlignInput.read(path, scene, is_model)
    if not is_model:
        if inputs.scene is None:
            raise ConfigError(f"{out}: is the name of a folder, and {path} is a model; use a name that ends in .ply")
        if out.resolve() in (path.resolve(), inputs.scene.path.resolve()):
            raise ConfigError(f"{out}: is the input; use another folder")
        alignment = Alignment.solve(inputs, options)
        files = write_cameras(alignment.transform.transform_scene(inputs.scene), out, format_, images)
        if images == "none":
            LOG.warning("%s: has no photos, and a scene needs them; copy them to %s", out, out / IMAGES)
        return {**alignment.data(), "files": [str(file) for file in files]}
    if inputs.model is None:
        raise ConfigError(f"{out}: is the name of a model, and {path} is a scene; use the name of a folder")
    check_output([path], out)
    alignment = Alignment.solve(inputs, options)
    transform = alignment.transform
    try:
        model = inputs.model.transformed(transform.scale, transform.rotation, transform.translation)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error
    return {**alignment.data(), "files": [write_model([path], model, out, WriteOptions())["file"]]}


def format_table(result: Mapping[str, Any]) -> str:
    """Format the errors of the points and distances of an alignment as a text table."""
    rows = [["point", "dx", "dy", "dz", "distance", "pixels", ""]] if result["points"] else []
    for point in result["points"]:
        pixels = max((mark["error"] for mark in point["marks"] if not mark["is_outlier"]), default=None)
        numbers = [f"{value:.4g}" for value in (*point["error"], point["distance"])]
        note = "outlier" if point["is_outlier"] else ""
        rows.append([point["name"], *numbers, "" if pixels is None else f"{pixels:.2f}", note])
    for bar in result["distances"]:
        rows.append([bar["distance"], "", "", "", f"{bar['measured'] - bar['length']:.4g}", "", ""])
    return text_table(rows, left_columns=1)
