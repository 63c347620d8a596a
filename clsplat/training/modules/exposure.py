"""Fit the exposure of each photograph: a color transform of the render before the losses.

A photograph has a few parameters, all 0 for the identity.  They define a matrix [E | b], and a pixel c of the render
becomes min(1, E c + b) before the losses (cl_kernels/colors.cl).
"""

import itertools
import json
import logging
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from clsplat.core.errors import DataError, NumericError, quote
from clsplat.core.files import open_atomic, write_text
from clsplat.core.reading import read_json
from clsplat.core.schedule import Bounded, Decay, Schedule, at_step, explain_schedule
from clsplat.core.settings import OneOf, Settings, variants
from clsplat.losses.base import LossValue
from clsplat.metrics.views import Gains
from clsplat.opencl.device import Array, constants
from clsplat.photos.appearance import IDENTITY, LUMINANCE, MEANING, Floats, ViewTable
from clsplat.photos.exposure_estimate import (
    UNKNOWN,
    Exposures,
    complete_exposures,
    exposures_from_exif,
    measure_exposures,
)
from clsplat.photos.photographs import Mask
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.training.modules.base import ModuleState, Scalars, Tables, TrainingModule, TrainingStep
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
VIEW_COLORS = "view_colors.json"
TABLE, HAS_KNOWN = "colors", "known exposures"  # names of scalars; HAS_KNOWN: whether the initial exposures were known
SUMS = int(constants("colors.cl")["SUMS"])
NAMES = tuple(f"{y}{c}" for y in "rgb" for c in "rgb1")  # names of the kernels' arguments
MIN_VISITS = 400  # visits per photograph; with fewer, Adam with a rate of 2e-3 cannot reach a gain of 1.5
MAX_RATE = 5e-2
Rate = Annotated[Schedule, AfterValidator(Bounded(0, maximum=0.5))]  # an Adam step of 0.5 is a gain of 1.6
RateOrAuto = Annotated[Literal["auto"] | Rate, explain_schedule(", or auto")]
MIN_SPREAD = 0.03  # accuracy of measurements on tracks
# In three captures, exposure explains 17 to 31% of the variance; with exposures changed by 25%, 40 to 71%.
MIN_EXPLAINED = 1 / 3


@dataclass(frozen=True)
class ColorReport:
    """The learned colors of the photographs, for side files."""

    matrices: dict[str, Floats]  # matrix of each photograph, [3, 4]; for a grid, the mean of its matrices
    facts: dict[str, Any]  # for JSON, with `meaning` and `type`
    arrays: dict[str, NDArray[np.float32]] = field(default_factory=dict)  # by file name, .npy


