"""Colors of each photograph, where exposures differ: between the rendered image and the losses.

A photograph has its numbers, all 0 where its colors are the scene's.  They make a matrix [E | b], and a pixel c of the
rendered image becomes min(1, E c + b) before every loss (cl_kernels/colors.cl).
"""

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
from clsplat.photos.exposure_estimate import UNKNOWN, Exposures, measured, noted, with_noted
from clsplat.photos.photographs import Mask
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.training.modules.base import ModuleState, Scalars, Tables, TrainingModule, TrainingStep
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
VIEW_COLORS = "view_colors.json"
TABLE, KNOWN = "colors", "known exposures"  # KNOWN: whether the numbers began with exposures that were measured
SUMS = int(constants("colors.cl")["SUMS"])
NAMES = tuple(f"{y}{c}" for y in "rgb" for c in "rgb1")  # of the kernels' arguments
FEW_VISITS = 400  # of a photograph: with fewer, Adam at 2e-3 cannot reach a gain of 1.5
MOST = 5e-2  # learning rate
Rate = Annotated[Schedule, AfterValidator(Bounded(0, maximum=0.5))]  # Adam's steps are as long: a gain of 1.6 in each
RateOrAuto = Annotated[Literal["auto"] | Rate, explain_schedule(", or auto")]
SPREAD = 0.03  # of the exposures: smaller ones are within what tracks measure
# Of the differences: 17 to 31 % in three captures as they are, 40 to 71 % in the same with exposures changed by 25 %.
EXPLAINED = 1 / 3


@dataclass(frozen=True)
class Written:
    """What a training leaves of the colors of its photographs."""

    matrices: dict[str, Floats]  # of each photograph, the mean where it has several, [3, 4]
    facts: dict[str, Any]  # for JSON: at least `meaning` and `type`, the name of the kind
    arrays: dict[str, NDArray[np.float32]] = field(default_factory=dict)  # by the names of files of NumPy's


