"""The model as a video."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from clsplat.progress import counted, heard_by
from clsplat.scene.view import View
from clsplat.settings import ReadPath
from clsplat.stages.base import Stage, path_in_run
from clsplat.stages.timelapse import verify_video
from clsplat.training.run import Run
from clsplat.video import encoding
from clsplat.video.film import FPS, FRAMES, Film, Wish, plan, shoot
from clsplat.video.lenses import MAX_FRAMES, RATES, size_of
from clsplat.video.pictures import Canvas

LOG = logging.getLogger("clsplat")
Moment = Annotated[float, Field(ge=0, le=1)]


class Video(Stage):
    """Film the model along a camera path: about the scene (ellipse, orbit, spiral) or along the photographs."""

    stage: Literal["video"] = "video"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"path", "frames", "fps", "size", "times", "file"})

    path: ReadPath = "ellipse"
    """One of ellipse, spiral, orbit, through, views and fixed, fixed:NAME of a view, or a file camera_path.json."""
    frames: Annotated[int, Field(gt=0, le=MAX_FRAMES)] = FRAMES
    """Number of frames."""
    fps: Annotated[float, Field(ge=RATES[0], le=RATES[1])] = FPS
    """Frames a second."""
    size: str | None = None
    """WIDTHxHEIGHT, even numbers; without it, that of the photographs in training."""
    times: Moment | tuple[Moment, Moment] | None = None
    """Of a scene that moves: one moment, or those of the first and the last frame; without it, the whole."""
    file: Annotated[str, path_in_run(*encoding.WRITERS)] = "video.webm"
    """Path inside the run folder; .webm, or .mp4 with the extra video."""

    @field_validator("size")
    @classmethod
    def _of_a_video(cls, size: str | None) -> str | None:
        return None if size is None else size_of(size)

    def place_of(self, key: str, scene: str | None) -> Path | None:
        return None if key == "path" and not self._wish().of_a_file else super().place_of(key, scene)

    def _wish(self) -> Wish:
        return Wish.of(self.path, self.frames, self.fps, self.size, self.times)

    def _plan(self, run: Run) -> Film:
        moves = run.gaussians is not None and run.model.gaussians.moves
        return plan(self._wish(), run.scene.downscaled(run.downscale), _points(run), moves)

    def check(self) -> None:
        self._wish()
        encoding.check_encoder(Path(self.file))

    def run(self, run: Run) -> None:
        film, path = self._plan(run), run.out / self.file

        def through(views: Sequence[View]) -> Iterator[View]:
            return counted(run.until_interrupted(views), "frames rendered", len(views))

        canvas = Canvas(run.painter())
        with heard_by(run.status.count):
            shoot(canvas, film, {"colour": path}, None, through)
        LOG.info("video of %d frames written to %s, %.2f MB", len(film.views), path, path.stat().st_size / 1e6)

    def verify(self, run: Run) -> None:
        verify_video(run.out / self.file, len(self._plan(run).views))


def _points(run: Run) -> NDArray[np.float32]:
    """Where something is, [M, 3]: the means of the Gaussians; for a field the scene's points, if it has any."""
    if run.gaussians is not None:
        return run.model.gaussians.get("means")
    return run.scene.points.positions if run.scene.points else np.zeros((0, 3), np.float32)
