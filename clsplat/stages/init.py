"""Initialize Gaussians: from the scene's points, at random, or from a model file."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.settings import InputPath
from clsplat.formats.splats import Parameters, with_degree
from clsplat.gaussians.conversion import from_points
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.model import load
from clsplat.scene.plane_sweep import sweep_points
from clsplat.scene.quality import is_transparent, opaque_pixels
from clsplat.scene.reprojection import require_points_in_front
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.view import View, load_image, load_rgba
from clsplat.scene.viewpoint import random_points, scene_box, scene_center
from clsplat.scene.visual_hull import hull_points
from clsplat.stages.init_motion import add_motion, require_times, with_motion
from clsplat.training.memory import offload_target, table_widths
from clsplat.training.modules.sky_choice import start_sky
from clsplat.training.run import Run
from clsplat.training.sh_offload import offload_advice
from clsplat.training.stage import Stage

# Sources of points: the scene, a plane sweep over the photos, the visual hull.

LOG = logging.getLogger("clsplat")
MIN_POINTS = 100  # with fewer points from a sweep or a hull, random ones are used


def scene_points(scene: Scene) -> PointCloud:
    """Return the points of a scene.  Raises DataError if it has no points, or if all are behind its cameras."""
    if scene.points is None:
        raise DataError(f"{scene.path}: the scene has no points; use `init: {{source: sweep}}`")
    require_points_in_front(scene.points, scene)
    return scene.points


def sweep_photos(run: Run, count: int) -> PointCloud:
    """Return at most `count` points from a plane sweep over the training photos."""
    views = _training_views(run)
    return sweep_points(views, scene_center(views), load_image, count, run.seed)


def points_with_sweep(run: Run, count: int) -> PointCloud:
    """Return the scene's points and at most `count` additional points from a plane sweep.

    Transparent and masked pixels give no points.  Raises DataError if the scene has no points.
    """
    points, views = scene_points(run.scene), _training_views(run)
    positions = points.positions.astype(np.float64)
    new_points = sweep_points(views, scene_center(views), load_image, count, run.seed, positions, opaque_pixels)
    if not len(new_points):
        LOG.warning("the plane sweep found no additional points; starting from the scene's points only")
    return points.joined(new_points)


def try_sweep(run: Run, count: int) -> PointCloud | None:
    """Return the points of `sweep_photos`, or None, with a warning, if there are too few."""
    points = sweep_photos(run, count)
    if len(points) < MIN_POINTS:
        remedy = "photos taken closer together give more points"
        LOG.warning("the plane sweep found only %d points; starting from random points; %s", len(points), remedy)
        return None
    return points


def sample_hull(run: Run, count: int) -> PointCloud | None:
    """Return at most `count` points on the visual hull, or None, with a warning, if there are too few."""
    points = hull_points(_training_views(run), *scene_box(run.scene), load_rgba, count, run.seed)
    if len(points) < MIN_POINTS:
        remedy = "it needs photos with a transparent background and no mask files; or use `init: {source: sweep}`"
        LOG.warning("the visual hull has only %d points; starting from random points; %s", len(points), remedy)
        return None
    return points


def _training_views(run: Run) -> list[View]:
    """Return the training views at the training size."""
    return [view for view in run.scene.split("train") if view.downscale == run.downscale]


class Init(Stage):
    """Make isotropic Gaussians as large as the mean distance to the three nearest neighbors (Kerbl et al. 2023).

    `source: auto` uses the scene's points.  If the scene has fewer than `min_points` and opaque photos, points of a
    plane sweep are added.  If the scene has no points, `auto` uses a plane sweep for opaque photos, and the source in
    `transparent` for photos with transparent pixels.  `random` draws points in a box around the point that the cameras
    look at, as published; `hull` samples the visual hull in that box.  `points+sweep` always adds points of a sweep,
    except at pixels that are transparent or already show a point of the scene.
    """

    stage: Literal["init"] = "init"
    makes: ClassVar[frozenset[str]] = frozenset({"model", "painter"})
    removes: ClassVar[frozenset[str]] = frozenset({"adam", "stats", "palette", "field", "metrics"})
    edits: ClassVar[bool] = True

    source: Literal["auto", "points", "points+sweep", "sweep", "hull", "random", "model"] = "auto"
    """Source of the initial Gaussians."""
    transparent: Literal["random", "hull"] = "random"
    """Source that `auto` uses for a scene without points whose photos have transparent pixels."""
    min_points: Annotated[int, Field(ge=0)] = 0
    """Number of scene points below which `auto` adds points of a plane sweep."""
    opacity: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Opacity of the initial Gaussians."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Factor by which the sizes of the initial Gaussians are multiplied."""
    count: Annotated[int, Field(gt=0)] = 100_000
    """Number of random points, or maximum number of points on a visual hull."""
    sweep_points: Annotated[int, Field(gt=0)] = 20_000
    """Maximum number of points from a plane sweep."""
    times: Literal["uniform", "per_frame"] = "uniform"
    """Center in time of moving Gaussians: random, or the timestamp of the point's observation in the dataset.  With
    `per_frame`, points whose neighbors were observed at all times start static; others start with the spread of their
    neighbors' timestamps as duration, and with the velocity of the neighbors."""
    duration: Annotated[float, Field(gt=0)] = 4.0
    """Initial standard deviation in time, as a fraction of the scene's duration; with a large value, the scene starts
    static."""
    min_duration: Annotated[float, Field(gt=0)] = 0.1
    """Shortest duration of moving Gaussians with `times: per_frame`, as a fraction of the scene's duration."""
    file: InputPath | None = None
    """Model file of any format, or a run folder, for `source: model`."""

    def check(self) -> None:
        if self.source == "model" and self.file is None:
            raise ConfigError("init.file: 'source: model' needs a model file or a run folder; set 'file'")

    def check_run(self, run: Run) -> None:
        require_times(run.scene, run.model_settings.time)
        source = self._source(run.scene)
        if source == "model":
            self._read_model(run.scene)
        elif source in ("random", "hull"):
            self._require_memory(run, self.count)
        elif source in ("points", "points+sweep"):
            self._require_memory(run, len(scene_points(run.scene)))

    def run(self, run: Run) -> None:
        degree = run.model_settings.sh_degree
        require_times(run.scene, run.model_settings.time)
        parameters, source = self._parameters(run, degree)
        gaussians = Gaussians(run.device, parameters)
        run.adam, run.stats, run.metrics = None, None, {}  # those of an earlier model
        run.model = run.model_settings.model(gaussians, degree if self.source == "model" else 0)
        run.refresh_filter()
        start_sky(run, load(Path(self.file)) if source == "model" and self.file else None)
        LOG.info("%s Gaussians from %s", f"{run.model.gaussians.count:,}", self._origin(source, run.scene))

    def expected_count(self, scene: Scene) -> int:
        """Return the number of Gaussians, or the largest possible number if it depends on the photos.

        Raises DataError if the model file cannot be read.
        """
        source = self._source(scene)
        if source == "model":
            return len(self._read_model(scene)["means"])
        if source in ("points", "points+sweep"):
            return (0 if scene.points is None else len(scene.points)) + self.sweep_points * self._adds_sweep(scene)
        return self.sweep_points if source == "sweep" else self.count

    def _adds_sweep(self, scene: Scene) -> bool:
        """Return whether points from a plane sweep are added to the scene's points."""
        has_few_points = scene.points is not None and len(scene.points) < self.min_points
        return self.source == "points+sweep" or (self.source == "auto" and has_few_points and not is_transparent(scene))

    def _origin(self, source: str, scene: Scene) -> str:
        names = {
            "points": "the scene's points",
            "random": "random points",
            "sweep": "a plane sweep over the photos",
            "hull": "the visual hull",
            "points+sweep": "the scene's points and a plane sweep over the photos",
        }
        has_points = scene.points is not None or source == "model"
        return names.get(source, source) + ("" if has_points else ": the scene has no points")

    def _source(self, scene: Scene) -> str:
        if self.source != "auto":
            return self.source
        if scene.points is not None:
            return "points"
        return self.transparent if is_transparent(scene) else "sweep"

    def _parameters(self, run: Run, degree: int) -> tuple[Parameters, str]:
        """Return the parameters and their source, which is "random" if another source has too few points."""
        source = self._source(run.scene)
        if source == "model":
            parameters = with_degree(self._read_model(run.scene), degree)
            return with_motion(parameters, run.model_settings.time, str(self.file)), source
        sources: dict[str, Callable[[], PointCloud | None]] = {
            "sweep": lambda: try_sweep(run, self.sweep_points),
            "hull": lambda: sample_hull(run, self.count),
            "points": lambda: scene_points(run.scene),
            "points+sweep": lambda: points_with_sweep(run, self.sweep_points),
        }
        points = sources[source]() if source in sources else None
        if points is None:
            points, source = self._random_points(run), "random"
        if source == "points" and self._adds_sweep(run.scene):
            points, source = points.joined(sweep_photos(run, self.sweep_points)), "points+sweep"
        self._require_memory(run, len(points))
        parameters = from_points(points, self.opacity, degree, self.scale, run.scene.extent)
        times = points.times if self.times == "per_frame" else None
        return add_motion(
            parameters, run.model_settings.time, times, (self.duration, self.min_duration), run.seed
        ), source

    def _read_model(self, scene: Scene) -> Parameters:
        assert self.file is not None  # as `check` requires
        parameters = load(Path(self.file)).with_origin(scene.origin).tables()
        if not len(parameters["means"]):
            raise DataError(f"{self.file}: the model has no Gaussians to start from; use another file")
        return parameters

    @staticmethod
    def _require_memory(run: Run, count: int) -> None:
        """Raise MemoryLimitError if `count` Gaussians do not fit."""
        motion = run.model_settings.time
        tables = table_widths(run.model_settings.sh_degree, motion.width if motion else 0)
        run.memory_plan(tables, offload_target(run.harmonics, run.device.info)).check(count, offload_advice(run))

    def _random_points(self, run: Run) -> PointCloud:
        """Return random points.  Raises MemoryLimitError, before allocating any, if they would not fit."""
        self._require_memory(run, self.count)
        return random_points(run.scene, self.count, run.seed)