class Appearance(TrainingModule):
    """Color parameters of each photograph, learned together with the Gaussians, with zero mean over the photographs.

    Without this constraint, the colors of the model would drift: the Gaussians can undo a change that all photographs
    share, and then no loss detects it.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "reason"})
    order: ClassVar[int] = 30  # after layers in front of the scene
    family: ClassVar[str] = "appearance"
    conflicts: ClassVar[Mapping[str, str]] = {"blocks": "the colors of blocks would differ"}
    side_files: ClassVar[Mapping[str, str]] = {VIEW_COLORS: "colors"}
    device_planes: ClassVar[int] = 6  # the transformed image, and its gradient

    rate: RateOrAuto = "auto"
    """Learning rate, at most 0.5; may be scheduled.  auto: 2e-3 to 2e-5, or 1e-2 to 1e-3 with fewer than 400 visits
    per photo; if exposures are unknown, large enough to reach a gain of 2.7, but at most 5e-2."""

    when: Literal["always", "auto"] = "always"
    """`auto`: only if exposures differ.

    Before training, log exposures are measured on the tracks of the dataset's points.  The module is active if both
    their standard deviation and the fraction of the color variance that they explain are large enough; view-dependent
    light explains the remainder.  If it is not active, the model is bit-identical to one without the module."""
    min_spread: Annotated[float, Field(ge=0)] = MIN_SPREAD
    """With `when: auto`, the standard deviation of log exposures must exceed this; 0.03 is 3%."""
    min_explained_variance: Annotated[float, Field(ge=0, lt=1)] = MIN_EXPLAINED
    """With `when: auto`, the fraction of the points' color variance that exposures explain must exceed this."""
    chosen: Literal["on", "off"] | None = None
    """Written by a run: the choice of `auto`."""
    reason: str = ""
    """Written by a run: the reason for the choice."""

    @property
    @abstractmethod
    def color_model(self) -> "ColorModel":
        """The color model that metrics fit to each photograph."""

    def is_active(self, scene: Scene | None = None) -> bool:
        return self.when == "always" or self.chosen == "on"

    def device_bytes(self, views: Sequence[View], tile: int) -> int:
        return 0 if self.chosen == "off" else super().device_bytes(views, tile)

    def rate_schedule(self, steps: int, photographs: int, is_warm_start: bool = True) -> Schedule:
        """Return the learning rate schedule.  is_warm_start: whether parameters start near the solution."""
        if self.rate != "auto":
            return self.rate
        visits = steps / photographs
        initial, final = (1e-2, 1e-3) if visits < MIN_VISITS else (2e-3, 2e-5)
        if not is_warm_start:
            min_rate = min(math.log(10) / (0.9 * visits), MAX_RATE)  # so that decaying rates sum to 1
            initial, final = max(initial, min_rate), max(final, min_rate / 10)
        return Decay(initial=initial, final=final, over=steps)

    def resolve_auto(self, run: Run) -> "Appearance":
        """Return the module with the choice of `when: auto`.  An earlier choice is kept."""
        if self.when == "always" or self.chosen is not None:
            return self
        exposures = estimate_exposures(run)
        if not exposures.log_gains:
            return self._choose("off", exposures.summary)
        is_small = exposures.spread <= self.min_spread, exposures.explained_variance <= self.min_explained_variance
        bounds = f"{self.min_spread:.1%}", f"{self.min_explained_variance:.0%} of the variance"
        if not any(is_small):
            return self._choose("on", f"{exposures.summary}; more than {bounds[0]} and {bounds[1]}")
        small_bounds = " or ".join(itertools.compress(bounds, is_small))
        return self._choose("off", f"{exposures.summary}; not more than {small_bounds}")

    def _choose(self, chosen: Literal["on", "off"], reason: str) -> "Appearance":
        level = logging.INFO if chosen == "on" else logging.DEBUG  # "off" changes nothing
        LOG.log(level, "optimize.modules.%s: %s, since %s", self.type, chosen, reason)
        return self.model_copy(update={"chosen": chosen, "reason": reason})

    @classmethod
    def read_color_model(cls, model: Path) -> "ColorModel | None":
        path = model.with_name(VIEW_COLORS)
        if not path.is_file():
            return None
        data, classes = read_json(path, "colors of photos"), variants(Appearance)
        name = data.get("type") if isinstance(data, dict) else None
        if not isinstance(name, str) or name not in classes:
            names = ", ".join(classes)
            raise DataError(
                f"{path}: unknown color type {quote(name)}; expected {names}; train again, or remove the file"
            )
        fields = {key: data[key] for key in ("model",) if key in data}
        return classes[name].model_validate(fields).color_model if classes[name] is cls else None


class ColorModel(Settings):
    """A color transform of a photograph: one matrix for all pixels, defined by a few parameters."""

    columns: ClassVar[tuple[str, ...]] = ()  # names of the parameters of a photograph
    parameters_per_channel: ClassVar[int] = 1  # number of parameters that `fit_matrix` fits in each channel

    type: str
    """Name of the model."""

    @abstractmethod
    def fit_matrix(self, image: Floats, photograph: Floats) -> Floats:
        """Return the matrix, [3, 4], that fits an image to a photograph by least squares.  Both have shape [M, 3]."""

    @abstractmethod
    def matrix(self, row: Floats) -> Floats:
        """Return [E | b], [3, 4], from the parameters, [columns]."""

    @abstractmethod
    def gradient(self, row: Floats, grad_matrix: Floats) -> Floats:
        """Return the gradient of the parameters, [columns].  grad_matrix: gradient of the matrix, [3, 4]."""

    @abstractmethod
    def from_gains(self, log_gains: Floats) -> Floats:
        """Return the parameters, [columns], that best match gains.  log_gains: logarithms of the RGB gains, [3]."""

    def penalty(self, row: Floats) -> tuple[float, Floats]:
        """Return a regularization loss on the parameters, and its gradient."""
        return 0.0, np.zeros_like(row)


class Gain(Gains, ColorModel):
    """Exposure and white balance of each photograph.

    Channels are multiplied by exp(exposure + (red, green, blue)).  Green is computed from red and blue, so that only
    the exposure changes the luminance.
    """

    columns: ClassVar[tuple[str, ...]] = ("exposure", "red", "blue")

    type: Literal["gain"] = "gain"

    def matrix(self, row: Floats) -> Floats:
        exposure, red, blue = row
        green = -(LUMINANCE[0] * red + LUMINANCE[2] * blue) / LUMINANCE[1]
        return np.column_stack([np.diag(np.exp(exposure + np.array([red, green, blue]))), np.zeros(3)])

    def gradient(self, row: Floats, grad_matrix: Floats) -> Floats:
        red, green, blue = np.diag(grad_matrix) * np.diag(self.matrix(row))
        grad_green = green * LUMINANCE / LUMINANCE[1]
        return np.array([red + green + blue, red - grad_green[0], blue - grad_green[2]])

    def from_gains(self, log_gains: Floats) -> Floats:
        exposure = LUMINANCE @ log_gains
        return np.array([exposure, log_gains[0] - exposure, log_gains[2] - exposure])


