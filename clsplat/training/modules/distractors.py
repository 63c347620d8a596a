"""The Gaussians that each photograph has for itself while a model is trained, in the space of its camera.

They are no rows of the model: nothing that grows, measures or writes it ever sees them.  Their unit of length is their
first depth, so that they are the same in every scene.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import DataError
from clsplat.core.schedule import NonNegative, at_step
from clsplat.core.settings import Settings
from clsplat.formats.splats import SH_C0
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.gaussians.structs import moment_tables
from clsplat.opencl.device import Array, Device
from clsplat.render.camera import DeviceCamera, moved_camera
from clsplat.render.overlay import Layer, lay_over, look_behind
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.view import View
from clsplat.training.adam import Adam, Rates

# What each photograph has before the scene: people, cars and whatever else no other photograph shows there.


class Distractors(Settings):
    """Give each photograph Gaussians of its own, just before its camera (DeSplat, Wang et al. 2024).

    They take up what the scene does not have, and are in no other picture, no measurement and no file.  Their number
    stays.  Those that cover more than they explain fade.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"start", "cover"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})

    count: Annotated[int, Field(gt=0, le=10_000)] = 200
    """Number of them for each photograph."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which they are there."""
    cover: NonNegative = 0.1
    """Weight of the mean of what they cover of a photograph, from 0 to 1, among the losses; by step."""


FOLDER = "distractors/"  # before the names of their tables in a checkpoint
UPDATES = "updates"
WIDTHS = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3}  # of tables that change
NEAR = 0.2  # of their first depth
SIZE, OPACITY = 0.5, 0.05  # first standard deviation, of the distance of two of them; first opacity
GOLDEN = (5**0.5 - 1) / 2
# A photograph has a few dozen steps in a short training: larger rates than the scene's (ours)
RATES = Rates(means=2e-3, quats=2e-3, log_scales=2e-2, logit_opacity=0.1, sh_base=2e-2, sh_rest=0.0).at(0, 1.0)
PLANES = 12  # of a view's size, which rendering and comparing them take, at most
Tables = dict[str, NDArray[np.float32]]


class OwnGaussians:
    """The Gaussians of each photograph on the device, as many for each, with its own Adam."""

    def __init__(self, device: Device, tables: Mapping[str, NDArray[np.float32]]) -> None:
        """tables: as `first_tables` or `tables` returns them."""
        self.adams = [_adam(device, tables, number) for number in range(len(tables[UPDATES]))]

    def tables(self) -> Tables:
        """Copy parameters and moments to the host, [photographs * count, components] each, and the numbers of updates,
        [photographs, 1]."""
        names = [name for one in WIDTHS for name in (one, *moment_tables(one))]
        found = {name: np.concatenate([adam.gaussians.get(name) for adam in self.adams]) for name in names}
        return {**found, UPDATES: np.array([[adam.updates["means"]] for adam in self.adams], np.float32)}


class PhotographDistractors:
    """What photographs have before the scene in a training: each step renders and changes that of its photograph."""

    def __init__(self, settings: Distractors, views: Sequence[View], rasterizer: Rasterizer, own: OwnGaussians) -> None:
        """views: of the training; rasterizer: for these Gaussians alone."""
        names = list(dict.fromkeys(view.name for view in views))
        self.settings, self.rasterizer = settings, rasterizer
        self._adams = [own.adams[names.index(view.name)] for view in views]
        self._black = rasterizer.device.zeros(3)

    def before(self, model: DeviceModel, camera: DeviceCamera, image: Array, step: int) -> Layer | None:
        """Return what the photograph of a camera has before an image of the model, [3 or 4, rows, stride], with both.

        None where that is nothing.
        """
        if camera.view is None or step <= self.settings.start:
            return None
        gaussians = self._adams[camera.view].gaussians
        own = replace(model, gaussians=gaussians, degree=0, near=NEAR, sky=None, dropout=None)
        frame = self.rasterizer.forward(own, moved_camera(camera, np.eye(3, 4)), self._black)
        scale = at_step(self.settings.cover, step) / (camera.width * camera.height)
        return lay_over(self.rasterizer.workspace, frame, image, scale)

    def learning(self, layer: Layer, gradient: Array, view: int) -> Callable[[], None]:
        """Return what changes the Gaussians of a view.

        gradient: by the colours of both, [3 or 4, rows, stride]; it becomes that by the image behind.
        """
        frame = replace(layer.frame, image=layer.image)  # blending is differentiated from the colours of all
        pixel_sums = self.rasterizer.pixel_sums(frame.drawn, frame, gradient, behind=layer.behind)
        look_behind(self.rasterizer.workspace, frame, gradient)

        def learn() -> None:
            self._adams[view].update(frame.drawn, frame, pixel_sums, RATES)

        return learn


