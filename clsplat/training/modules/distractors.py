"""What each photograph has before the scene: people, cars and whatever else no other photograph shows there.

They are no rows of the model: nothing that grows, measures or writes it ever sees them.  Their unit of length is their
first depth, so that they are the same in every scene.
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
from clsplat.render.camera import moved_camera
from clsplat.render.overlay import lay_over, look_behind
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.view import View
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.base import ModuleState, Scalars, Tables, TrainingModule, TrainingStep
from clsplat.training.run import Run

UPDATES = "updates"
WIDTHS = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3}  # of tables that change
NEAR = 0.2  # of their first depth
SIZE, OPACITY = 0.5, 0.05  # first standard deviation, of the distance of two of them; first opacity
GOLDEN = (5**0.5 - 1) / 2
# A photograph has a few dozen steps in a short training: larger rates than the scene's (ours)
RATES = Rates(means=2e-3, quats=2e-3, log_scales=2e-2, logit_opacity=0.1, sh_base=2e-2, sh_rest=0.0).at(0, 1.0)


class Distractors(TrainingModule):
    """Give each photograph Gaussians of its own, just before its camera (DeSplat, Wang et al. 2024).

    They take up what the scene does not have, and are in no other picture, no measurement and no file.  Their number
    stays.  Those that cover more than they explain fade.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"start", "cover"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    order: ClassVar[int] = 20  # in the colors of the scene
    device_planes: ClassVar[int] = 12  # which rendering and comparing them take, at most

    type: Literal["distractors"] = "distractors"
    count: Annotated[int, Field(gt=0, le=10_000)] = 200
    """Number of them for each photograph."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which they are there."""
    cover: NonNegative = 0.1
    """Weight of the mean of what they cover of a photograph, from 0 to 1, among the losses; by step."""

    def create_state(self, run: Run) -> "DistractorsState":
        sort, budget = run.rasterizer.tiler.sort, run.rasterizer.budget
        own = Rasterizer(run.device, "radix" if sort == "auto" else sort, budget)
        return DistractorsState(self, run.scene.split("train"), own)

    def device_bytes(self, views: Sequence[View], tile: int) -> int:
        rows = len({view.name for view in views}) * (self.count + 64)  # whole groups
        return super().device_bytes(views, tile) + 4 * rows * (3 * sum(WIDTHS.values()) + 1)

    @classmethod
    def check_saved(cls, scalars: Scalars, tables: Tables) -> None:
        super().check_saved(scalars, tables)
        widths = {name: width for one, width in WIDTHS.items() for name in (one, *moment_tables(one))} | {UPDATES: 1}
        photographs, rows = len(tables.get(UPDATES, ())), len(tables.get("means", ()))
        shapes = {name: (photographs if name == UPDATES else rows, width) for name, width in widths.items()}
        if not photographs or not rows or rows % photographs or {n: t.shape for n, t in tables.items()} != shapes:
            raise DataError("its distractors are not as many for each photograph")


