"""Represent a dataset on the host: cameras, views, points, and the split into training and test views.

Conventions of the project
    camera      OpenCV: x right, y down, z forward; `world_to_camera` is row-major [3, 4]
    pixels      pixel (0, 0) has its center at (0.5, 0.5)
    quaternions (w, x, y, z)
    lengths     scene units; screen quantities in pixels
    colors      as stored in image files, in [0, 1]
"""

import logging
import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote
from clsplat.scene.view import BLACK, WHITE, Alpha, Floats, View, load_image, photograph_name

LOG = logging.getLogger("clsplat")


@dataclass(frozen=True)
class Tracks:
    """Structure-from-motion points, and the photographs that show them."""

    positions: NDArray[np.floating]  # [M, 3], scene units
    rows: Mapping[str, NDArray[np.int64]]  # rows of `positions` by view name, in order of the point ids
    residuals: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    # by view name, [K, 2] px of the original photograph: vectors from the projection of each point to its observation

    def shifted(self, origin: Floats) -> "Tracks":
        """Return the tracks in coordinates relative to `origin`, [3]."""
        return replace(self, positions=self.positions - origin) if origin.any() else self

    def split_by_face(self, views: Iterable["View"]) -> "Tracks":
        """Return the tracks in which each face of a wide photograph observes the points that project into it."""
        by_view = dict(self.rows)
        for view in views:
            if view.lens is not None and view.lens.face and photograph_name(view.name) in self.rows:
                rows, camera = self.rows[photograph_name(view.name)], view.camera
                x, y, z = view.world_to_camera @ np.vstack([self.positions[rows].T, np.ones(len(rows))])
                with np.errstate(all="ignore"):
                    x, y = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
                    by_view[view.name] = rows[(z > 0) & (x > 0) & (y > 0) & (x < camera.width) & (y < camera.height)]
        names = {view.name for view in views}
        return replace(self, rows={name: rows for name, rows in by_view.items() if name in names or name in self.rows})

    def renamed(self, names: Mapping[str, str]) -> "Tracks":
        """Return the tracks of the views in `names`, which maps old names to new ones."""
        rows = {names[old]: rows for old, rows in self.rows.items() if old in names}
        return Tracks(self.positions, rows, {names[old]: rows for old, rows in self.residuals.items() if old in names})


Background = Literal["black", "white"]
HOLDOUT = 8  # every 8th view is a test view if the dataset has no split: the default of pipelines
MAX_DISTANCE = 10.0  # times the median distance; cameras reach 2 on a line, 1 on an orbit, and about 4 in a close-up
MAX_OFFSET = 100  # times the median distance of the points; float32 then resolves 1e-5 of that distance
MAX_OUTLIERS = 0.2  # largest fraction of cameras that are outliers
ROUNDING = 1e-6  # times the largest coordinate; centers that differ by less count as equal
MAX_THUMBNAILS = 4
IN_MEMORY = Path("<memory>")  # path of a scene without a dataset
SPLITS = ("train", "test", "validation")


@dataclass(frozen=True)
class PointCloud:
    """Sparse colored points."""

    positions: Floats  # [M, 3] float32, scene units; world coordinates until make_scene subtracts the origin
    colors: Floats  # [M, 3] float32, in [0, 1]
    times: Floats | None = None  # [M] float32, timestamps in [0, 1]; None for a static scene

    def __len__(self) -> int:
        return len(self.positions)

    def joined(self, other: "PointCloud") -> "PointCloud":
        """Return the points of this cloud and of another cloud, in this order, with times if both have them."""
        pairs = [(self.positions, other.positions), (self.colors, other.colors)]
        pairs += [(self.times, other.times)] if self.times is not None and other.times is not None else []
        return PointCloud(*(np.concatenate(pair).astype(np.float32) for pair in pairs))


