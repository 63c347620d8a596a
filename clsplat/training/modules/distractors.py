"""Represent objects that only one photograph shows, such as people and cars, with Gaussians in front of its camera.

These Gaussians are not rows of the model, so growth, metrics, and files ignore them.  Their unit of length is their
initial depth, so that rates do not depend on the scene.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import DataError
from clsplat.core.schedule import NonNegative, at_step
from clsplat.formats.splats import SH_C0
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import moment_tables
from clsplat.losses.base import LossValue
from clsplat.opencl.device import Device
from clsplat.render.camera import move_camera
from clsplat.render.overlay import backpropagate_composite, composite_layer
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.view import View
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.base import ModuleState, Scalars, Tables, TrainingModule, TrainingStep
from clsplat.training.run import Run

UPDATES = "updates"
WIDTHS = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3}  # columns of the learned tables
NEAR_FRACTION = 0.2  # depth of the near plane, in initial depths
SIZE, OPACITY = 0.5, 0.05  # initial standard deviation, relative to the spacing of the Gaussians; initial opacity
GOLDEN_RATIO = (5**0.5 - 1) / 2
# A short run visits each photograph only a few dozen times, so rates are larger than those of the scene (our choice).
RATES = Rates(means=2e-3, quats=2e-3, log_scales=2e-2, logit_opacity=0.1, sh_base=2e-2, sh_rest=0.0).at(0, 1.0)


class Distractors(TrainingModule):
    """Give each photograph its own Gaussians just in front of its camera (DeSplat, Wang et al. 2024).

    They absorb objects that are not part of the scene.  No other image, metric, or file contains them.  Their number
    is fixed.  A loss on the covered area fades out Gaussians that explain little.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"start", "cover"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    order: ClassVar[int] = 20  # before the modules for colors: these Gaussians have the colors of the scene
    masks_objects: ClassVar[bool] = True
    device_planes: ClassVar[int] = 12  # upper bound, to render and compare them

    type: Literal["distractors"] = "distractors"
    count: Annotated[int, Field(gt=0, le=10_000)] = 200
    """Number of Gaussians per photo."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which these Gaussians are rendered."""
    cover: NonNegative = 0.1
    """Weight of the loss on the mean alpha of these Gaussians over the photo; may be scheduled."""

    def create_state(self, run: Run) -> "DistractorsState":
        rasterizer = Rasterizer(run.device, run.rasterizer.tiler.sort, run.rasterizer.budget)
        return DistractorsState(self, run.scene.split("train"), rasterizer)

    def device_bytes(self, views: Sequence[View], tile: int) -> int:
        rows = len({view.name for view in views}) * (self.count + 64)  # upper bound: each photo has whole groups
        return super().device_bytes(views, tile) + 4 * rows * (3 * sum(WIDTHS.values()) + 1)

    @classmethod
    def check_saved(cls, scalars: Scalars, tables: Tables) -> None:
        super().check_saved(scalars, tables)
        widths = {name: width for key, width in WIDTHS.items() for name in (key, *moment_tables(key))} | {UPDATES: 1}
        photographs, rows = len(tables.get(UPDATES, ())), len(tables.get("means", ()))
        shapes = {name: (photographs if name == UPDATES else rows, width) for name, width in widths.items()}
        if not photographs or not rows or rows % photographs or {n: t.shape for n, t in tables.items()} != shapes:
            raise DataError("its distractor tables must have the same number of rows for every photo")


