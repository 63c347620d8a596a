"""The model as a file."""

import logging
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from clsplat.core.errors import DataError, OutputError, amount
from clsplat.core.page import require_end
from clsplat.core.reading import sha256
from clsplat.formats.splats import Quality, Reading, Writing
from clsplat.formats.table import endings, for_writing
from clsplat.gaussians.conversion import with_sky_splats
from clsplat.gaussians.model import load
from clsplat.gaussians.sky import sky_file
from clsplat.metrics.views import render_view
from clsplat.render.camera import upload_camera
from clsplat.scene.camera_files import PLACES, checked, write_cameras
from clsplat.scene.images import image_size, is_image, write_image
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Stand
from clsplat.training import checkpoint
from clsplat.training.modules.base import learned_scene
from clsplat.training.run import Run, host_model
from clsplat.training.stage import CADENCE, Scheduled, Stage, path_in_run
from clsplat.viewer.packing import pack
from clsplat.viewer.page import BUDGET, MAX_SIZE, Page, Which, described

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
    """Path inside the run folder; its ending is the format: .ply, .compressed.ply, .spz, .sog, .glb, .splat, .usda."""
    quality: Quality = "balanced"
    """Of SPZ and SOG, how finely harmonics, colours, positions and rotations are rounded."""
    sky: Literal["beside", "splats"] = "beside"
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
        if _name(behind, run) not in run.written:
            behind.unlink(missing_ok=True)
        files = {path: model.baked()}
        if model.filter_variance is not None:
            files[raw] = model
        options = Writing(quality=self.quality)
        for file, one in files.items():
            run.written[_name(file, run)] = one.save(file, options)
            try:
                if for_writing(file).read:
                    load(file, Reading(quiet=True))
            except DataError as error:
                raise OutputError(f"{error}; it was written just now: check the disk and its space") from error
            LOG.info("%s Gaussians written to %s", f"{len(one):,}", file)
        run.written.pop(_name(behind, run), None)
        if behind.is_file():
            run.written[_name(behind, run)] = sha256(behind)
        if model.sky:
            LOG.info("their sky written to %s; `export: {sky: splats}` makes Gaussians of it", behind)

    def verify(self, run: Run) -> None:
        path, *more = self.outputs(run.out)
        for file in (path, *(one for one in more if _name(one, run) in run.written or one.exists())):
            if _name(file, run) not in run.written:
                raise DataError(f"{file}: this run has no record of writing it; move it away, and use --restart")
            if sha256(file) != run.written[_name(file, run)]:
                again = "`clsplat resume` writes those of the last model again, `clsplat run` with --restart all"
                raise DataError(f"{file}: differs from what was written; {again}")


def _name(file: Path, run: Run) -> str:
    return file.relative_to(run.out).as_posix()


# The model as a page to walk through.


class Viewer(Stage):
    """Write a page that shows the model from every side, and beside its photographs; it opens offline in any browser.

    Where it would have more than 200 MB, it has the most important Gaussians that fit, and a warning says so.
    """

    stage: Literal["viewer"] = "viewer"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    file: Annotated[str, path_in_run(".html")] = "viewer.html"
    """Path inside the run folder."""
    photographs: Which = "test"
    """Views whose photographs are in the page; all views have a thumbnail."""
    photograph_budget: Annotated[float, Field(gt=0, le=MAX_SIZE)] = BUDGET
    """MB of photographs; with more, every second, third, … is in the page."""

    def run(self, run: Run) -> None:
        path, model = run.out / self.file, host_model(run)
        shown = with_sky_splats(model)
        scene, name = learned_scene(run).downscaled(run.downscale), run.photographs.background_name

        def read(view: View) -> NDArray[np.uint8]:
            return run.photographs.get(view).image()

        def through(views: Iterable[View]) -> Iterable[View]:
            return run.status.counted(run.until_interrupted(views), "views", len(scene.views))

        views = described(scene, read, self.photographs, self.photograph_budget, through)
        stand = Stand.of(model.means, scene.views, (scene.split("test") or scene.views)[0])
        page = Page(f"{run.name} · {run.scene_name}", {run.name: pack(shown)}, stand, name, views)
        if page.size > MAX_SIZE and page.fitting:  # else the photographs are the fault, which the page says
            LOG.warning(
                "%s: shows the %s most important of %s Gaussians, so that browsers can open it; "
                "`clsplat compress` makes models of fewer",
                *(path, f"{page.fitting:,}", f"{len(shown):,}"),
            )
            page = Page(page.title, {run.name: pack(shown, page.fitting)}, stand, name, views)
        page.write(path)
        LOG.info("viewer written to %s, %.1f MB", path, path.stat().st_size / 1e6)

    def verify(self, run: Run) -> None:
        require_end(run.out / self.file)


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

    def check_in(self, run: Run) -> None:
        for name in self.formats:
            checked(run.original, name)

    def run(self, run: Run) -> None:
        for name in self.formats:
            for path in write_cameras(learned_scene(run), run.out / self.folder, name, over=True):
                LOG.info("cameras written to %s", path)

    def verify(self, run: Run) -> None:
        for name in self.formats:
            if not (path := run.out / self.folder / PLACES[name][0]).is_file():
                raise DataError(f"{path}: is missing")


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


# Render a split to image files.


class Render(Stage):
    """Write one PNG for each view of a split, with the name of the view."""

    stage: Literal["render"] = "render"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"split", "folder"})

    split: Literal["test", "train", "all"] = "test"
    """Views that are rendered."""
    folder: Annotated[str, path_in_run()] = "renders"
    """Path inside the run folder."""

    def _views(self, run: Run) -> dict[Path, View]:
        """The views of the split, by the file of their render."""
        views = learned_scene(run).downscaled(run.downscale).split(self.split)
        return dict(zip(image_paths(run.out / self.folder, [view.name for view in views]), views, strict=True))

    def run(self, run: Run) -> None:
        views = self._views(run)
        counted = run.status.counted(run.until_interrupted(views.items()), "views", len(views))
        for path, view in counted:
            camera = upload_camera(run.device, view)
            write_image(path, render_view(run.painter(), camera))
        if views:
            LOG.info("%s written to %s", amount(len(views), "image"), run.out / self.folder)

    def verify(self, run: Run) -> None:
        for path, view in self._views(run).items():
            if image_size(path) != (view.camera.width, view.camera.height):
                raise DataError(f"{path}: has another size than its view")


def image_paths(folder: Path, views: Sequence[str], suffix: str = ".png") -> list[Path]:
    """Return the files of views' renders; where two views differ in the suffix alone, it stays in their names."""
    paths = [image_path(folder, view, suffix) for view in views]
    uses = Counter(paths)
    return [path if uses[path] == 1 else folder / f"{view}{suffix}" for path, view in zip(paths, views, strict=True)]


def image_path(folder: Path, view: str, suffix: str = ".png") -> Path:
    """Return the file of a view's render: the view's name below `folder`, with another suffix."""
    name = PurePosixPath(view)
    return folder / name.with_suffix(suffix) if is_image(name) else folder / f"{view}{suffix}"
