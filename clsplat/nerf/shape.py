"""Describe the shape of a field: its network, encodings, samples, and grid, and the layout of its parameters."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from clsplat.core.settings import Settings, in_one_sentence
from clsplat.opencl.device import constants
from clsplat.scene.scene import Scene
from clsplat.scene.viewpoint import BLENDER_DISTANCE, camera_distance

GRID = constants("grid.cl")
FEATURES = int(GRID["GRID_FEATURES"])
MAX_DISTANCE = 1e6  # units of the field: the squared ratio of two depths stays within float32
Coordinate = Annotated[float, Field(ge=-MAX_DISTANCE, le=MAX_DISTANCE)]
UNIT_MAX = 1e15  # largest unit, in scene units, as for values in a dataset; the smallest unit is 1 / UNIT_MAX
UnitLength = Annotated[float, Field(ge=1 / UNIT_MAX, le=UNIT_MAX)]
MAX_INITIAL = 1e-4  # largest initial value of an entry (Müller et al. 2022, section 4)


class GridShape(Settings):
    """A multiresolution hash grid of features (Instant NGP, Müller et al. 2022) with 4 trained features per entry.

    Levels that are finer than a sample are downweighted (Zip-NeRF, Barron et al. 2023, section 3.1).  The features
    are zero outside the grid's cube.
    """

    levels: Annotated[int, Field(ge=1, le=16)] = 8
    """Number of resolutions; each is finer than the one before by the same factor."""
    coarsest: Annotated[int, Field(ge=1, le=4096)] = 16
    """Cells along a side of the cube in the first level."""
    finest: Annotated[int, Field(ge=1, le=4096)] = 256
    """Cells along a side in the last level; with one level, the same as `coarsest`."""
    entries: Annotated[int, Field(ge=16, le=1 << 22)] = 1 << 17
    """Largest number of entries of a level, a power of 2; levels with more grid corners share entries by a hash."""
    corner: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] = Field([-1.5, -1.5, -1.5])
    """Corner of the cube with the smallest coordinates, in units of `unit`."""
    side: Annotated[float, Field(ge=1e-6, le=MAX_DISTANCE)] = 3.0
    """Side of the cube, in units of `unit`."""

    @model_validator(mode="after")
    def _check_levels(self) -> "GridShape":
        if self.finest < self.coarsest:
            raise ValueError(f"'finest' must be at least 'coarsest', {self.coarsest}; got {self.finest}")
        if self.levels == 1 and self.finest != self.coarsest:
            raise ValueError("'coarsest' and 'finest' must be equal with one level; or use at least 2 levels")
        if self.entries & (self.entries - 1):
            raise ValueError(f"'entries' must be a power of 2, got {self.entries}")
        return self

    @property
    def features(self) -> int:
        """Number of features of a sample."""
        return FEATURES * self.levels

    @property
    def table(self) -> NDArray[np.uint32]:
        """The levels for the kernels, [levels, 4]: cells per side, first entry, entries, whether they are hashed."""
        growth = (self.finest / self.coarsest) ** (1 / max(1, self.levels - 1))
        rows, first = [], 0
        for level in range(self.levels):
            cells = round(self.coarsest * growth**level)
            corners = (cells + 1) ** 3
            entries = min(corners, self.entries)
            rows.append((cells, first, entries, int(corners > entries)))
            first += entries
        return np.array(rows, np.uint32)

    @property
    def parameter_count(self) -> int:
        """The number of trained features in all levels."""
        return FEATURES * int(self.table[:, 2].sum())


LAYERS = constants("layers.h")
BLOCK, SAMPLES, LINE = (int(LAYERS[name]) for name in ("BLOCK", "SAMPLES", "PARAMETER_LINE"))
COLOR_ROWS = int(constants("composite.cl")["COLOR_ROWS"])
COLORS, DENSITIES = 3, 1  # outputs of the network
LANES_MAX = 16
assert FEATURES == BLOCK  # so that the rows of a grid's level are whole blocks
Features = Annotated[int, Field(ge=BLOCK, le=1024, multiple_of=BLOCK)]


def round_to_blocks(count: int) -> int:
    """Round a number of features up to a multiple of BLOCK."""
    return -(-count // BLOCK) * BLOCK


@dataclass(frozen=True)
class DenseLayer:
    """A dense layer and the position of its parameters: weights, [rows, columns], then biases, [columns].

    Rows and columns beyond the inputs and outputs are padding, which stays zero.
    """

    name: str
    first: int  # index of its first parameter
    inputs: tuple[int, ...]  # rows that are inputs, not padding
    rows: int
    outputs: int
    columns: int

    @property
    def first_bias(self) -> int:
        return self.first + self.rows * self.columns

    @property
    def end(self) -> int:
        return self.first_bias + self.columns


class FieldShape(Settings):
    """The shape of a Mip-NeRF field (Barron et al. 2021), whose levels share a network of positions and directions."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"unit_auto"})

    unit: Annotated[
        Literal["auto"] | UnitLength,
        in_one_sentence(f"expected 'auto' or a length from {1 / UNIT_MAX:g} to {UNIT_MAX:g}"),
    ] = "auto"
    """The unit of all lengths in the field, in scene units; `auto`: the median distance of the training cameras from
    the point that they look at, divided by 4.03, so that it is 1 for the Blender scenes.  A run writes this length."""
    unit_auto: UnitLength | None = None
    """Written by a run: the length that `auto` chose.  While `unit` equals it, a run on other photos chooses again."""
    near: Annotated[float, Field(ge=1e-6, le=MAX_DISTANCE)] = 2.0
    """Depth at which the samples of a ray start, in units of `unit`; 2 for the Blender scenes."""
    far: Annotated[float, Field(gt=0, le=MAX_DISTANCE)] = 6.0
    """Depth at which the samples of a ray end, in units of `unit`; 6 for the Blender scenes."""
    coarse_samples: Annotated[int, Field(ge=LANES_MAX, le=1024, multiple_of=LANES_MAX)] = 128
    """Samples per ray in the coarse level."""
    fine_samples: Annotated[int, Field(ge=LANES_MAX, le=1024, multiple_of=LANES_MAX)] = 128
    """Samples per ray in the fine level, placed by the weights of the coarse level."""
    depth: Annotated[int, Field(ge=1, le=32)] = 8
    """Number of layers of the trunk."""
    width: Features = 256
    """Outputs of each layer of the trunk."""
    skip: Annotated[int, Field(ge=0)] | None = 4
    """Layer of the trunk, counted from 0, to whose outputs the encoded position is appended; null: none."""
    color_width: Features = 128
    """Outputs of the layer that reads the direction."""
    degrees: Annotated[int, Field(ge=0, le=24)] = 16
    """Number of frequencies 1, 2, 4, … of the position's encoding; 0 if the network reads only a grid."""
    grid: GridShape | None = None
    """A grid of features that the network reads in addition to the encoded position, or instead of it; null: none."""
    direction_degrees: Annotated[int, Field(ge=0, le=8)] = 4
    """Number of frequencies of the direction's encoding."""

    @model_validator(mode="after")
    def _check_consistency(self) -> "FieldShape":
        if self.far <= self.near:
            raise ValueError(f"'far' must be larger than 'near', {self.near:g}; got {self.far:g}")
        if self.skip is not None and self.skip >= self.depth - 1:
            raise ValueError(f"'skip' must be null or less than {self.depth - 1}, so that a layer follows")
        if not self.degrees and self.grid is None:
            raise ValueError("'degrees' must be larger than 0 without a 'grid': the network needs a position as input")
        return self

    def with_unit(self, scene: Scene) -> "FieldShape":
        """Return the shape with the unit that `auto` chooses for a scene, rounded so that all machines agree."""
        if self.unit != "auto":
            return self
        unit = float(f"{camera_distance(scene) / BLENDER_DISTANCE:.3g}")
        return self.model_copy(update={"unit": unit, "unit_auto": unit})

    @property
    def scene_units(self) -> float:
        """The unit of the field, in scene units.  Raises ValueError if it is still 'auto'."""
        if self.unit == "auto":
            raise ValueError("the unit of the field is 'auto'; use FieldShape.with_unit to choose it from a scene")
        return self.unit

    @property
    def position_parts(self) -> list[int]:
        """The numbers of features of the encoded position from the grid and from sines, without padding."""
        return [self.grid_rows, 6 * self.degrees]

    @property
    def grid_rows(self) -> int:
        """The number of rows of the grid's features, which come first in the encoded position."""
        return self.grid.features if self.grid else 0

    @property
    def position_rows(self) -> int:
        """The number of rows of the encoded position."""
        return sum(map(round_to_blocks, self.position_parts))

    @property
    def direction_rows(self) -> int:
        """The number of rows of the encoded direction."""
        return round_to_blocks(3 + 6 * self.direction_degrees)

    @property
    def layers(self) -> list[DenseLayer]:
        """The layers in order: the trunk, density, bottleneck, condition, color."""
        width, position, direction = self.width, self.position_parts, 3 + 6 * self.direction_degrees
        specs = [("trunk 0", position, width)]  # name, sizes of the parts of the inputs, outputs
        for i in range(1, self.depth):
            specs.append((f"trunk {i}", [width, *position] if i - 1 == self.skip else [width], width))
        specs += [("density", [width], DENSITIES), ("bottleneck", [width], width)]
        specs += [("condition", [width, direction], self.color_width), ("color", [self.color_width], COLORS)]
        layers, first = list[DenseLayer](), 0
        for name, parts, outputs in specs:
            inputs, rows = list[int](), 0
            for part in parts:
                inputs += range(rows, rows + part)
                rows += round_to_blocks(part)
            layers.append(DenseLayer(name, first, tuple(inputs), rows, outputs, round_to_blocks(outputs)))
            first = layers[-1].end
        return layers

    @property
    def network_length(self) -> int:
        """The length of the table of all layers' parameters, rounded up to full lines.  The grid's entries follow."""
        return -(-self.layers[-1].end // LINE) * LINE

    @property
    def table_length(self) -> int:
        """The length of the table of parameters, rounded up to full lines."""
        return self.network_length + (-(-self.grid.parameter_count // LINE) * LINE if self.grid else 0)

    @property
    def parameter_count(self) -> int:
        """Number of trained parameters, without padding."""
        grid_count = self.grid.parameter_count if self.grid else 0
        return sum((len(layer.inputs) + 1) * layer.outputs for layer in self.layers) + grid_count

    def initial_parameters(self, seed: int) -> NDArray[np.float32]:
        """Return the initial parameters for a seed, [table_length], as in the released code.

        Weights are uniform within sqrt(6 / (inputs + outputs)) (Glorot and Bengio 2010), biases are 0, and a grid's
        entries are close to 0.
        """
        rng, values = np.random.default_rng([seed, self.parameter_count]), np.zeros(self.table_length, np.float32)
        for layer in self.layers:
            limit = np.sqrt(6 / (len(layer.inputs) + layer.outputs))
            weights = np.zeros((layer.rows, layer.columns), np.float32)
            sample = rng.uniform(-limit, limit, (len(layer.inputs), layer.outputs))
            weights[np.ix_(layer.inputs, range(layer.outputs))] = sample
            values[layer.first : layer.first_bias] = weights.ravel()
        if self.grid:
            entries = values[self.network_length : self.network_length + self.grid.parameter_count]
            entries[:] = rng.uniform(-MAX_INITIAL, MAX_INITIAL, len(entries))
        return values

    def weights(self, parameters: NDArray[np.floating]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return the weights, [inputs, outputs], and biases, [outputs], of each layer, without padding."""
        layers = []
        for layer in self.layers:
            table = parameters[layer.first : layer.first_bias].reshape(layer.rows, layer.columns)
            weights = table[np.ix_(layer.inputs, range(layer.outputs))]
            biases = parameters[layer.first_bias : layer.first_bias + layer.outputs]
            layers.append((weights.astype(np.float64), biases.astype(np.float64)))
        return layers


def _require_all_keys(value: Any) -> Any:
    """Return the keys of a shape from a file; a shape without a unit is in scene units.

    Raises ValueError if another key is missing, since defaults may have changed, or if the unit is not a number.
    """
    data = {"unit": 1.0, "unit_auto": None, **value} if isinstance(value, dict) and value else {}
    grid = data.get("grid")
    missing_names = [name for name in FieldShape.model_fields if data and name not in data]
    if isinstance(grid, dict):
        missing_names += [f"grid.{name}" for name in GridShape.model_fields if name not in grid]
    if missing_names:
        raise ValueError(f"the shape lacks {', '.join(missing_names)}")
    if data.get("unit") == "auto":
        raise ValueError("the shape has the unit 'auto' instead of a number")
    return data or value


WrittenShape = Annotated[FieldShape, BeforeValidator(_require_all_keys)]  # the shape in a file
