"""Write files of a run: the model, its cameras, checkpoints."""

import logging
import time
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from clsplat.core.errors import DataError, OutputError, size_text
from clsplat.core.reading import sha256
from clsplat.formats.splats import Quality, ReadOptions, WriteOptions
from clsplat.formats.table import endings, writing_format
from clsplat.gaussians.conversion import COUNT, with_sky_splats
from clsplat.gaussians.model import load
from clsplat.gaussians.sky import sky_path, without_sky_path
from clsplat.scene.camera_files import check_cameras, write_cameras
from clsplat.training import checkpoint
from clsplat.training.modules.base import learned_scene
from clsplat.training.run import Run, host_model, sky_center
from clsplat.training.stage import CADENCE, Scheduled, Stage, path_in_run

# no folders
FILE_ENDINGS = tuple(end for end in endings() if end.startswith(".") and writing_format(Path(end)).is_model)
LOG = logging.getLogger("clsplat")


class Export(Scheduled):
    """Write the model to a file, in the format that the file name's extension selects, and read the file back.

    A world filter is baked into scales and opacities, so that any viewer can show the file.  A second PLY, with `_raw`
    in its name, contains the model as trained, with the filter as property `filter_3D`.  A learned sky is added
    to the model as distant Gaussians.  A file with `_without_sky` in its name contains the model without them, and
    clsplat renders that file with the map of the sky in the file with `_sky.json` in its name.
    """

    stage: Literal["export"] = "export"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    output_keys: ClassVar[frozenset[str]] = CADENCE | {"file", "quality", "sky"}

    file: Annotated[str, path_in_run(*FILE_ENDINGS)] = "point_cloud.ply"
    """Path inside the run folder; the extension selects the format: .ply, .spz, .sog, .glb, .splat, .usda."""
    quality: Quality = "balanced"
    """Precision of harmonics, colors, positions and rotations in SPZ and SOG."""
    sky: Literal["splats", "sidecar"] = "splats"
    """Form of a learned sky (`model.background`): `splats`, 10,000 Gaussians on a distant sphere, which every viewer
    shows; or `sidecar`, only a file next to the model, which no other viewer reads."""

    @model_validator(mode="after")
    def _check_quality(self) -> "Export":
        if not writing_format(Path(self.file)).is_model:
            raise ValueError(
                f"'{self.file}' would store only points, not a model; use a name that does not end in .points.ply"
            )
        if self.quality != "balanced" and not writing_format(Path(self.file)).has_quality:
            raise ValueError(
                f"'quality' applies to SPZ and SOG; expected a file that ends in .spz or .sog, got '{self.file}'"
            )
        return self

    def outputs(self, out: Path) -> list[Path]:
        path = out / self.file
        return [path, path.with_name(f"{path.stem}_raw.ply"), sky_path(path), without_sky_path(path)]

    def run(self, run: Run) -> None:
        model = host_model(run)
        path, raw_file, sky_file, without_sky_file = self.outputs(run.out)
        if _name(sky_file, run) not in run.model_hashes:
            sky_file.unlink(missing_ok=True)
        without_sky_file.unlink(missing_ok=True)
        run.model_hashes.pop(_name(without_sky_file, run), None)
        files = {path: model.baked()}
        if model.sky and self.sky == "splats":
            files = {path: with_sky_splats(model, center=sky_center(run)), without_sky_file: model.baked()}
        if model.filter_variance is not None:
            files[raw_file] = model
        options = WriteOptions(quality=self.quality)
        for file, exported_model in files.items():
            run.model_hashes[_name(file, run)] = exported_model.save(file, options)
            try:
                if writing_format(file).read:
                    load(file, ReadOptions(quiet=True))
            except DataError as error:
                raise OutputError(f"{error}; the file was just written: check the disk and its free space") from error
            LOG.debug("%s written to %s", size_text(len(model), None, len(exported_model) - len(model)), file)
        run.model_hashes.pop(_name(sky_file, run), None)
        if sky_file.is_file():
            run.model_hashes[_name(sky_file, run)] = sha256(sky_file)
        if without_sky_file in files:
            LOG.info(
                "%s contains the sky as %s distant Gaussians; %s does not", path, f"{COUNT:,}", without_sky_file.name
            )
        elif model.sky:
            LOG.info("sky written to %s, which only clsplat reads", sky_file)


def sky_gaussians(run: Run) -> int:
    """Return the number of Gaussians for the sky that exported files contain in addition to the model's Gaussians."""
    stages = run.pipeline["stages"]
    has_splats = any("export" in stage and stage["export"].get("sky") == "splats" for stage in stages)
    return COUNT if has_splats and run.gaussians is not None and run.model.sky else 0


def _name(file: Path, run: Run) -> str:
    return file.relative_to(run.out).as_posix()


class Cameras(Stage):
    """Write the cameras of the scene at full image size, so that other programs can show the model's views.

    After training with `camera_optimizer`, these are the optimized poses and focal lengths."""

    stage: Literal["cameras"] = "cameras"
    output_keys: ClassVar[frozenset[str]] = frozenset({"formats", "folder"})

    formats: Annotated[list[Literal["colmap", "nerfstudio", "inria"]], Field(min_length=1)] = Field(["inria"])
    """Formats to write: a binary COLMAP model, transforms.json, cameras.json."""
    folder: Annotated[str, path_in_run()] = "cameras"
    """Path inside the run folder."""

    def check_run(self, run: Run) -> None:
        for name in self.formats:
            check_cameras(run.original, name)

    def run(self, run: Run) -> None:
        for name in self.formats:
            for path in write_cameras(learned_scene(run), run.out / self.folder, name, overwrite=True):
                LOG.info("cameras written to %s", path)


class Checkpoint(Scheduled):
    """Save a state from which a resumed run gives the same bits.

    A checkpoint is also saved after the last step, so that a run can be extended.
    """

    stage: Literal["checkpoint"] = "checkpoint"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    runs_at_end: ClassVar[bool] = True
    output_keys: ClassVar[frozenset[str]] = CADENCE | {"keep", "every_seconds"}

    keep: Annotated[int, Field(gt=0)] = 2
    """Number of checkpoints to keep; older ones are removed."""

    every_seconds: Annotated[float, Field(gt=0)] | None = None
    """Age of the last checkpoint, in seconds, at which another one is saved, in addition to `every`; the bits of the
    model do not depend on it."""

    def is_overdue(self, run: Run) -> bool:
        return self.every_seconds is not None and time.monotonic() - run.status.saved_at >= self.every_seconds

    def run(self, run: Run) -> None:
        checkpoint.save(run, self.keep)