class Appearance(TrainingModule):
    """Numbers of each photograph, which are learned with the Gaussians; their mean over the photographs stays 0.

    Without that, a change of all of them and the opposite one of the Gaussians would be the same to every loss, and the
    colors of the model would drift.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "reason"})
    order: ClassVar[int] = 30  # after what stands in front of the scene
    family: ClassVar[str] = "appearance"
    conflicts: ClassVar[Mapping[str, str]] = {"blocks": "those of blocks would differ"}
    side_files: ClassVar[Mapping[str, str]] = {VIEW_COLORS: "colors"}
    device_planes: ClassVar[int] = 6  # the image in the colors of its photograph, and its gradient

    rate: RateOrAuto = "auto"
    """Learning rate of the numbers, by Adam, by step; auto: 1e-2 to 1e-3, where each photograph is visited 400 times or
    more 2e-3 to 2e-5; where no tracks tell the exposures, as large as a gain of 2.7 needs, up to 5e-2.  At most 0.5."""

    when: Literal["always", "auto"] = "always"
    """`auto`: where exposures differ, by what the photographs show of the same points.

    The logarithms of the exposures are measured on the tracks of the dataset's points, before training.  Two bounds are
    to be passed: the standard deviation of the exposures, and their share of what differs between photographs of one
    point; light that changes with the direction of view is the rest.  Elsewhere the bits are those without it."""
    above: Annotated[float, Field(ge=0)] = SPREAD
    """With `when: auto`, standard deviation of the logarithms of the exposures; 0.03 is 3 %."""
    explained: Annotated[float, Field(ge=0, lt=1)] = EXPLAINED
    """With `when: auto`, share of the differences."""
    chosen: Literal["on", "off"] | None = None
    """Written by a run: what `auto` has chosen."""
    reason: str = ""
    """Written by a run: why."""

    @property
    @abstractmethod
    def fit(self) -> "ColorModel":
        """What images are measured with: colors that are fitted to a photograph."""

    def is_active(self, scene: Scene | None = None) -> bool:
        return self.when == "always" or self.chosen == "on"

    def device_bytes(self, views: Sequence[View], tile: int) -> int:
        return 0 if self.chosen == "off" else super().device_bytes(views, tile)

    def rate_of(self, steps: int, photographs: int, known: bool = True) -> Schedule:
        """Return the learning rate by step of a training with so many steps and photographs.

        known: whether the numbers begin near those of the photographs.
        """
        if self.rate != "auto":
            return self.rate
        visits = steps / photographs
        initial, final = (1e-2, 1e-3) if visits < FEW_VISITS else (2e-3, 2e-5)
        if not known:
            needed = min(math.log(10) / (0.9 * visits), MOST)  # the sum of rates that fall to a tenth is 1
            initial, final = max(initial, needed), max(final, needed / 10)
        return Decay(initial=initial, final=final, over=steps)

    def resolve_auto(self, run: Run) -> "Appearance":
        """Return it with the choice that follows from the exposures of the photographs; one that is made stays."""
        if self.when == "always" or self.chosen is not None:
            return self
        exposures = exposures_of(run)
        if not exposures.log_gains:
            return self._choose("off", exposures.text)
        few, alike = exposures.spread <= self.above, exposures.explained <= self.explained
        bounds = [f"{self.above:.1%}", f"{self.explained:.0%} of what differs"]
        if not few and not alike:
            return self._choose("on", f"{exposures.text}; more than {bounds[0]}, and than {bounds[1]}")
        missed = " nor ".join(bound for bound, decides in zip(bounds, (few, alike), strict=True) if decides)
        return self._choose("off", f"{exposures.text}; not more than {missed}")

    def _choose(self, chosen: Literal["on", "off"], reason: str) -> "Appearance":
        LOG.info("optimize.modules.%s: %s, since %s", self.type, chosen, reason)
        return self.model_copy(update={"chosen": chosen, "reason": reason})

    @classmethod
    def read_color_model(cls, model: Path) -> "ColorModel | None":
        path = model.with_name(VIEW_COLORS)
        if not path.is_file():
            return None
        data, known = read_json(path, "colors of photographs"), variants(Appearance)
        name = data.get("type") if isinstance(data, dict) else None
        if not isinstance(name, str) or name not in known:
            names = ", ".join(known)
            raise DataError(f"{path}: the type of colors is {quote(name)}; expected one of {names}: write it again")
        facts = {key: data[key] for key in ("model",) if key in data}
        return known[name].model_validate(facts).fit if known[name] is cls else None


class ColorModel(Settings):
    """What makes the colors of a scene those of one photograph: one matrix for all its pixels, of a few numbers."""

    columns: ClassVar[tuple[str, ...]] = ()  # names of the numbers of a photograph
    fitted_to_a_channel: ClassVar[int] = 1  # numbers that `fitted` finds for each of red, green and blue

    type: str
    """Name of the model."""

    @abstractmethod
    def fitted(self, image: Floats, photograph: Floats) -> Floats:
        """Return the matrix, [3, 4], that brings an image nearest to a photograph by least squares, pixels [M, 3]."""

    @abstractmethod
    def matrix(self, row: Floats) -> Floats:
        """Return [E | b], [3, 4], of a photograph's numbers, [columns]."""

    @abstractmethod
    def gradient(self, row: Floats, by_matrix: Floats) -> Floats:
        """Return derivatives by a photograph's numbers, [columns], from those by its matrix, [3, 4]."""

    @abstractmethod
    def of_gains(self, log_gains: Floats) -> Floats:
        """Return the numbers, [columns], that come nearest to gains of red, green and blue: their logarithms, [3]."""

    def penalty(self, row: Floats) -> tuple[float, Floats]:
        """Return a loss of a photograph's numbers alone, and its derivatives."""
        return 0.0, np.zeros_like(row)


class Gain(Gains, ColorModel):
    """An exposure and a white balance of each photograph.

    Channels are multiplied by exp(exposure + (red, green, blue)); green follows from red and blue, so that the
    luminance follows the exposure alone.
    """

    columns: ClassVar[tuple[str, ...]] = ("exposure", "red", "blue")

    type: Literal["gain"] = "gain"

    def matrix(self, row: Floats) -> Floats:
        exposure, red, blue = row
        green = -(LUMINANCE[0] * red + LUMINANCE[2] * blue) / LUMINANCE[1]
        return np.column_stack([np.diag(np.exp(exposure + np.array([red, green, blue]))), np.zeros(3)])

    def gradient(self, row: Floats, by_matrix: Floats) -> Floats:
        red, green, blue = np.diag(by_matrix) * np.diag(self.matrix(row))
        tied = green * LUMINANCE / LUMINANCE[1]
        return np.array([red + green + blue, red - tied[0], blue - tied[2]])

    def of_gains(self, log_gains: Floats) -> Floats:
        exposure = LUMINANCE @ log_gains
        return np.array([exposure, log_gains[0] - exposure, log_gains[2] - exposure])


