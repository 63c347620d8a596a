"""Render the model as a video, or its training as a time-lapse."""

import difflib
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from clsplat.core.errors import ConfigError, quote
from clsplat.core.progress import counted, listening
from clsplat.core.settings import InputPath
from clsplat.scene.images import read_image, read_image_size, write_image
from clsplat.scene.view import View
from clsplat.training.run import Run
from clsplat.training.stage import CADENCE, Scheduled, Stage, path_in_run
from clsplat.viewer.video import encoding
from clsplat.viewer.video.frames import Canvas, letterbox
from clsplat.viewer.video.paths import MAX_FRAMES, RATES, check_size, validate_size
from clsplat.viewer.video.plan import FPS, FRAMES, VideoPlan, VideoRequest, plan_video, render_video, resize_view

LOG = logging.getLogger("clsplat")
RECORD_KIND = "snapshot"  # of lines in metrics.jsonl
FOLDER = "timelapse"


class Snapshot(Scheduled):
    """Write a render of the model from one camera, for a later stage `timelapse`.

    The stage does not change the bits of the model.  A resumed run ends with the same images.
    """

    stage: Literal["snapshot"] = "snapshot"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    makes: ClassVar[frozenset[str]] = frozenset({"snapshots"})
    output_keys: ClassVar[frozenset[str]] = CADENCE | {"view", "size", "folder"}

    view: str | None = None
    """Name of the view to render; default: the first test view, or the first view if there is none."""
    size: str | None = None
    """WIDTHxHEIGHT of the renders, even numbers; default: the training size of the view."""
    folder: Annotated[str, path_in_run()] = FOLDER
    """Path inside the run folder."""

    @field_validator("size")
    @classmethod
    def _check_size(cls, size: str | None) -> str | None:
        return None if size is None else validate_size(size)

    def check_run(self, run: Run) -> None:
        self._view(run)

    def _view(self, run: Run) -> View:
        """Return the view to render.  Raises ConfigError if the scene does not have it."""
        scene = run.scene.downscaled(run.downscale)
        if self.view is None:
            return (scene.split("test") or scene.views)[0]
        by_name = {view.name: view for view in scene.views}
        if self.view not in by_name:
            matches = difflib.get_close_matches(self.view, by_name, n=1, cutoff=0.0)
            raise ConfigError(f"snapshot: the scene has no view {quote(self.view)}; did you mean {quote(matches[0])}?")
        return by_name[self.view]

    def run(self, run: Run) -> None:
        view = resize_view(self._view(run), check_size(self.size) if self.size else None)
        path = run.out / self.folder / f"step_{run.step:06d}.png"
        write_image(path, Canvas(run.painter()).render_image(view))
        run.records.add(run.step, RECORD_KIND, folder=self.folder, file=path.name)


class Timelapse(Stage):
    """Write a video of the renders that the stage `snapshot` wrote during training."""

    stage: Literal["timelapse"] = "timelapse"
    needs: ClassVar[frozenset[str]] = frozenset({"painter", "snapshots"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"folder", "file", "fps"})

    folder: str = FOLDER
    """The `folder` of the stage `snapshot`."""
    file: Annotated[str, path_in_run(*encoding.WRITERS)] = "timelapse.webm"
    """Path inside the run folder; .webm, or .mp4 with the extra video."""
    fps: Annotated[float, Field(ge=RATES[0], le=RATES[1])] = 15.0
    """Frames per second."""

    def check(self) -> None:
        encoding.check_encoder(Path(self.file))

    def _files(self, run: Run) -> list[Path]:
        """Return the paths of this run's renders, in step order; the folder may also contain those of earlier runs."""
        lines = run.records.read(RECORD_KIND)
        files = {line["step"]: line["file"] for line in lines if line.get("folder") == self.folder}
        return [run.out / self.folder / files[step] for step in sorted(files)]

    def run(self, run: Run) -> None:
        files = self._files(run)
        if not files:
            raise ConfigError(
                f"timelapse: {quote(self.folder)} has no snapshots; set 'folder' to the folder of the snapshot stage"
            )
        size = read_image_size(files[-1])
        with encoding.open_video(run.out / self.file, size, self.fps) as write:
            for path in run.status.counted(run.until_interrupted(files), "frames", len(files)):
                write(letterbox(np.asarray(read_image(path), np.uint8)[:, :, :3], size))  # one size for all
        LOG.info("time-lapse of %d frames written to %s", len(files), run.out / self.file)


Timestamp = Annotated[float, Field(ge=0, le=1)]


class Video(Stage):
    """Render a video along a camera path: around the scene (ellipse, orbit, spiral) or along the photos."""

    stage: Literal["video"] = "video"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"path", "frames", "fps", "size", "times", "file"})

    path: InputPath = "ellipse"
    """One of ellipse, spiral, orbit, through, views, fixed and fixed:VIEW, or a file camera_path.json."""
    frames: Annotated[int, Field(gt=0, le=MAX_FRAMES)] = FRAMES
    """Number of frames."""
    fps: Annotated[float, Field(ge=RATES[0], le=RATES[1])] = FPS
    """Frames per second."""
    size: str | None = None
    """WIDTHxHEIGHT, even numbers; default: the training size."""
    times: Timestamp | tuple[Timestamp, Timestamp] | None = None
    """In a dynamic scene, a timestamp, or the timestamps of the first and last frame; default: the full duration."""
    file: Annotated[str, path_in_run(*encoding.WRITERS)] = "video.webm"
    """Path inside the run folder; .webm, or .mp4 with the extra video."""

    @field_validator("size")
    @classmethod
    def _check_size(cls, size: str | None) -> str | None:
        return None if size is None else validate_size(size)

    def input_path(self, key: str, scene: str | None) -> Path | None:
        return None if key == "path" and not self._request().is_file else super().input_path(key, scene)

    def _request(self) -> VideoRequest:
        return VideoRequest.parse(self.path, self.frames, self.fps, self.size, self.times)

    def _plan(self, run: Run) -> VideoPlan:
        is_moving = run.gaussians is not None and run.model.gaussians.is_moving
        return plan_video(self._request(), run.scene.downscaled(run.downscale), _points(run), is_moving)

    def check(self) -> None:
        self._request()
        encoding.check_encoder(Path(self.file))

    def run(self, run: Run) -> None:
        plan, path = self._plan(run), run.out / self.file

        def with_progress(views: Sequence[View]) -> Iterator[View]:
            return counted(run.until_interrupted(views), "frames rendered", len(views))

        canvas = Canvas(run.painter())
        with listening(run.status.count):
            render_video(canvas, plan, {"color": path}, None, with_progress)
        LOG.info("video of %d frames written to %s, %.2f MB", len(plan.views), path, path.stat().st_size / 1e6)


def _points(run: Run) -> NDArray[np.float32]:
    """Return points of the scene, [M, 3]: the means of the Gaussians, or, for a field, the scene's points."""
    if run.gaussians is not None:
        return run.model.gaussians.get("means")
    return run.scene.points.positions if run.scene.points else np.zeros((0, 3), np.float32)