@dataclass(frozen=True)
class Scene:
    """Photographs with their cameras, points, and the split that all stages use."""

    path: Path
    views: tuple[View, ...]
    train: tuple[int, ...]  # indices into `views`
    test: tuple[int, ...]
    points: PointCloud | None
    extent: float  # radius of the training cameras, scene units
    background: Background = "black"  # color behind transparent pixels, as in papers on this dataset
    validation: tuple[int, ...] = ()  # held out to choose the best model
    tracks: Tracks | None = None  # which photographs show which points, if the dataset contains that
    origin: Floats = field(default_factory=lambda: np.zeros(3))  # [3] float64, world coordinates of zero in the scene
    skipped: tuple[str, ...] = ()  # names of views whose photographs are missing

    @classmethod
    def from_views(
        cls,
        views: Sequence[View],
        points: PointCloud | None = None,
        test: Collection[str] = (),
        background: Background = "black",
    ) -> "Scene":
        """Return a scene of views in memory.

        test: the names of the test views.  Raises DataError like make_scene, and for an unknown name.
        """
        if unknown_names := set(test) - {view.name for view in views}:
            raise DataError(f"test: no view is named {quote(min(unknown_names))}; expected names of views")
        test_indices = {i for i, view in enumerate(views) if view.name in test}
        return make_scene(IN_MEMORY, list(views), test_indices, points, background)

    def split(self, name: str) -> tuple[View, ...]:
        """Return the views of `train`, `test`, `validation` or `all`.  Raises ValueError for any other name."""
        if name == "all":
            return self.views
        if name not in SPLITS:
            raise ValueError(f"no split '{name}'; expected {', '.join(SPLITS)} or all")
        return tuple(self.views[i] for i in self.indices[name])

    @property
    def indices(self) -> dict[str, tuple[int, ...]]:
        """The indices of the views of each split."""
        return {"train": self.train, "test": self.test, "validation": self.validation}

    def in_world(self) -> "Scene":
        """Return the scene in the world coordinates of camera files, with float64 points and origin 0."""
        if not self.origin.any():
            return self
        views = tuple(view.shifted(-self.origin) for view in self.views)
        points = self.points and replace(self.points, positions=self.points.positions + self.origin)
        tracks = self.tracks and self.tracks.shifted(-self.origin)
        return replace(self, views=views, points=points, tracks=tracks, origin=np.zeros(3))

    def merge_validation(self) -> "Scene":
        """Return the scene with the validation views moved to the training views."""
        return replace(self, train=tuple(sorted(self.train + self.validation)), validation=())

    def renamed(self, names: Sequence[str]) -> "Scene":
        """Return the scene with renamed views.  names: the new name of each view, in the order of the views."""
        views = tuple(replace(view, name=name) for view, name in zip(self.views, names, strict=True))
        new_names = {view.name: name for view, name in zip(self.views, names, strict=True)}
        return replace(self, views=views, tracks=self.tracks and self.tracks.renamed(new_names))

    def with_alpha(self, alpha: Alpha) -> "Scene":
        """Return the scene with the fourth channel of its photographs interpreted as transparency or as a mask."""
        return replace(self, views=tuple(replace(view, alpha=alpha) for view in self.views))

    @property
    def downscales(self) -> tuple[float, ...]:
        """The downscale factors of the photographs in the scene, ascending."""
        return tuple(sorted({view.downscale for view in self.views}))

    def downscaled(self, *downscales: float) -> "Scene":
        """Return the scene with every photograph at 1 / downscale of its original size, for each of `downscales`.

        Views of that size in the dataset are used as they are; for other sizes, the largest views are resampled.
        Raises DataError for a size larger than the largest in the dataset.
        """
        if downscales == self.downscales:
            return self
        views: list[View] = []
        splits: dict[str, list[int]] = {name: [] for name in SPLITS}
        min_downscale = min(self.downscales)
        for downscale in downscales:
            if downscale < min_downscale:
                raise DataError(
                    f"{self.path}: the largest images are already downscaled by {min_downscale:g}; "
                    f"expected a downscale of at least {min_downscale:g}, got {downscale:g}"
                )
            source = downscale if downscale in self.downscales else min_downscale
            for name, indices in splits.items():
                sources = [view for view in self.split(name) if view.downscale == source]
                indices += range(len(views), len(views) + len(sources))
                views += [view.resized(downscale) for view in sources]
        train, test, validation = (tuple(splits[name]) for name in SPLITS)
        return replace(self, views=tuple(views), train=train, test=test, validation=validation)

    @property
    def image_sizes(self) -> str:
        """The three most frequent image sizes in pixels, as text such as `800x600 and 600x800`."""
        sizes = Counter(f"{view.camera.width}x{view.camera.height}" for view in self.views)
        *first_sizes, last = [size for size, _ in sizes.most_common(3)] + (["others"] if len(sizes) > 3 else [])
        return f"{', '.join(first_sizes)} and {last}" if first_sizes else last

    @property
    def cameras(self) -> dict[str, str]:
        """The camera name of each view, by view name: the name of the first view with an equal lens or camera."""
        first_names: dict[object, str] = {}
        return {view.name: first_names.setdefault(view.lens or view.camera, view.name) for view in self.views}

    def __repr__(self) -> str:
        fold = f", {len(self.validation)} for validation" if self.validation else ""
        return f"Scene({self.path.name}: {len(self.train)} training and {len(self.test)} test views{fold})"

    def _repr_html_(self) -> str:
        from clsplat.core.page import render_summary

        count = len(self.points) if self.points else 0
        rows = {
            "scene": str(self.path),
            "views": f"{len(self.train)} for training, {len(self.test)} for testing",
            "photos": f"{self.image_sizes} px",
            "points": f"{count:,}" if count else "none",
            "extent": f"{self.extent:.3g} scene units",
        }
        return render_summary(rows, list(self._thumbnails()))

    def _thumbnails(self) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        """Yield the names and pixels of a few evenly spaced photographs, except for unreadable ones."""
        for i in np.unique(np.linspace(0, len(self.views) - 1, MAX_THUMBNAILS).astype(int)):
            with suppress(DataError):
                yield self.views[i].name, load_image(self.views[i])


