"""Files of a run: the model, its cameras, checkpoints."""

import logging
import time
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from clsplat.core.errors import DataError, OutputError
from clsplat.core.reading import sha256
from clsplat.formats.splats import Quality, Reading, Writing
from clsplat.formats.table import endings, for_writing
from clsplat.gaussians.conversion import with_sky_splats
from clsplat.gaussians.model import load
from clsplat.gaussians.sky import sky_file
from clsplat.scene.camera_files import check_cameras, write_cameras
from clsplat.training import checkpoint
from clsplat.training.modules.base import learned_scene
from clsplat.training.run import Run, host_model
from clsplat.training.stage import CADENCE, Scheduled, Stage, path_in_run

WRITTEN = tuple(ending for ending in endings() if ending.startswith("."))  # a folder of SOG is no file
LOG = logging.getLogger("clsplat")


class Export(Scheduled):
    """Write the model in the format that the name of the file stands for, by default a PLY, and read it back.

    A world filter is applied to scales and opacities, so that any viewer can show the file.  A second file, a PLY with
    `_raw` in its name, holds the model as trained, with the filter as a property `filter_3D`.  A sky is beside them,
    with `_sky.json` in its name, which clsplat alone reads, or among the Gaussians.
    """

    stage: Literal["export"] = "export"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    output_keys: ClassVar[frozenset[str]] = CADENCE | {"file", "quality", "sky"}

    file: Annotated[str, path_in_run(*WRITTEN)] = "point_cloud.ply"
    """Path inside the run folder; its ending is the format: .ply, .spz, .sog, .glb, .splat, .usda."""
    quality: Quality = "balanced"
    """Of SPZ and SOG, how finely harmonics, colors, positions and rotations are rounded."""
    sky: Literal["sidecar", "splats"] = "sidecar"
    """A sky that was learned (`model.background`): a file beside the model, or 10 000 Gaussians on a far sphere, which
    every viewer shows."""

    @model_validator(mode="after")
    def _quality_of_its_format(self) -> "Export":
        if self.quality != "balanced" and not for_writing(Path(self.file)).has_quality:
            raise ValueError(
                f"'quality' is of SPZ and SOG; expected a file that ends in .spz or .sog, got '{self.file}'"
            )
        return self

    def outputs(self, out: Path) -> list[Path]:
        path = out / self.file
        return [path, path.with_name(f"{path.stem}_raw.ply"), sky_file(path)]

    def run(self, run: Run) -> None:
        model = host_model(run)
        if self.sky == "splats":
            if model.sky is None:
                LOG.warning("export.sky: splats changes nothing: the model has no sky; model.background gives it one")
            model = with_sky_splats(model)
        path, raw, behind = self.outputs(run.out)
        if _name(behind, run) not in run.model_hashes:
            behind.unlink(missing_ok=True)
        files = {path: model.baked()}
        if model.filter_variance is not None:
            files[raw] = model
        options = Writing(quality=self.quality)
        for file, one in files.items():
            run.model_hashes[_name(file, run)] = one.save(file, options)
            try:
                if for_writing(file).read:
                    load(file, Reading(quiet=True))
            except DataError as error:
                raise OutputError(f"{error}; it was written just now: check the disk and its space") from error
            LOG.info("%s Gaussians written to %s", f"{len(one):,}", file)
        run.model_hashes.pop(_name(behind, run), None)
        if behind.is_file():
            run.model_hashes[_name(behind, run)] = sha256(behind)
        if model.sky:
            LOG.info("their sky written to %s; `export: {sky: splats}` makes Gaussians of it", behind)


def _name(file: Path, run: Run) -> str:
    return file.relative_to(run.out).as_posix()


# The cameras beside the model, for other programs.


class Cameras(Stage):
    """Write the cameras of the scene, at the photographs' full size, so that a model travels with its views.

    After a training with `camera_optimizer` they are the learned ones, with the learned focal lengths."""

    stage: Literal["cameras"] = "cameras"
    output_keys: ClassVar[frozenset[str]] = frozenset({"formats", "folder"})

    formats: Annotated[list[Literal["colmap", "nerfstudio", "inria"]], Field(min_length=1)] = Field(["inria"])
    """Files that are written: a COLMAP model as text, transforms.json, cameras.json."""
    folder: Annotated[str, path_in_run()] = "cameras"
    """Path inside the run folder."""

    def check_run(self, run: Run) -> None:
        for name in self.formats:
            check_cameras(run.original, name)

    def run(self, run: Run) -> None:
        for name in self.formats:
            for path in write_cameras(learned_scene(run), run.out / self.folder, name, over=True):
                LOG.info("cameras written to %s", path)


# Save the run at a cadence.


class Checkpoint(Scheduled):
    """Write everything that a resumed run needs to reach the same bits; also after the last step, to train longer."""

    stage: Literal["checkpoint"] = "checkpoint"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    ends: ClassVar[bool] = True
    output_keys: ClassVar[frozenset[str]] = CADENCE | {"keep", "every_seconds"}

    keep: Annotated[int, Field(gt=0)] = 2
    """Number of checkpoints that are kept, the newest ones."""

    every_seconds: Annotated[float, Field(gt=0)] | None = None
    """Seconds without a checkpoint after which one is saved between those of `every`; the bits do not depend on it."""

    def is_overdue(self, run: Run) -> bool:
        return self.every_seconds is not None and time.monotonic() - run.status.saved_at >= self.every_seconds

    def run(self, run: Run) -> None:
        checkpoint.save(run, self.keep)