class DistractorsState(ModuleState):
    """The Gaussians of each photograph on the device, as many for each, with its own Adam."""

    def __init__(self, settings: Distractors, views: Sequence[View], rasterizer: Rasterizer) -> None:
        """views: of the training; rasterizer: for these Gaussians alone."""
        super().__init__()
        self.settings, self.rasterizer, self.adams = settings, rasterizer, list[Adam]()
        self._names = list(dict.fromkeys(view.name for view in views))
        self._rows = [self._names.index(view.name) for view in views]
        self._black = rasterizer.device.zeros(3)

    def start(self, run: Run) -> None:
        views = run.scene.split("train")
        photographs = list({view.name: view for view in reversed(views)}.values())[::-1]
        counted = run.status.counted(photographs, "photographs", len(photographs))
        self.load({}, first_tables(self.settings.count, [(v, run.photographs.get(v).image()) for v in counted]))

    def can_load(self, scalars: Scalars, tables: Tables) -> bool:
        return len(tables[UPDATES]) == len(self._names)

    def load(self, scalars: Scalars, tables: Tables) -> None:
        self.adams = [_adam(self.rasterizer.device, tables, row) for row in range(len(tables[UPDATES]))]

    def tables(self, whole: bool = True) -> Tables:
        names = [name for one in WIDTHS for name in (one, *moment_tables(one))]
        found = {name: np.concatenate([adam.gaussians.get(name) for adam in self.adams]) for name in names}
        return {**found, UPDATES: np.array([[adam.updates["means"]] for adam in self.adams], np.float32)}

    def after_render(self, step: TrainingStep) -> None:
        if step.view is None or step.number <= self.settings.start:
            return
        camera, gaussians = step.camera, self.adams[self._rows[step.view]].gaussians
        own = replace(step.model, gaussians=gaussians, degree=0, near=NEAR, sky=None, dropout=None)
        frame = self.rasterizer.forward(own, moved_camera(camera, np.eye(3, 4)), self._black)
        scale = at_step(self.settings.cover, step.number) / (camera.width * camera.height)
        layer = lay_over(step.workspace, frame, step.image, scale)
        step.image = layer.image
        step.module_losses.append(LossValue("distractors", layer.loss))
        step.save(self, (layer, []))

    def backward(self, step: TrainingStep) -> None:
        if not (kept := step.saved(self)):
            return
        layer, sums = kept
        frame = replace(layer.frame, image=layer.image)  # blending is differentiated from the colors of all
        sums += [frame, self.rasterizer.pixel_sums(frame.drawn, frame, step.gradient, behind=layer.behind)]
        look_behind(step.workspace, frame, step.gradient)

    def update(self, step: TrainingStep) -> None:
        if (kept := step.saved(self)) and step.view is not None:
            frame, pixel_sums = kept[1]
            self.adams[self._rows[step.view]].update(frame.drawn, frame, pixel_sums, RATES)


def first_tables(count: int, photographs: Sequence[tuple[View, NDArray[np.uint8]]]) -> Tables:
    """Return the first Gaussians of photographs, [height, width, 3] with their views: spread evenly over each, with its
    colors, nearly clear."""
    parts = [_spread(count, view, pixels) for view, pixels in photographs]
    found = {name: np.concatenate([part[name] for part in parts]).astype(np.float32) for name in WIDTHS}
    moments = {moment: np.zeros_like(values) for name, values in found.items() for moment in moment_tables(name)}
    return {**found, **moments, UPDATES: np.zeros((len(parts), 1), np.float32)}


def _spread(count: int, view: View, pixels: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Gaussians at the places of a Fibonacci lattice, one unit of length before a camera."""
    camera, places = view.camera, np.arange(count) + 0.5
    x, y = camera.width * places / count, camera.height * ((places * GOLDEN) % 1)
    colors = pixels[y.astype(int), x.astype(int)] / 255
    size = SIZE * np.sqrt(camera.width * camera.height / count / (camera.fx * camera.fy))
    return {
        "means": np.column_stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(count)]),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), np.log(size)),
        "logit_opacity": np.full((count, 1), np.log(OPACITY / (1 - OPACITY))),
        "sh_base": (colors - 0.5) / SH_C0,
    }


def _adam(device: Device, tables: Tables, number: int) -> Adam:
    """The Gaussians of one photograph, with their moments."""
    count = len(tables["means"]) // len(tables[UPDATES])
    rows = slice(number * count, (number + 1) * count)
    parameters = {name: tables[name][rows] for name in WIDTHS}
    adam = Adam(Gaussians(device, {**parameters, "sh_rest": np.zeros((count, 0), np.float32)}))
    for moment in (moment for name in WIDTHS for moment in moment_tables(name)):
        adam.gaussians.set(moment, tables[moment][rows])
    adam.updates = dict.fromkeys(adam.updates, int(tables[UPDATES][number, 0]))
    return adam