class DistractorsState(ModuleState):
    """The Gaussians of each photograph on the device, with a separate Adam optimizer for each photograph."""

    def __init__(self, settings: Distractors, views: Sequence[View], rasterizer: Rasterizer) -> None:
        """views: the training views; rasterizer: not used elsewhere, since its frames share buffers."""
        super().__init__()
        self.settings, self.rasterizer, self.adams = settings, rasterizer, list[Adam]()
        self._names = list(dict.fromkeys(view.name for view in views))
        self._rows = [self._names.index(view.name) for view in views]
        self._black = rasterizer.device.zeros(3)

    def start(self, run: Run) -> None:
        views = run.scene.split("train")
        photographs = list({view.name: view for view in reversed(views)}.values())[::-1]
        progress = run.status.counted(photographs, "photos", len(photographs))
        self.load({}, initial_tables(self.settings.count, [(v, run.photographs.get(v).image()) for v in progress]))

    def can_load(self, scalars: Scalars, tables: Tables) -> bool:
        return len(tables[UPDATES]) == len(self._names)

    def load(self, scalars: Scalars, tables: Tables) -> None:
        self.adams = [_restore_adam(self.rasterizer.device, tables, row) for row in range(len(tables[UPDATES]))]

    def tables(self, full: bool = True) -> Tables:
        names = [name for key in WIDTHS for name in (key, *moment_tables(key))]
        tables = {name: np.concatenate([adam.gaussians.get(name) for adam in self.adams]) for name in names}
        return {**tables, UPDATES: np.array([[adam.updates["means"]] for adam in self.adams], np.float32)}

    def after_render(self, step: TrainingStep) -> None:
        if step.view_index is None or step.number <= self.settings.start:
            return
        camera, gaussians = step.camera, self.adams[self._rows[step.view_index]].gaussians
        model = replace(step.model, gaussians=gaussians, degree=0, near=NEAR_FRACTION, sky=None, dropout=None)
        moved_camera = move_camera(self.rasterizer.workspace, camera, np.eye(3, 4))
        frame = self.rasterizer.start_forward(model, moved_camera, self._black)
        step.frames.append((self.rasterizer, frame))
        scale = at_step(self.settings.cover, step.number) / (camera.width * camera.height)
        layer = composite_layer(step.workspace, frame, step.image, scale)
        step.image = layer.image
        step.module_losses.append(LossValue("distractors", layer.loss))
        step.save(self, (layer, []))

    def backward(self, step: TrainingStep) -> None:
        if not (saved := step.saved_value(self)):
            return
        layer, results = saved
        frame = replace(layer.frame, image=layer.image)  # the gradient of blending needs the combined colors
        arguments = frame.model, frame, step.gradient
        results += [frame, self.rasterizer.pixel_sums(*arguments, transmittance_gradient=layer.transmittance_gradient)]
        backpropagate_composite(step.workspace, frame, step.gradient)

    def update(self, step: TrainingStep) -> None:
        if (saved := step.saved_value(self)) and step.view_index is not None:
            _, (frame, pixel_sums) = saved  # saved by `backward`
            self.adams[self._rows[step.view_index]].update(frame.model, frame, pixel_sums, RATES)


def initial_tables(count: int, photographs: Sequence[tuple[View, NDArray[np.uint8]]]) -> Tables:
    """Return the initial Gaussians for photographs: evenly spread over each one, and almost transparent.

    They have the colors of the photographs.  photographs: pairs of a view and its pixels, [height, width, 3].
    """
    sets = [_spread_gaussians(count, view, pixels) for view, pixels in photographs]
    values = {name: np.concatenate([tables[name] for tables in sets]).astype(np.float32) for name in WIDTHS}
    moments = {moment: np.zeros_like(table) for name, table in values.items() for moment in moment_tables(name)}
    return {**values, **moments, UPDATES: np.zeros((len(sets), 1), np.float32)}


def _spread_gaussians(count: int, view: View, pixels: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return Gaussians on a Fibonacci lattice, one unit of length in front of a camera."""
    camera, index = view.camera, np.arange(count) + 0.5
    x, y = camera.width * index / count, camera.height * ((index * GOLDEN_RATIO) % 1)
    colors = pixels[y.astype(int), x.astype(int)] / 255
    size = SIZE * np.sqrt(camera.width * camera.height / count / (camera.fx * camera.fy))
    return {
        "means": np.column_stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(count)]),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), np.log(size)),
        "logit_opacity": np.full((count, 1), np.log(OPACITY / (1 - OPACITY))),
        "sh_base": (colors - 0.5) / SH_C0,
    }


def _restore_adam(device: Device, tables: Tables, number: int) -> Adam:
    """Return the optimizer of one photograph's Gaussians, with its moments.  number: index of the photograph."""
    count = len(tables["means"]) // len(tables[UPDATES])
    rows = slice(number * count, (number + 1) * count)
    parameters = {name: tables[name][rows] for name in WIDTHS}
    adam = Adam(Gaussians(device, {**parameters, "sh_rest": np.zeros((count, 0), np.float32)}))
    for moment in (moment for name in WIDTHS for moment in moment_tables(name)):
        adam.gaussians.set(moment, tables[moment][rows])
    adam.updates = dict.fromkeys(adam.updates, int(tables[UPDATES][number, 0]))
    return adam