def make_scene(
    path: Path, views: list[View], test: set[int], points: PointCloud | None, background: Background = "black"
) -> Scene:
    """Return a scene of `views`, with its extent and its origin, which is subtracted from all positions.

    test: the indices of the test views; the others are training views.  Each wide photograph becomes several views,
    one for each face, in the same split.  Raises DataError when there are no views, when two views have the same name,
    or when a camera is invalid.
    """
    if not views:
        raise DataError(f"{path}: the dataset has no images; expected at least one image with a pose")
    faces = [view.faces() for view in views]
    counts = np.cumsum([0, *map(len, faces)]).tolist()
    views, test = list(chain.from_iterable(faces)), {i for n in test for i in range(counts[n], counts[n + 1])}
    names: set[str] = set()
    for view in views:
        if view.name in names:
            raise DataError(f"{path}: two images are named {quote(view.name)}; rename one")
        names.add(view.name)
        try:
            view.camera.check()
        except ValueError as error:
            raise DataError(f"{path}: {quote(view.name)}: {error}; remove that image or fix its camera") from error
    train = remaining_views(path, len(views), test)
    points = points if points and len(points) else None
    origin = choose_origin(views, points)
    if origin.any():
        LOG.info("%s: coordinates are far from zero; the run uses %s as the origin", path, format_position(origin))
        views = [view.shifted(origin) for view in views]
        points = points and replace(points, positions=points.positions - origin)
    color = WHITE if background == "white" else BLACK
    views = [replace(view, camera_to_world=None, background=color) for view in views]
    points = points and replace(points, positions=np.asarray(points.positions, np.float32))
    extent = camera_extent([views[i] for i in train], None if points is None else points.positions)
    return Scene(path, tuple(views), train, tuple(sorted(test)), points, extent, background, origin=origin)


