"""The steps of `prepare:` in pipeline files.  Each step makes an output folder from an input folder, on the host."""

from abc import abstractmethod
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from clsplat.core.errors import DataError, pluralize
from clsplat.core.settings import Settings
from clsplat.prepare.database import require_pycolmap
from clsplat.prepare.features import CameraModel, FeatureOptions, find_features
from clsplat.prepare.gather import require_photographs, summarize_placement, warnings_for
from clsplat.prepare.mapping import MAX_ATTEMPTS, Mapper, map_cameras
from clsplat.prepare.matching import Matching, match_features, max_pair_count
from clsplat.prepare.shared_intrinsics import Cameras
from clsplat.prepare.undistort import UndefinedPixels, undistort_scene
from clsplat.scene.detect import is_scene

Positive = Annotated[int, Field(gt=0)]


class Step(Settings):
    """A step that makes an output folder from an input folder.

    Its inputs, settings and `version` identify the result.
    """

    version: ClassVar[int] = 1  # increase it when the result changes
    resumes: ClassVar[bool] = False  # whether `make` continues from the files that an interrupted call left in `out`
    seconds: ClassVar[tuple[float, float] | None] = None  # shortest and longest time per item, to estimate run times

    stage: str
    """Name of the step."""

    def check(self, source: Path, excluded_folder: Path) -> None:
        """Raise the errors of `make` that can be detected before running it, without writing anything.

        Only the first step is checked, before any step runs.
        """

    def is_done_in(self, source: Path) -> bool:
        """Return whether `source`, such as a scene with cameras, needs neither this step nor any later step."""
        return False

    def count_items(self, photographs: int) -> tuple[int, str]:
        """Return the number of items that the step processes for a number of photographs, and their plural name."""
        return photographs, "photos"

    @abstractmethod
    def make(self, source: Path, out: Path, excluded_folder: Path) -> dict[str, Any]:
        """Write the result for `source` into the folder `out`, and return statistics for the log.

        `out` is empty.  If the step `resumes`, it may contain the files of an interrupted call with the same inputs.
        Files in `excluded_folder` are not read.
        """

    def summary(self, statistics: dict[str, Any]) -> str:
        """Return a log line that summarizes the statistics returned by `make`."""
        return ", ".join([f"{self.stage} finished", *(f"{value} {name}" for name, value in statistics.items())])

    def warnings(self, statistics: dict[str, Any]) -> list[str]:
        """Return the warnings for the statistics of `make`.  They are repeated when its result is reused."""
        return []


class FindFeatures(Step):
    """Find SIFT features of photographs."""

    version: ClassVar[int] = 2  # by OpenCV; photographs without EXIF data share a camera
    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.2, 3.0

    stage: Literal["find_features"] = "find_features"

    long_side: Positive = 1600
    """Longer side in px of the images in which features are detected; larger photos are downscaled."""
    features: Positive = 12288
    """Maximum number of features per photo."""
    camera_model: CameraModel = "SIMPLE_RADIAL"
    """COLMAP camera model; OPENCV_FISHEYE for fisheye lenses, EQUIRECTANGULAR for panoramas."""
    cameras: Cameras = "auto"
    """Photos of the same size that share a camera; auto: those with the same lens, or no lens, in EXIF."""

    def is_done_in(self, source: Path) -> bool:
        return is_scene(source)

    def check(self, source: Path, excluded_folder: Path) -> None:
        if is_scene(source):
            raise DataError(f"{source}: already contains cameras; use a folder that contains only photos")
        require_photographs(source, excluded_folder.resolve())
        require_pycolmap()

    def make(self, source: Path, out: Path, excluded_folder: Path) -> dict[str, Any]:
        self.check(source, excluded_folder)
        options = FeatureOptions(self.long_side, self.features)
        return find_features(source, out, options, self.camera_model, self.cameras, excluded_folder.resolve())

    def summary(self, statistics: dict[str, Any]) -> str:
        photographs = pluralize(statistics["photographs"], "photo")
        return f"features found in {photographs} from {pluralize(statistics['cameras'], 'camera')}"

    def warnings(self, statistics: dict[str, Any]) -> list[str]:
        return warnings_for(statistics)


class MatchFeatures(Step):
    """Match features between pairs of photographs."""

    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.05, 1.0  # per pair

    stage: Literal["match_features"] = "match_features"

    matching: Matching = "auto"
    """Pairs of photos to match; auto: exhaustive, or vocabulary for more than 200 photos."""
    neighbors: Positive = 10
    """Number of photos with which each photo is matched: the next ones by name, or twice as many similar ones
    (vocabulary).  Not used by exhaustive matching."""
    threads: Positive = 1
    """Number of threads; more than one is faster, but results are not always bit-identical."""

    def count_items(self, photographs: int) -> tuple[int, str]:
        return max_pair_count(photographs, self.matching, self.neighbors), "pairs"

    def make(self, source: Path, out: Path, excluded_folder: Path) -> dict[str, Any]:
        return match_features(source, out, self.matching, self.neighbors, self.threads)

    def summary(self, statistics: dict[str, Any]) -> str:
        return f"{pluralize(statistics['pairs'], 'pair')} of photos match"


class MapCameras(Step):
    """Find cameras and points from matches.

    If photographs cannot be registered, the step tries again, in this order: with looser settings, with more pairs
    (unless `match_features` matched all of them), and with more features.
    """

    version: ClassVar[int] = 4  # enlarges small photos if denser features are not enough
    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.1, 4.0  # more for further attempts

    stage: Literal["map_cameras"] = "map_cameras"

    mapper: Mapper = "incremental"
    """COLMAP mapper of the first attempt: one camera after another (incremental) or all at once (global)."""
    threads: Positive = 1
    """Number of threads; more than one is faster, but results are not bit-identical."""
    attempts: Annotated[int, Field(ge=1, le=MAX_ATTEMPTS)] = MAX_ATTEMPTS
    """Maximum number of attempts.  The second accepts smaller angles and fewer matches; the third matches more pairs of
    the unregistered photos, unless all pairs were matched; the others find more features."""
    min_track_length: Literal[2, 3] = 3
    """Minimum number of photos in which a point must be visible.  COLMAP drops points visible in only two; keeping
    them gave 2.5 times as many points on one scene."""

    def make(self, source: Path, out: Path, excluded_folder: Path) -> dict[str, Any]:
        return map_cameras(source, out, self.mapper, self.threads, self.attempts, self.min_track_length)

    def summary(self, statistics: dict[str, Any]) -> str:
        return summarize_placement({self.stage: statistics})

    def warnings(self, statistics: dict[str, Any]) -> list[str]:
        return warnings_for(statistics)


class Undistort(Step):
    """Undistort photographs to pinhole images at the training size."""

    version: ClassVar[int] = 3  # keeps point tracks, reprojection residuals and exposures
    resumes: ClassVar[bool] = True
    seconds: ClassVar[tuple[float, float]] = 0.05, 1.0

    stage: Literal["undistort"] = "undistort"

    long_side: Positive | None = None
    """Longer side of the undistorted images in px; default: that of the photos."""
    undefined_pixels: UndefinedPixels = "crop"
    """How to treat pixels that the photo does not cover: `crop` them, or keep the entire image and `mask` them."""

    def make(self, source: Path, out: Path, excluded_folder: Path) -> dict[str, Any]:
        return {"images": undistort_scene(source, out, self.long_side, self.undefined_pixels)}

    def summary(self, statistics: dict[str, Any]) -> str:
        return f"photos undistorted to {pluralize(statistics['images'], 'pinhole image')}"