class Affine(ColorModel):
    """An affine color transform of each photograph with twelve parameters (Kerbl et al. 2024).

    It can represent white balance, contrast, and haze, but it also absorbs view-dependent color that the Gaussians
    should represent; `weight` limits this.  `gain` generalizes better.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})
    columns: ClassVar[tuple[str, ...]] = tuple(f"{y}_{c}" for y in ("red", "green", "blue") for c in "rgb1")
    parameters_per_channel: ClassVar[int] = 4

    type: Literal["affine"] = "affine"
    weight: Annotated[float, Field(ge=0)] = 1e-2
    """Weight of a loss that pulls the matrix toward the identity: the sum of squared differences, excluding offsets."""

    def matrix(self, row: Floats) -> Floats:
        return IDENTITY + row.reshape(3, 4)

    def gradient(self, row: Floats, grad_matrix: Floats) -> Floats:
        return grad_matrix.ravel()

    def from_gains(self, log_gains: Floats) -> Floats:
        return (np.column_stack([np.diag(np.exp(log_gains)), np.zeros(3)]) - IDENTITY).ravel()

    def penalty(self, row: Floats) -> tuple[float, Floats]:
        difference = row.reshape(3, 4) * [1, 1, 1, 0]
        return self.weight * float((difference**2).sum()), 2 * self.weight * difference.ravel()

    def fit_matrix(self, image: Floats, photograph: Floats) -> Floats:
        if len(image) == 0:
            return IDENTITY
        design = np.column_stack([image, np.ones(len(image))])
        gram = np.einsum("mi,mj->ij", design, design)  # unlike @, sums do not depend on threads
        products = np.einsum("mi,mj->ij", design, photograph)
        return np.asarray(np.linalg.lstsq(gram, products, rcond=None)[0].T, np.float64)


class Exposure(Appearance):
    """Fit the exposure of each photograph: one color matrix for all its pixels."""

    type: Literal["exposure"] = "exposure"
    model: OneOf[ColorModel] = Gain()
    """`gain`: exposure and white balance; `affine`: a full matrix."""

    @property
    def color_model(self) -> ColorModel:
        return self.model

    def create_state(self, run: Run) -> "ExposureState":
        return ExposureState(self, [view.name for view in run.scene.split("train")])


class ColorState(ModuleState):
    """Base class of the learned colors of the photographs."""

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: Appearance, views: Sequence[str]) -> None:
        """views: names of the training views by index.  All image sizes of a view share a row of parameters."""
        super().__init__()
        self.settings, self.views, self.names = settings, views, tuple(dict.fromkeys(views))
        self.rate: Schedule = 0.0

    def start(self, run: Run) -> None:
        exposures = estimate_exposures(run)
        self.start_from(exposures.log_gains)
        self.scalars[HAS_KNOWN] = float(bool(exposures.log_gains))
        LOG.info("colors of photos: %s", exposures.summary)

    def prepare(self, run: Run, last_step: int, is_trained: bool = True) -> None:
        self.rate = self.settings.rate_schedule(last_step, len(self.names), self.scalars.get(HAS_KNOWN, 1.0) > 0)

    def start_from(self, log_gains: Mapping[str, Floats]) -> None:
        """Initialize the parameters.  log_gains: logarithms of known gains, [3], by view."""

    @property
    def color_model(self) -> ColorModel:
        return self.settings.color_model

    @abstractmethod
    def report(self) -> ColorReport:
        """Return the contents of the side files."""

    def write(self, run: Run) -> None:
        """Write the colors of each training photograph.  Raises NumericError if they are not finite."""
        report = self.report()
        if invalid := next((view for view, matrix in report.matrices.items() if not np.isfinite(matrix).all()), None):
            raise NumericError(
                f"the colors of {quote(invalid)} are not finite; lower optimize.modules.{self.settings.type}.rate"
            )
        write_text(run.out / VIEW_COLORS, json.dumps(report.facts, indent=1) + "\n")
        for name, array in report.arrays.items():
            with open_atomic(run.out / name) as file:
                np.save(file, array, allow_pickle=False)
        green_gains = [matrix[1, 1] for matrix in report.matrices.values()]
        LOG.info(
            "colors of %d photos in %s: green is multiplied by %.2f to %.2f",
            *(len(green_gains), VIEW_COLORS, min(green_gains), max(green_gains)),
        )


class ExposureState(ColorState):
    """The parameters of one color matrix for each photograph."""

    settings: Exposure

    @property
    def table(self) -> ViewTable:
        return ViewTable(TABLE, self.names, self.settings.model.columns)

    def can_load(self, scalars: Scalars, tables: Tables) -> bool:
        return self.table.is_in(scalars)

    def start_from(self, log_gains: Mapping[str, Floats]) -> None:
        from_gains = self.settings.model.from_gains
        self.table.begin(self.scalars, {view: from_gains(gains) for view, gains in log_gains.items()})

    def after_render(self, step: TrainingStep) -> None:
        if step.view_index is None:
            return
        row = self.table.row(self.scalars, self.views[step.view_index])
        penalty, matrix, image = self.settings.model.penalty(row)[0], self.settings.model.matrix(row), step.image
        step.save(self, (image, matrix, []))
        step.image = transform_colors(step.workspace, step.camera, image, matrix)
        step.module_losses.append(LossValue("colors", lambda: penalty))

    def backward(self, step: TrainingStep) -> None:
        if saved := step.saved_value(self):
            image, matrix, downloads = saved
            step.gradient, download = color_gradients(step.workspace, step.camera, image, matrix, step.gradient)
            downloads.append(download)

    def update(self, step: TrainingStep) -> None:
        if not (saved := step.saved_value(self)) or step.view_index is None:
            return
        self.learn(step.view_index, saved[2][0](), step.number)

    def learn(self, view: int, grad_matrix: Floats, step: int) -> None:
        """Update the parameters of a view.  grad_matrix: gradient of the view's matrix, [3, 4]."""
        row = self.table.row(self.scalars, self.views[view])
        gradient = self.settings.model.gradient(row, grad_matrix) + self.settings.model.penalty(row)[1]
        self.table.update(self.scalars, self.views[view], gradient, at_step(self.rate, step))

    def matrix(self, view: int) -> Floats:
        """Return the matrix of a training view, [3, 4]."""
        return self.settings.model.matrix(self.table.row(self.scalars, self.views[view]))

    def report(self) -> ColorReport:
        rows = {view: self.table.row(self.scalars, view) for view in self.table.views}
        matrices = {view: self.settings.model.matrix(row) for view, row in rows.items()}
        model = self.settings.model
        photographs = {
            view: {**dict(zip(model.columns, map(float, row), strict=True)), "matrix": matrices[view].tolist()}
            for view, row in rows.items()
        }
        description = f"{MEANING}; matrix: the rows of [E | b]"
        facts = {"meaning": description, "type": self.settings.type, "model": model.type, "photographs": photographs}
        return ColorReport(matrices, facts)


