"""A field while it is trained: the losses of a step's rays, Adam, and its tables in a checkpoint."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from clsplat.errors import DataError
from clsplat.fields.field import Field
from clsplat.fields.levels import Draw, Target
from clsplat.fields.shape import FieldShape, WrittenShape
from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.render.camera import DeviceCamera
from clsplat.training.trained_field import Tables, TrainedField
from clsplat.views.photographs import Photograph

TABLES = ("parameters", "moment1", "moment2")
CHANNELS = 3
_WRITTEN: TypeAdapter[FieldShape] = TypeAdapter(WrittenShape)


@dataclass(frozen=True)
class Shown:
    """A photograph of a step, on the device, and the rays that are drawn from it."""

    camera: DeviceCamera
    photograph: Photograph
    rays: int
    weight: float  # of each ray: the area of what it stands for, px^2 of the full size


@dataclass(frozen=True)
class AdamStep:
    """How far an update by Adam goes."""

    rate: float
    epsilon: float = 1e-8  # added to the root of the second moment: the default of Adam's paper, which Mip-NeRF keeps


class LearnedField(TrainedField):
    """A field with Adam's moments, in tables that a checkpoint holds."""

    kind = "nerf"

    def __init__(self, field: Field) -> None:
        self.field = field
        device, count = field.parameters.device, field.shape.parameters
        self._arrays = dict(zip(TABLES, (field.parameters, device.zeros(count), device.zeros(count)), strict=True))
        self._gradient = device.zeros(count)
        self._program = device.program("dense.cl")
        self._beta1, self._beta2 = constants("adam.h")["BETA1"], constants("adam.h")["BETA2"]
        self.updates = 0  # which count for the bias of the moments
        self.rate = 0.0  # of the last step
        self._scales: list[tuple[int, float]] = []  # of the last step: rays, and what a squared difference counts

    @classmethod
    def first(cls, shape: FieldShape, seed: int, background: Array) -> "LearnedField":
        """Return a field before its first step."""
        return cls(Field.first(shape, seed, background))

    @classmethod
    def of_tables(cls, shape: Mapping[str, Any], tables: Mapping[str, NDArray[np.float32]], background: Array) -> Self:
        """Return the field of a checkpoint, by what `tables` has returned."""
        own = _shape_of(shape)
        found = cls(Field(own, background.device.zeros(own.parameters), background))
        for name, array in found._arrays.items():
            array.set(tables[name][:, 0])
        return found

    @classmethod
    def check_tables(cls, shape: Mapping[str, Any], tables: Tables, others: Tables) -> None:
        """Raise DataError for tables that are not those of a field of a shape."""
        if others:
            raise DataError(f"it holds {next(iter(others))} beside a field")
        if tables.keys() != set(TABLES):
            raise DataError(f"its field has not the tables {', '.join(TABLES)}")
        parameters = _shape_of(shape).parameters
        for name, table in tables.items():
            if table.dtype != np.float32 or table.shape != (parameters, 1):
                raise DataError(f"{name} of its field is not [{parameters}, 1] of float32")
            if not np.isfinite(table).all():
                raise DataError(f"{name} of its field holds values that are not finite")

    @property
    def painter(self) -> Field:
        """What renders views of it."""
        return self.field

    @property
    def parameters(self) -> int:
        """The number of parameters that are learned."""
        return self.field.shape.learned

    def shape_as_data(self) -> dict[str, Any]:
        """Return its shape as JSON holds it."""
        return self.field.shape.model_dump()

    def tables(self) -> Tables:
        """Copy its tables to the host, each [P, 1]."""
        return {name: array.get()[:, None] for name, array in self._arrays.items()}

    def not_finite(self) -> list[str]:
        """Return the names of the tables that hold NaN or infinity."""
        device, count = self._gradient.device, self.field.shape.parameters
        counters = {name: device.zeros(1, np.uint32) for name in self._arrays}
        for name, array in self._arrays.items():
            device.program("check.cl").count_not_finite(
                items=(count, 1), values=array, counter=counters[name], stride=count, count=count
            )
        return [name for name, counter in counters.items() if counter.get_item(0) > 0]

    def step(self, shown: Sequence[Shown], coarse_weight: float, adam: AdamStep, seed: int, step: int) -> None:
        """Do one update (Barron et al. 2021, section 3.3).

        The loss is that of the fine level and `coarse_weight` of that of the coarse one; each is the mean squared
        difference of the rays, weighted by what they stand for.
        """
        whole = CHANNELS * sum(one.rays * one.weight for one in shown)
        self.rate = adam.rate
        self._gradient.fill(0)
        errors = self._errors(sum(one.rays for one in shown))
        self._scales, first = [(one.rays, one.weight / whole) for one in shown], 0
        for one in shown:
            self._differentiate(one, one.weight / whole, coarse_weight, Draw(seed, step, first), errors)
            first += one.rays
        self.updates += 1
        self.update(self._gradient, adam, self.updates)

    def update(self, gradient: Array, adam: AdamStep, number: int) -> None:
        """Change the parameters by Adam, for the update `number`, from a gradient, [P]."""
        self._program.dense_update(
            items=self.field.shape.parameters // int(self._gradient.device.tuning["LANES"]),
            parameters=self.field.parameters,
            moment1=self._arrays["moment1"],
            moment2=self._arrays["moment2"],
            gradient=gradient,
            rate=adam.rate / (1 - self._beta1**number),
            correction2=1 / (1 - self._beta2**number),
            epsilon=adam.epsilon,
            count=self.field.shape.parameters,
        )

    def loss(self, coarse_weight: float) -> tuple[float, float]:
        """Read the loss of the last step, and the mean squared difference of its fine level."""
        coarse, fine = (
            sum(
                scale * float(part.sum(dtype=np.float64))
                for (_, scale), part in zip(self._scales, self._parts(array.get()), strict=True)
            )
            for array in self._errors(sum(rays for rays, _ in self._scales))
        )
        return fine + coarse_weight * coarse, fine

    def _parts(self, errors: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        return np.split(errors, np.cumsum([rays for rays, _ in self._scales])[:-1])

    def _errors(self, rays: int) -> list[Array]:
        """Squared differences of the rays of a step, coarse and fine."""
        return [self.field.workspace.array(f"field {name} errors", rays) for name in ("coarse", "fine")]

    def _differentiate(self, shown: Shown, scale: float, coarse_weight: float, draw: Draw, errors: list[Array]) -> None:
        """Add the derivatives by the rays of one photograph, in passes."""
        levels = self.field.levels
        colours = shown.photograph.planes(self.field.workspace).colours
        scales = coarse_weight * scale, scale
        for first in range(0, shown.rays, levels.rays_at_a_time):
            own = Draw(draw.seed, draw.step, draw.first + first)
            rays = levels.drawn(shown.camera, own, min(levels.rays_at_a_time, shown.rays - first))
            rendered = levels.render(self.field.parameters, rays)
            for level, of_level, squares in zip(rendered, scales, errors, strict=True):
                target = Target(colours, of_level, squares)
                levels.differentiate(self.field.parameters, level, target, self._gradient)


def _shape_of(written: Mapping[str, Any]) -> FieldShape:
    """The shape of a field in a checkpoint.  Raises DataError where it is none."""
    try:
        return _WRITTEN.validate_json(json.dumps(written))
    except ValidationError as error:
        raise DataError(f"the shape of its field: {error.errors()[0]['msg']}") from None
