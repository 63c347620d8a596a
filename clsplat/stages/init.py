"""The first Gaussians: from the scene's points, at random, or from a model file."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.settings import InputPath
from clsplat.formats.splats import Parameters, with_degree
from clsplat.gaussians.conversion import from_points
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.model import load
from clsplat.scene.plane_sweep import swept_points
from clsplat.scene.quality import is_transparent, laplacian_probability, opaque_pixels
from clsplat.scene.reprojection import require_points_in_front
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.view import View, load_image, load_rgba
from clsplat.scene.viewpoint import random_points, scene_box, scene_center
from clsplat.scene.visual_hull import hull_points
from clsplat.stages.init_motion import moving, require_times, with_motion
from clsplat.training.memory import first_tables, last_place
from clsplat.training.modules.sky_choice import start_sky
from clsplat.training.run import Run
from clsplat.training.sh_offload import more_room
from clsplat.training.stage import Stage

# Where the first Gaussians lie: at the scene's points, on surfaces that a sweep finds, or on a hull.

LOG = logging.getLogger("clsplat")
MIN_USABLE = 100  # with fewer from a sweep or a hull, random ones are used
Chance = Callable[[NDArray[np.floating]], NDArray[np.floating]]


def own_points(scene: Scene) -> PointCloud:
    """Return the points of a scene.  Raises DataError where it has none, or all lie behind its cameras."""
    if scene.points is None:
        raise DataError(f"{scene.path}: has no points to start from; use init: {{source: sweep}}")
    require_points_in_front(scene.points, scene)
    return scene.points


def swept(run: Run, count: int, chance: Chance | None) -> PointCloud:
    """Return at most `count` points of a sweep over the training photographs; `chance` as of `swept_points`."""
    views = _views(run)
    return swept_points(views, scene_center(views), load_image, count, run.seed, chance)


def points_and_sweep(run: Run, count: int, chance: Chance | None) -> PointCloud:
    """Return the scene's points, and at most `count` of a sweep that are not there already.

    Transparent pixels, and those that do not count, give none.  Raises DataError where the scene has no points.
    """
    own, views = own_points(run.scene), _views(run)
    beside = own.positions.astype(np.float64)
    new = swept_points(views, scene_center(views), load_image, count, run.seed, chance, beside, opaque_pixels)
    if not len(new):
        LOG.warning("the photographs agree on no points beside the scene's; starting from these alone")
    return own.joined(new)


def enough_swept(run: Run, count: int, chance: Chance | None) -> PointCloud | None:
    """Return the points of `swept`, or None, with a warning, where they are too few."""
    points = swept(run, count, chance)
    if len(points) < MIN_USABLE:
        remedy = "photographs from places that lie closer together agree on more"
        LOG.warning("the photographs agree on %d points only; starting from random ones; %s", len(points), remedy)
        return None
    return points


def on_hull(run: Run, count: int) -> PointCloud | None:
    """Return at most `count` points on the hull of the silhouettes, or None, with a warning, where they are too few."""
    points = hull_points(_views(run), *scene_box(run.scene), load_rgba, count, run.seed)
    if len(points) < MIN_USABLE:
        remedy = "they need transparency around what they show, and no masks; or use init: {source: sweep}"
        LOG.warning(
            "the photographs' silhouettes give %d points only; starting from random ones; %s", len(points), remedy
        )
        return None
    return points


def _views(run: Run) -> list[View]:
    """The training views of the size that is trained on."""
    return [view for view in run.scene.split("train") if view.downscale == run.downscale]


CHANCES = {"uniform": None, "laplacian": laplacian_probability}  # of a pixel to become a point of a sweep


class Init(Stage):
    """Make Gaussians: isotropic, as large as the mean distance to the three nearest neighbors (Kerbl et al. 2023).

    `source: auto` uses the scene's points if it has points.  Without points it uses a plane sweep over the photographs,
    or, where these have transparent pixels, what `transparent` says: random points in a box around the point
    that the cameras look at, as published, or points on the hull of the silhouettes in that box.  Where a scene has
    fewer points than `min_points`, and its photographs are opaque, those of a sweep join them.  `source: points+sweep`
    adds those of a sweep however many points the scene has, but where a pixel shows one of them or is transparent.
    """

    stage: Literal["init"] = "init"
    makes: ClassVar[frozenset[str]] = frozenset({"model", "painter"})
    takes: ClassVar[frozenset[str]] = frozenset({"adam", "stats", "average", "palette", "field", "metrics"})
    edits: ClassVar[bool] = True

    source: Literal["auto", "points", "points+sweep", "sweep", "hull", "random", "model"] = "auto"
    """Source of the first Gaussians."""
    transparent: Literal["random", "hull"] = "random"
    """Source of `auto` for a scene without points whose photographs are transparent."""
    min_points: Annotated[int, Field(ge=0)] = 0
    """Number of the scene's points below which `auto` adds those of a plane sweep."""
    opacity: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Opacity of the first Gaussians."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Factor of the first sizes."""
    count: Annotated[int, Field(gt=0)] = 100_000
    """Number of random points; largest number of points on a hull."""
    sweep_points: Annotated[int, Field(gt=0)] = 20_000
    """Largest number of points of a plane sweep."""
    detail: Literal["uniform", "laplacian"] = "uniform"
    """Which pixels of a sweep become points: all with the same chance, and sizes are those of neighbors; or where the
    photographs have detail, by their Laplacian, and sizes are the distances of such pixels."""
    times: Literal["uniform", "per_frame"] = "uniform"
    """Where Gaussians move, the time of each: drawn, or that at which its point was seen, where the dataset says so.
    Points whose neighbors were seen at all times begin as what stands still; others have the spread of those times as
    their duration, and the velocity of those neighbors."""
    duration: Annotated[float, Field(gt=0)] = 4.0
    """Standard deviation of the time around that, by the scene's duration; a long one begins as a scene that stands
    still."""
    min_duration: Annotated[float, Field(gt=0)] = 0.1
    """Shortest duration of the Gaussians whose points moved, with `times: per_frame`, by the scene's duration."""
    file: InputPath | None = None
    """Model file of any format, or a run folder, for `source: model`."""

    def check(self) -> None:
        if self.source == "model" and self.file is None:
            raise ConfigError(f"init.file: source '{self.source}' needs a model file, or the folder of a run; give one")

    def check_run(self, run: Run) -> None:
        require_times(run.scene, run.model_settings.time)
        source = self._source(run.scene)
        if source == "model":
            self._read()
        elif source in ("random", "hull"):
            self._require_memory(run, self.count)
        elif source in ("points", "points+sweep"):
            self._require_memory(run, len(own_points(run.scene)))

    def run(self, run: Run) -> None:
        degree = run.model_settings.sh_degree
        require_times(run.scene, run.model_settings.time)
        parameters, source = self._parameters(run, degree)
        gaussians = Gaussians(run.device, parameters)
        run.adam, run.stats, run.metrics = None, None, {}  # which were of an earlier model
        run.model = run.model_settings.model(gaussians, degree if self.source == "model" else 0)
        run.refresh_filter()
        start_sky(run, load(Path(self.file)) if source == "model" and self.file else None)
        LOG.info("%s Gaussians from %s", f"{run.model.gaussians.count:,}", self._origin(source, run.scene))

    def expected_count(self, scene: Scene) -> int:
        """Return the number of Gaussians that it makes of a scene, or the most where that is found on the way.

        Raises DataError where its model cannot be read.
        """
        source = self._source(scene)
        if source == "model":
            return len(self._read()["means"])
        if source in ("points", "points+sweep"):
            return (0 if scene.points is None else len(scene.points)) + self.sweep_points * self._is_joined(scene)
        return self.sweep_points if source == "sweep" else self.count

    def _is_joined(self, scene: Scene) -> bool:
        """Whether points of a sweep join those of the scene."""
        few = scene.points is not None and len(scene.points) < self.min_points
        return self.source == "points+sweep" or (self.source == "auto" and few and not is_transparent(scene))

    def _origin(self, source: str, scene: Scene) -> str:
        names = {
            "points": "the scene's points",
            "random": "random points",
            "sweep": "a sweep over the photographs",
            "hull": "the hull of the silhouettes",
            "points+sweep": "the scene's points and a sweep over the photographs",
        }
        has_own = scene.points is not None or source == "model"
        return names.get(source, source) + ("" if has_own else ": the scene has no points")

    def _source(self, scene: Scene) -> str:
        if self.source != "auto":
            return self.source
        if scene.points is not None:
            return "points"
        return self.transparent if is_transparent(scene) else "sweep"

    def _parameters(self, run: Run, degree: int) -> tuple[Parameters, str]:
        """The parameters and their source: random points too where photographs agree on too few."""
        source = self._source(run.scene)
        if source == "model":
            return with_motion(with_degree(self._read(), degree), run.model_settings.time, str(self.file)), source
        chance = CHANCES[self.detail]
        found: dict[str, Callable[[], PointCloud | None]] = {
            "sweep": lambda: enough_swept(run, self.sweep_points, chance),
            "hull": lambda: on_hull(run, self.count),
            "points": lambda: own_points(run.scene),
            "points+sweep": lambda: points_and_sweep(run, self.sweep_points, chance),
        }
        points = found[source]() if source in found else None
        if points is None:
            points, source = self._random(run), "random"
        if source == "points" and self._is_joined(run.scene):
            points, source = points.joined(swept(run, self.sweep_points, chance)), "points+sweep"
        self._require_memory(run, len(points))
        parameters = from_points(points, self.opacity, degree, self.scale)
        seen = points.times if self.times == "per_frame" else None
        return moving(parameters, run.model_settings.time, seen, (self.duration, self.min_duration), run.seed), source

    def _read(self) -> Parameters:
        assert self.file is not None  # as `check` requires
        parameters = load(Path(self.file)).tables()
        if not len(parameters["means"]):
            raise DataError(f"{self.file}: holds no Gaussians; expected one at least to start from")
        return parameters

    @staticmethod
    def _require_memory(run: Run, count: int) -> None:
        """Raise MemoryLimitError where so many Gaussians do not fit."""
        motion = run.model_settings.time
        tables = first_tables(run.model_settings.sh_degree, motion.width if motion else 0)
        run.memory_plan(tables, last_place(run.harmonics, run.device.info)).check(count, more_room(run))

    def _random(self, run: Run) -> PointCloud:
        """Random points, where so many Gaussians fit.  Raises MemoryLimitError before any is made."""
        self._require_memory(run, self.count)
        return random_points(run.scene, self.count, run.seed)
