"""The shape of a field: its network, its encodings and its samples, and where the network's parameters lie."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from clsplat.core.settings import Settings
from clsplat.opencl.device import constants

# The shape of a grid of features: its levels, and where their entries lie.

GRID = constants("grid.cl")
FEATURES = int(GRID["GRID_FEATURES"])
FARTHEST = 1e6  # scene units: the square of a depth divided by that of the least is within float32
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
FIRST_MOST = 1e-4  # size of the first numbers at most (Mueller et al. 2022, section 4)


class GridShape(Settings):
    """A grid of features in several resolutions (Mueller et al. 2022): each corner of a cell has 4 numbers, which are
    learned.

    What is finer than a sample counts less (Barron et al. 2023, Zip-NeRF, section 3.1).  Outside of its cube the
    features are zero.
    """

    levels: Annotated[int, Field(ge=1, le=16)] = 8
    """Resolutions, each finer than the one before by the same factor."""
    coarsest: Annotated[int, Field(ge=1, le=4096)] = 16
    """Cells along a side of the cube in the first level."""
    finest: Annotated[int, Field(ge=1, le=4096)] = 256
    """Cells along a side in the last one; where there is one level, that of `coarsest`."""
    entries: Annotated[int, Field(ge=16, le=1 << 22)] = 1 << 17
    """Entries of a level at most, a power of 2; levels with more corners share them by a hash."""
    corner: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] = Field([-1.5, -1.5, -1.5])
    """Corner of the cube with the least coordinates, scene units."""
    side: Annotated[float, Field(ge=1e-6, le=FARTHEST)] = 3.0
    """Side of the cube, scene units."""

    @model_validator(mode="after")
    def _in_order(self) -> "GridShape":
        if self.finest < self.coarsest:
            raise ValueError(f"expected 'finest' from {self.coarsest} on, as 'coarsest' is; it is {self.finest}")
        if self.levels == 1 and self.finest != self.coarsest:
            raise ValueError("expected one number for 'coarsest' and 'finest' of one level, or 2 levels at least")
        if self.entries & (self.entries - 1):
            raise ValueError(f"expected a power of 2 for 'entries'; {self.entries} is none")
        return self

    @property
    def features(self) -> int:
        """Features of a sample."""
        return FEATURES * self.levels

    @property
    def table(self) -> NDArray[np.uint32]:
        """What kernels read of each level, [levels, 4]: cells along a side, first entry, entries, and 1
        where corners share them."""
        growth = (self.finest / self.coarsest) ** (1 / max(1, self.levels - 1))
        found, first = [], 0
        for level in range(self.levels):
            cells = round(self.coarsest * growth**level)
            corners = (cells + 1) ** 3
            own = min(corners, self.entries)
            found.append((cells, first, own, int(corners > own)))
            first += own
        return np.array(found, np.uint32)

    @property
    def learned(self) -> int:
        """Numbers of all levels."""
        return FEATURES * int(self.table[:, 2].sum())


LAYERS = constants("layers.h")
BLOCK, SAMPLES, LINE = (int(LAYERS[name]) for name in ("BLOCK", "SAMPLES", "PARAMETER_LINE"))
COLOR_ROWS = int(constants("composite.cl")["COLOR_ROWS"])
COLORS, DENSITIES = 3, 1  # outputs of the network
LANES_MAX = 16
assert FEATURES == BLOCK  # of a level of a grid: so its rows are whole blocks
Features = Annotated[int, Field(ge=BLOCK, le=1024, multiple_of=BLOCK)]


def in_blocks(count: int) -> int:
    """Return the rows of so many features: a multiple of BLOCK."""
    return -(-count // BLOCK) * BLOCK


@dataclass(frozen=True)
class DenseLayer:
    """A dense layer and the place of its parameters: weights [rows, columns], then biases [columns].

    Rows and columns beyond the inputs and outputs fill blocks: they are zero and stay so.
    """

    name: str
    first: int  # parameter
    inputs: tuple[int, ...]  # rows that are inputs
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
    """A field of Mip-NeRF (Barron et al. 2021): a network, which both levels share, reads positions and directions."""

    near: Annotated[float, Field(ge=1e-6, le=FARTHEST)] = 2.0
    """Depth at which the samples of a ray begin, scene units; 2 for the Blender scenes."""
    far: Annotated[float, Field(gt=0, le=FARTHEST)] = 6.0
    """Depth at which they end, scene units; 6 for the Blender scenes."""
    coarse_samples: Annotated[int, Field(ge=LANES_MAX, le=1024, multiple_of=LANES_MAX)] = 128
    """Samples of a ray in the coarse level."""
    fine_samples: Annotated[int, Field(ge=LANES_MAX, le=1024, multiple_of=LANES_MAX)] = 128
    """Samples of a ray in the fine level, placed by the weights of the coarse one."""
    depth: Annotated[int, Field(ge=1, le=32)] = 8
    """Layers of the trunk."""
    width: Features = 256
    """Outputs of each of them."""
    skip: Annotated[int, Field(ge=0)] | None = 4
    """Layer of the trunk, counted from 0, whose outputs the encoded position joins; without it, none."""
    color_width: Features = 128
    """Outputs of the layer that reads the direction."""
    degrees: Annotated[int, Field(ge=0, le=24)] = 16
    """Frequencies of the position's encoding: 1, 2, 4, …; none where a grid alone is read."""
    grid: GridShape | None = None
    """A grid of features that the network reads with the position's sines, or in their place; without it, none."""
    direction_degrees: Annotated[int, Field(ge=0, le=8)] = 4
    """Frequencies of the direction's encoding."""

    @model_validator(mode="after")
    def _in_order(self) -> "FieldShape":
        if self.far <= self.near:
            raise ValueError(f"expected 'far' beyond 'near', {self.near:g}; it is {self.far:g}")
        if self.skip is not None and self.skip >= self.depth - 1:
            raise ValueError(f"expected 'skip' below {self.depth - 1}, so that a layer follows, or none")
        if not self.degrees and self.grid is None:
            raise ValueError("expected 'degrees' above 0, or a 'grid': else the network reads no position")
        return self

    @property
    def position_parts(self) -> list[int]:
        """Features of the parts of the encoded position, each in whole blocks: grid, sines."""
        return [self.grid_rows, 6 * self.degrees]

    @property
    def grid_rows(self) -> int:
        """Rows of the grid, the first of the encoded position."""
        return self.grid.features if self.grid else 0

    @property
    def position_rows(self) -> int:
        """Rows of the encoded position."""
        return sum(map(in_blocks, self.position_parts))

    @property
    def direction_rows(self) -> int:
        """Rows of the encoded direction."""
        return in_blocks(3 + 6 * self.direction_degrees)

    @property
    def layers(self) -> list[DenseLayer]:
        """The layers in their order: the trunk, density, bottleneck, condition, color."""
        width, position, direction = self.width, self.position_parts, 3 + 6 * self.direction_degrees
        described = [("trunk 0", position, width)]  # the parts of the inputs, each in whole blocks; the outputs
        for i in range(1, self.depth):
            described.append((f"trunk {i}", [width, *position] if i - 1 == self.skip else [width], width))
        described += [("density", [width], DENSITIES), ("bottleneck", [width], width)]
        described += [("condition", [width, direction], self.color_width)]
        described += [("color", [self.color_width], COLORS)]
        found, first = list[DenseLayer](), 0
        for name, parts, outputs in described:
            inputs, rows = list[int](), 0
            for part in parts:
                inputs += range(rows, rows + part)
                rows += in_blocks(part)
            found.append(DenseLayer(name, first, tuple(inputs), rows, outputs, in_blocks(outputs)))
            first = found[-1].end
        return found

    @property
    def of_network(self) -> int:
        """Parameters of all layers, in whole lines; those of the grid follow."""
        return -(-self.layers[-1].end // LINE) * LINE

    @property
    def parameters(self) -> int:
        """Length of the table of parameters, in whole lines."""
        return self.of_network + (-(-self.grid.learned // LINE) * LINE if self.grid else 0)

    @property
    def learned(self) -> int:
        """Parameters that are learned: those that do not fill blocks."""
        of_grid = self.grid.learned if self.grid else 0
        return sum((len(layer.inputs) + 1) * layer.outputs for layer in self.layers) + of_grid

    def first_parameters(self, seed: int) -> NDArray[np.float32]:
        """Return first parameters, [parameters]: weights uniform within the square root of 6 / (inputs + outputs)
        (Glorot and Bengio 2010) and biases of 0, as in the released code; a grid's numbers are nearly 0."""
        random, values = np.random.default_rng([seed, self.learned]), np.zeros(self.parameters, np.float32)
        for layer in self.layers:
            limit = np.sqrt(6 / (len(layer.inputs) + layer.outputs))
            weights = np.zeros((layer.rows, layer.columns), np.float32)
            drawn = random.uniform(-limit, limit, (len(layer.inputs), layer.outputs))
            weights[np.ix_(layer.inputs, range(layer.outputs))] = drawn
            values[layer.first : layer.first_bias] = weights.ravel()
        if self.grid:
            own = values[self.of_network : self.of_network + self.grid.learned]
            own[:] = random.uniform(-FIRST_MOST, FIRST_MOST, len(own))
        return values

    def weights(self, parameters: NDArray[np.floating]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return the weights [inputs, outputs] and biases [outputs] of each layer, without what fills blocks."""
        found = []
        for layer in self.layers:
            table = parameters[layer.first : layer.first_bias].reshape(layer.rows, layer.columns)
            own = table[np.ix_(layer.inputs, range(layer.outputs))]
            biases = parameters[layer.first_bias : layer.first_bias + layer.outputs]
            found.append((own.astype(np.float64), biases.astype(np.float64)))
        return found


def _with_all_keys(value: Any) -> Any:
    """A shape as a file has it.  Raises ValueError where a key is missing: defaults may be others than when it was
    written."""
    written = value if isinstance(value, dict) else {}
    grid = written.get("grid")
    missing = [name for name in FieldShape.model_fields if written and name not in written]
    if isinstance(grid, dict):
        missing += [f"grid.{name}" for name in GridShape.model_fields if name not in grid]
    if missing:
        raise ValueError(f"expected the keys of the field that was trained; it lacks {', '.join(missing)}")
    return value


WrittenShape = Annotated[FieldShape, BeforeValidator(_with_all_keys)]  # in a file