def remaining_views(path: Path, count: int, test: set[int]) -> tuple[int, ...]:
    """Return the indices below `count` that are not in `test`.  Raises DataError when no index is left."""
    if train := tuple(i for i in range(count) if i not in test):
        return train
    remedy = "raise scene.holdout or add images" if count > 1 else "set scene.holdout=0 to train on it"
    raise DataError(f"{path}: {'every' if count > 1 else 'the only'} image is held out for testing; {remedy}")


def choose_origin(views: Sequence[View], points: PointCloud | None) -> Floats:
    """Return the origin of a scene in world coordinates, [3] float64: 0 unless the scene is far from 0.

    Positions on the device are float32, in which map coordinates have a precision of only half a meter.  The origin is
    a multiple of a power of ten, so that subtracting it from the decimal numbers of a file stays exact if possible.
    """
    centers = np.stack([view.position for view in views])
    positions = centers if points is None else np.asarray(points.positions, np.float64)
    return choose_origin_near(np.median(centers, axis=0), positions)


def choose_origin_near(center: Floats, positions: Floats) -> Floats:
    """Return an origin near `center`, [3]; 0 unless `center` is far from 0 relative to the spread of the positions."""
    spread = float(np.median(np.linalg.norm(positions - center, axis=1)))
    if np.abs(center).max() <= MAX_OFFSET * (spread or 1.0):
        return np.zeros(3)
    step = 10.0 ** math.ceil(math.log10(10 * (spread or 1.0)))
    return np.round(center / step) * step + 0.0  # no -0.0


def format_position(position: Floats) -> str:
    """Format a position, [3], with all its digits."""
    return f"({', '.join(f'{value:.15g}' for value in position)})"


def camera_extent(views: Sequence[View], points: NDArray[np.floating] | None = None) -> float:
    """Return the radius of the cameras: 1.1 times the largest distance of a camera from their mean (Kerbl et al. 2023).

    Outliers are ignored, since one wrong pose would change all sizes and learning rates of the scene.  If all cameras
    have the same center, the result is the median distance of the points from it or, without points, the depth of the
    origin in the first view.
    """
    centers = np.stack([v.position for v in views])[~outlier_cameras(views)]
    center = centers.mean(axis=0)
    if not have_same_center(centers):
        return 1.1 * float(np.linalg.norm(centers - center, axis=1).max())
    cloud = np.zeros((0, 3)) if points is None else points.astype(np.float64)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    distances = np.linalg.norm(cloud - center, axis=1) if len(cloud) else np.abs([views[0].world_to_camera[2, 3]])
    return float(np.median(distances)) or 1.0


def have_same_center(centers: Floats) -> bool:
    """Return whether camera centers, [V, 3], are equal up to rounding."""
    return bool(np.ptp(centers, axis=0).max() <= ROUNDING * np.abs(centers).max())


def outlier_cameras(views: Sequence[View]) -> NDArray[np.bool_]:
    """Return a mask, [N], of the cameras farther than MAX_DISTANCE times the median distance from the median center.

    If their fraction exceeds MAX_OUTLIERS, they are assumed to be a separate group, and the mask is all False.
    """
    centers = np.stack([v.position for v in views])
    distance = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    is_far = distance > MAX_DISTANCE * np.median(distance)
    return is_far if np.median(distance) > 0 and is_far.mean() <= MAX_OUTLIERS else np.zeros(len(views), bool)


def every_nth(names: Sequence[str], holdout: int, offset: int = 0) -> set[int]:
    """Return the indices of every `holdout`-th name in sorted order, starting at `offset`; none if `holdout` is 0.

    The faces of a wide photograph count as one name.
    """
    if holdout <= 0:
        return set()
    photographs = [photograph_name(name) for name in names]
    test_photographs = set(sorted(set(photographs))[offset::holdout])
    return {i for i, photograph in enumerate(photographs) if photograph in test_photographs}


def scene_name(folder: str | Path) -> str:
    """Return the name of a scene for pages, which is the name of its folder."""
    return Path(folder).resolve().name