class Affine(ColorModel):
    """An affine change of the colors of each photograph, twelve numbers (Kerbl et al. 2024).

    It follows white balance, contrast and haze, and also what is none of these: colors that change with the direction
    of view, which it takes from the Gaussians; `weight` holds it back.  `gain` generalizes better.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})
    columns: ClassVar[tuple[str, ...]] = tuple(f"{y}_{c}" for y in ("red", "green", "blue") for c in "rgb1")
    fitted_to_a_channel: ClassVar[int] = 4

    type: Literal["affine"] = "affine"
    weight: Annotated[float, Field(ge=0)] = 1e-2
    """Factor of the loss that pulls the matrix of the photograph of a step to that of no change: the sum of the squared
    differences, without the constants."""

    def matrix(self, row: Floats) -> Floats:
        return IDENTITY + row.reshape(3, 4)

    def gradient(self, row: Floats, by_matrix: Floats) -> Floats:
        return by_matrix.ravel()

    def of_gains(self, log_gains: Floats) -> Floats:
        return (np.column_stack([np.diag(np.exp(log_gains)), np.zeros(3)]) - IDENTITY).ravel()

    def penalty(self, row: Floats) -> tuple[float, Floats]:
        away = row.reshape(3, 4) * [1, 1, 1, 0]
        return self.weight * float((away**2).sum()), 2 * self.weight * away.ravel()

    def fitted(self, image: Floats, photograph: Floats) -> Floats:
        if len(image) == 0:
            return IDENTITY
        with_one = np.column_stack([image, np.ones(len(image))])
        squares = np.einsum("mi,mj->ij", with_one, with_one)  # no sum depends on threads
        products = np.einsum("mi,mj->ij", with_one, photograph)
        return np.asarray(np.linalg.lstsq(squares, products, rcond=None)[0].T, np.float64)


class Exposure(Appearance):
    """Colors of each photograph, where exposures differ: one matrix for all its pixels."""

    type: Literal["exposure"] = "exposure"
    model: OneOf[ColorModel] = Gain()
    """What a photograph has: `gain`, an exposure and a white balance, or `affine`."""

    @property
    def fit(self) -> ColorModel:
        return self.model

    def create_state(self, run: Run) -> "ExposureState":
        return ExposureState(self, [view.name for view in run.scene.split("train")])


class ColorState(ModuleState):
    """What a training has of the colors of its photographs, of whichever kind."""

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: Appearance, views: Sequence[str]) -> None:
        """views: the names of the training views, by number; one of several sizes has one row."""
        super().__init__()
        self.settings, self.views, self.names = settings, views, tuple(dict.fromkeys(views))
        self.rate: Schedule = 0.0

    def start(self, run: Run) -> None:
        exposures = exposures_of(run)
        self.start_from(exposures.log_gains)
        self.scalars[KNOWN] = float(bool(exposures.log_gains))
        LOG.info("colors of photographs: %s", exposures.text)

    def prepare(self, run: Run, last: int, trained: bool = True) -> None:
        self.rate = self.settings.rate_of(last, len(self.names), self.scalars.get(KNOWN, 1.0) > 0)

    def start_from(self, log_gains: Mapping[str, Floats]) -> None:
        """Set the first numbers.  log_gains: of red, green and blue by view, where known, [3]."""

    @property
    def color_model(self) -> ColorModel:
        return self.settings.fit

    @abstractmethod
    def written(self) -> Written:
        """Return what the run folder gets."""

    def write(self, run: Run) -> None:
        """Write the colors of each training photograph; log a line.  Raises NumericError where they are not finite."""
        found = self.written()
        if wrong := next((view for view, matrix in found.matrices.items() if not np.isfinite(matrix).all()), None):
            raise NumericError(
                f"the colors of {quote(wrong)} are not finite; lower optimize.modules.{self.settings.type}.rate"
            )
        write_text(run.out / VIEW_COLORS, json.dumps(found.facts, indent=1) + "\n")
        for name, array in found.arrays.items():
            with open_atomic(run.out / name) as file:
                np.save(file, array, allow_pickle=False)
        greens = [matrix[1, 1] for matrix in found.matrices.values()]
        LOG.info(
            "colors of %d photographs in %s: green is multiplied by %.2f to %.2f",
            *(len(greens), VIEW_COLORS, min(greens), max(greens)),
        )


class ExposureState(ColorState):
    """The numbers of one matrix for each photograph."""

    settings: Exposure

    @property
    def table(self) -> ViewTable:
        return ViewTable(TABLE, self.names, self.settings.model.columns)

    def can_load(self, scalars: Scalars, tables: Tables) -> bool:
        return self.table.begun(scalars)

    def start_from(self, log_gains: Mapping[str, Floats]) -> None:
        of_gains = self.settings.model.of_gains
        self.table.begin(self.scalars, {view: of_gains(gains) for view, gains in log_gains.items()})

    def after_render(self, step: TrainingStep) -> None:
        if step.view is None:
            return
        row = self.table.row(self.scalars, self.views[step.view])
        penalty, matrix, image = self.settings.model.penalty(row)[0], self.settings.model.matrix(row), step.image
        step.save(self, (image, matrix, []))
        step.image = change_colors(step.workspace, step.camera, image, matrix)
        step.module_losses.append(LossValue("colors", lambda: penalty))

    def backward(self, step: TrainingStep) -> None:
        if kept := step.saved(self):
            image, matrix, waits = kept
            step.gradient, wait = change_back(step.workspace, step.camera, image, matrix, step.gradient)
            waits.append(wait)

    def update(self, step: TrainingStep) -> None:
        if not (kept := step.saved(self)) or step.view is None:
            return
        self.learn(step.view, kept[2][0](), step.number)

    def learn(self, view: int, by_matrix: Floats, step: int) -> None:
        """Change the numbers of a view; by_matrix: derivatives of the losses by its matrix, [3, 4]."""
        row = self.table.row(self.scalars, self.views[view])
        gradient = self.settings.model.gradient(row, by_matrix) + self.settings.model.penalty(row)[1]
        self.table.update(self.scalars, self.views[view], gradient, at_step(self.rate, step))

    def matrix(self, view: int) -> Floats:
        """Return the matrix of a training view by its number, [3, 4]."""
        return self.settings.model.matrix(self.table.row(self.scalars, self.views[view]))

    def written(self) -> Written:
        rows = {view: self.table.row(self.scalars, view) for view in self.table.views}
        matrices = {view: self.settings.model.matrix(row) for view, row in rows.items()}
        model = self.settings.model
        photographs = {
            view: {**dict(zip(model.columns, map(float, row), strict=True)), "matrix": matrices[view].tolist()}
            for view, row in rows.items()
        }
        meaning = f"{MEANING}; matrix: the rows of [E | b]"
        facts = {"meaning": meaning, "type": self.settings.type, "model": model.type, "photographs": photographs}
        return Written(matrices, facts)


def exposures_of(run: Run) -> Exposures:
    """Return what the training photographs show of their exposures, or else what their cameras noted; measured once."""
    views = run.scene.split("train")
    names = tuple(view.name for view in views)
    key = TABLE, names
    if key not in run.cache:

        def read(view: View) -> tuple[NDArray[np.uint8], Mask | None]:
            photograph = run.photographs.get(view)
            return photograph.image(), photograph.counted()

        counted = run.status.counted(views, "photographs", len(views))
        shown = measured(run.scene.tracks, counted, read) if run.scene.tracks else UNKNOWN
        told = len(shown.log_gains) == len(set(names))
        run.cache[key] = shown if told else with_noted(shown, noted(views))
    exposures: Exposures = run.cache[key]
    return exposures


def change_colors(workspace: Workspace, camera: DeviceCamera, image: Array, matrix: Floats) -> Array:
    """Return an image, [3 or 4, rows, stride], with the colors that a matrix [3, 4] makes of its own."""
    found = workspace.array("colored", image.shape)
    workspace.device.program("colors.cl").colors_forward(
        groups=(1, camera.rows), image=image, colored=found, **_arguments(camera, image, matrix)
    )
    return found


def change_back(
    workspace: Workspace, camera: DeviceCamera, image: Array, matrix: Floats, gradient: Array
) -> tuple[Array, Callable[[], Floats]]:
    """Return the gradient by an image from that by what `change_colors` made of it, and a wait for that by the matrix.

    The sums of each row are added in double, in the order of rows.
    """
    found, sums = workspace.array("grad_colored", image.shape), workspace.array("color sums", (SUMS, camera.rows))
    workspace.device.program("colors.cl").colors_backward(
        groups=(1, camera.rows),
        image=image,
        gradient=gradient,
        grad_image=found,
        row_sums=sums,
        **_arguments(camera, image, matrix),
    )
    copied = sums.get_later()
    return found, lambda: np.cumsum(copied(), axis=1, dtype=np.float64)[:, -1].reshape(3, 4)


def _arguments(camera: DeviceCamera, image: Array, matrix: Floats) -> dict[str, Any]:
    values: dict[str, Any] = dict(zip(NAMES, map(float, matrix.ravel()), strict=True))
    return {**values, "channels": image.shape[0], **camera.plane_arguments()}
