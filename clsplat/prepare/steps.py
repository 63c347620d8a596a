"""The steps of `prepare:` in pipeline files.  Each makes a folder from a folder, on the host."""

from abc import abstractmethod
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from clsplat.core.errors import DataError
from clsplat.core.settings import Settings
from clsplat.prepare.database import require_pycolmap
from clsplat.prepare.features import CameraModel, FeatureOptions, find_features
from clsplat.prepare.gather import require_photographs, summarize_placement, warnings_for
from clsplat.prepare.mapping import MAX_ATTEMPTS, Mapper, map_cameras
from clsplat.prepare.matching import Matching, match_features, most_pairs
from clsplat.prepare.shared_intrinsics import Cameras
from clsplat.prepare.undistort import UndefinedPixels, undistort_scene
from clsplat.scene.detect import is_scene

Positive = Annotated[int, Field(gt=0)]


class Step(Settings):
    """A step from a folder to a folder.  Inputs, settings and `version` identify its result."""

    version: ClassVar[int] = 1  # increase it when the result changes
    resumes: ClassVar[bool] = False  # whether `make` goes on with what an interrupted call left in `out`
    seconds: ClassVar[tuple[float, float] | None] = None  # of a piece of its work, at least and at most: a guess

    stage: str
    """Name of the step."""

    def check(self, source: Path, without: Path) -> None:
        """Raise what `make` would raise, where that can be known at once: of the first step, before anything is made.

        Nothing is written.
        """

    def is_done_in(self, source: Path) -> bool:
        """Return whether `source` needs neither this step nor those after it: such as a scene that holds cameras."""
        return False

    def pieces(self, photographs: int) -> tuple[int, str]:
        """Return the number of pieces of its work on so many photographs, and their name."""
        return photographs, "photographs"

    @abstractmethod
    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        """Fill the folder `out` from `source`, without reading below `without`; return figures for the log.

        `out` is empty, or of a step that `resumes` holds what an interrupted call of the same inputs and settings made.
        """

    def told(self, figures: dict[str, Any]) -> str:
        """Return what `make` returned in words."""
        return ", ".join(f"{name} {value}" for name, value in figures.items() if value not in ([], {}, ""))

    def warnings(self, figures: dict[str, Any]) -> list[str]:
        """Return what `make` has warned of when it returned these figures, for calls that find its result."""
        return []


class FindFeatures(Step):
    """Find SIFT features of photographs."""

    version: ClassVar[int] = 2  # by OpenCV; photographs without EXIF data share a camera
    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.2, 3.0

    stage: Literal["find_features"] = "find_features"

    long_side: Positive = 1600
    """Longer side in px of the images in which features are found; larger photographs are made smaller."""
    features: Positive = 12288
    """Largest number of features of a photograph."""
    camera_model: CameraModel = "SIMPLE_RADIAL"
    """Camera model of COLMAP; OPENCV_FISHEYE for fisheye lenses."""
    cameras: Cameras = "auto"
    """Which photographs of one size share a camera; auto: those of which EXIF tells the same lens, or nothing."""

    def is_done_in(self, source: Path) -> bool:
        return is_scene(source)

    def check(self, source: Path, without: Path) -> None:
        if is_scene(source):
            raise DataError(f"{source}: holds cameras already; give the folder of the photographs alone")
        require_photographs(source, without.resolve())
        require_pycolmap()

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        self.check(source, without)
        sought = FeatureOptions(self.long_side, self.features)
        return find_features(source, out, sought, self.camera_model, self.cameras, without.resolve())

    def told(self, figures: dict[str, Any]) -> str:
        return super().told({**figures, "damaged": ", ".join(figures.get("damaged", ()))})

    def warnings(self, figures: dict[str, Any]) -> list[str]:
        return warnings_for(figures)


class MatchFeatures(Step):
    """Match features between pairs of photographs."""

    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.05, 1.0  # of a pair

    stage: Literal["match_features"] = "match_features"

    matching: Matching = "auto"
    """Which pairs of photographs are matched; auto: exhaustive, and vocabulary for more than 200 photographs."""
    neighbors: Positive = 10
    """Number of photographs that each is matched with, where not with all."""
    threads: Positive = 1
    """Number of threads; more than one are faster, and the result does not always repeat to the bit."""

    def pieces(self, photographs: int) -> tuple[int, str]:
        return most_pairs(photographs, self.matching, self.neighbors), "pairs"

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        return match_features(source, out, self.matching, self.neighbors, self.threads)


class MapCameras(Step):
    """Find cameras and points from matches; where photographs are left out, again with other settings, and matched with
    more others where `match_features` has not matched all pairs."""

    version: ClassVar[int] = 2  # more pairs of photographs that are left out
    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.1, 4.0  # further attempts take more

    stage: Literal["map_cameras"] = "map_cameras"

    mapper: Mapper = "incremental"
    """How cameras are found first: one after the other, or all at once (global)."""
    threads: Positive = 1
    """Number of threads; more than one are faster, and the result does not repeat to the bit."""
    attempts: Annotated[int, Field(ge=1, le=MAX_ATTEMPTS)] = MAX_ATTEMPTS
    """Largest number of attempts that are made; 1: none but the first.  The next takes smaller angles and fewer
    matches; one more pairs of photographs that are left out, where not all were matched; two find denser features, and
    match as before."""
    min_track_length: Literal[2, 3] = 3
    """Number of photographs that must show a point; COLMAP leaves out those of two.  On one scene
    there are 2.5 times as many points with them."""

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        return map_cameras(source, out, self.mapper, self.threads, self.attempts, self.min_track_length)

    def told(self, figures: dict[str, Any]) -> str:
        return summarize_placement({self.stage: figures})

    def warnings(self, figures: dict[str, Any]) -> list[str]:
        return warnings_for(figures)


class Undistort(Step):
    """Undistort photographs, as of a pinhole camera, at the training size."""

    version: ClassVar[int] = 3  # the tracks of points, how far these are from their places, and the exposures
    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.05, 1.0

    stage: Literal["undistort"] = "undistort"

    long_side: Positive | None = None
    """Longer side of the new images in px; without it, that of the photographs."""
    undefined_pixels: UndefinedPixels = "crop"
    """Pixels that no photograph shows; crop: cut them off; mask: keep the whole photograph and mask them."""

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        return {"images": undistort_scene(source, out, self.long_side, self.undefined_pixels)}