def first_tables(count: int, photographs: Sequence[tuple[View, NDArray[np.uint8]]]) -> Tables:
    """Return the first Gaussians of photographs, [height, width, 3] with their views: spread evenly over each, with its
    colours, nearly clear."""
    parts = [_spread(count, view, pixels) for view, pixels in photographs]
    found = {name: np.concatenate([part[name] for part in parts]).astype(np.float32) for name in WIDTHS}
    moments = {moment: np.zeros_like(values) for name, values in found.items() for moment in moment_tables(name)}
    return {**found, **moments, UPDATES: np.zeros((len(parts), 1), np.float32)}


def _spread(count: int, view: View, pixels: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Gaussians at the places of a Fibonacci lattice, one unit of length before a camera."""
    camera, places = view.camera, np.arange(count) + 0.5
    x, y = camera.width * places / count, camera.height * ((places * GOLDEN) % 1)
    colours = pixels[y.astype(int), x.astype(int)] / 255
    size = SIZE * np.sqrt(camera.width * camera.height / count / (camera.fx * camera.fy))
    return {
        "means": np.column_stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(count)]),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), np.log(size)),
        "logit_opacity": np.full((count, 1), np.log(OPACITY / (1 - OPACITY))),
        "sh_base": (colours - 0.5) / SH_C0,
    }


def _adam(device: Device, tables: Mapping[str, NDArray[np.float32]], number: int) -> Adam:
    """The Gaussians of one photograph, with their moments."""
    count = len(tables["means"]) // len(tables[UPDATES])
    rows = slice(number * count, (number + 1) * count)
    parameters = {name: tables[name][rows] for name in WIDTHS}
    adam = Adam(Gaussians(device, {**parameters, "sh_rest": np.zeros((count, 0), np.float32)}))
    for moment in (moment for name in WIDTHS for moment in moment_tables(name)):
        adam.gaussians.set(moment, tables[moment][rows])
    adam.updates = dict.fromkeys(adam.updates, int(tables[UPDATES][number, 0]))
    return adam


def check_tables(tables: Mapping[str, NDArray[np.float32]]) -> None:
    """Raise DataError for tables that are not those of distractors; there may be none."""
    if not tables:
        return
    widths = {name: width for one, width in WIDTHS.items() for name in (one, *moment_tables(one))}
    if tables.keys() != {*widths, UPDATES}:
        raise DataError("it has other distractors than those of its own tables")
    photographs, rows = len(tables[UPDATES]), len(tables["means"])
    if not photographs or not rows or rows % photographs or tables[UPDATES].shape != (photographs, 1):
        raise DataError("its distractors are not as many for each photograph")
    for name, width in {**widths, UPDATES: 1}.items():
        if tables[name].shape != (photographs if name == UPDATES else rows, width):
            raise DataError(f"{name} of its distractors is not [rows, {width}]")
        if tables[name].dtype != np.float32 or not np.isfinite(tables[name]).all():
            raise DataError(f"{name} of its distractors is not of finite numbers")


def restored(tables: Mapping[str, NDArray[np.float32]], device: Device) -> OwnGaussians | None:
    """Return the Gaussians of a checkpoint's tables, by their own names; None without any."""
    return OwnGaussians(device, tables) if tables else None


def distractor_bytes(settings: Any, views: Sequence[View], tile: int) -> int:
    """Return what the distractors of a pipeline's trainings take on the device, at most.  tile: px of its sides."""
    stages = [getattr(stage, "distractors", None) for stage in getattr(settings, "stages", ())]
    counts = [int(stage.count) for stage in stages if stage is not None]
    if not counts:
        return 0
    tiles = max(-(-one.camera.width // tile) * -(-one.camera.height // tile) for one in views)
    rows = len({view.name for view in views}) * (max(counts) + 64)  # whole groups
    return 4 * (rows * (3 * sum(WIDTHS.values()) + 1) + PLANES * tiles * tile**2)