def estimate_exposures(run: Run) -> Exposures:
    """Estimate the exposures of the training photographs from tracks and EXIF.  The run caches the result."""
    views = run.scene.split("train")
    names = tuple(view.name for view in views)
    key = TABLE, names
    if key not in run.cache:

        def read(view: View) -> tuple[NDArray[np.uint8], Mask | None]:
            photograph = run.photographs.get(view)
            return photograph.image(), photograph.unmasked_pixels()

        progress = run.status.counted(views, "photos", len(views))
        exposures = measure_exposures(run.scene.tracks, progress, read) if run.scene.tracks else UNKNOWN
        is_complete = len(exposures.log_gains) == len(set(names))
        run.cache[key] = exposures if is_complete else complete_exposures(exposures, exposures_from_exif(views))
    result: Exposures = run.cache[key]
    return result


def transform_colors(workspace: Workspace, camera: DeviceCamera, image: Array, matrix: Floats) -> Array:
    """Return an image, [3 or 4, rows, stride], with its colors transformed by a matrix, [3, 4]."""
    result = workspace.array("colored", image.shape)
    workspace.device.program("colors.cl").colors_forward(
        groups=(1, camera.rows), image=image, colored=result, **_arguments(camera, image, matrix)
    )
    return result


def color_gradients(
    workspace: Workspace, camera: DeviceCamera, image: Array, matrix: Floats, gradient: Array
) -> tuple[Array, Callable[[], Floats]]:
    """Return the gradient of `image`, and a function that waits for the gradient of the matrix, [3, 4], and returns it.

    gradient: gradient of the result of `transform_colors`.  Row sums are added in double precision, in order.
    """
    grad_image, sums = workspace.array("grad_colored", image.shape), workspace.array("color sums", (SUMS, camera.rows))
    workspace.device.program("colors.cl").colors_backward(
        groups=(1, camera.rows),
        image=image,
        gradient=gradient,
        grad_image=grad_image,
        row_sums=sums,
        **_arguments(camera, image, matrix),
    )
    row_sums = sums.get_later()
    return grad_image, lambda: np.cumsum(row_sums(), axis=1, dtype=np.float64)[:, -1].reshape(3, 4)


def _arguments(camera: DeviceCamera, image: Array, matrix: Floats) -> dict[str, Any]:
    values: dict[str, Any] = dict(zip(NAMES, map(float, matrix.ravel()), strict=True))
    return {**values, "channels": image.shape[0], **camera.plane_arguments()}
