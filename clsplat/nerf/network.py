"""Run a network on the device: compute its outputs, and the gradients of its parameters.

Arrays of features are stored in tiles of samples (cl_kernels/layers.h).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from clsplat.nerf.shape import COLOR_ROWS, GRID, LAYERS, SAMPLES, DenseLayer, FieldShape, round_to_blocks
from clsplat.opencl.device import Array, Device
from clsplat.render.workspace import Workspace

BLOCK, CHUNK = int(LAYERS["BLOCK"]), int(LAYERS["CHUNK"])
NO_LIMIT = -float(np.finfo(np.float32).max)  # lower bound of outputs without an activation
RELU = 0.0


@dataclass(frozen=True)
class _Table:
    """Features of samples, [tiles, rows, SAMPLES], and the first row that a layer reads."""

    array: Array
    first: int = 0

    @property
    def rows(self) -> int:
        return self.array.shape[1]


class Network:
    """The network of a field on the device, which processes a number of tiles of samples at a time."""

    def __init__(self, workspace: Workspace, shape: FieldShape) -> None:
        self.workspace, self.shape = workspace, shape
        self._program = workspace.device.program("dense.cl")
        self._columns = SAMPLES // (BLOCK * int(workspace.device.tuning["LANES"]))
        self._layers = shape.layers
        self._first, self._trunk = self._layers[0], self._layers[1 : shape.depth]
        self._density, self._bottleneck, self._condition, self._color = self._layers[shape.depth :]

    def position(self, tiles: int) -> tuple[Array, int]:
        """Return the array that contains the encoded position, [tiles, rows, SAMPLES], and the position's first row."""
        skip, width = self.shape.skip, self.shape.width
        if skip is None:
            return self._table("position", tiles, self.shape.position_rows), 0
        return self._trunk_outputs(skip, tiles), width

    def direction(self, tiles: int) -> tuple[Array, int]:
        """Return the array that contains the encoded direction, and the direction's first row."""
        rows = self.shape.width + self.shape.direction_rows
        return self._table("direction", tiles, rows), self.shape.width

    def forward(self, parameters: Array, tiles: int) -> tuple[Array, Array]:
        """Return raw colors and raw densities, each [tiles, COLOR_ROWS, SAMPLES], for the encodings in the tables.

        They are valid until the next call.
        """
        x = _Table(*self.position(tiles))
        for i, layer in enumerate([self._first, *self._trunk]):
            outputs = self._trunk_outputs(i, tiles)
            self._apply(layer, parameters, x, outputs, RELU)
            x = _Table(outputs)
        densities = self._table("densities", tiles, COLOR_ROWS)
        colors = self._table("colors", tiles, COLOR_ROWS)
        direction, color_input = self.direction(tiles)[0], self._table("conditioned", tiles, self.shape.color_width)
        self._apply(self._density, parameters, x, densities, NO_LIMIT)
        self._apply(self._bottleneck, parameters, x, direction, NO_LIMIT)
        self._apply(self._condition, parameters, _Table(direction), color_input, RELU)
        self._apply(self._color, parameters, _Table(color_input), colors, NO_LIMIT)
        return colors, densities

    def backward(self, parameters: Array, grad_colors: Array, grad_densities: Array, gradient: Array) -> Array:
        """Add the gradient of the parameters to `gradient`, [P], from the gradients of the outputs of the last
        `forward`.

        Returns the gradient of the grid's features, [tiles, grid_rows, SAMPLES], valid until the next call.
        """
        tiles, width = grad_colors.shape[0], self.shape.width
        last, direction = _Table(self._trunk_outputs(self.shape.depth - 1, tiles)), _Table(self.direction(tiles)[0])
        color_input = _Table(self._table("conditioned", tiles, self.shape.color_width))
        grad_color_input = self._table("grad_conditioned", tiles, self.shape.color_width)
        grad_direction, grad_x = self._table("grad_direction", tiles, width), self._table("grad_hidden", tiles, width)
        self._sum(self._color, color_input, grad_colors)
        self._differentiate(self._color, parameters, grad_colors, color_input, grad_color_input, RELU)
        self._sum(self._condition, direction, grad_color_input)
        self._differentiate(self._condition, parameters, grad_color_input, direction, grad_direction, NO_LIMIT)
        self._sum(self._density, last, grad_densities)
        self._sum(self._bottleneck, last, grad_direction)
        self._differentiate(self._density, parameters, grad_densities, last, grad_x, NO_LIMIT)
        self._differentiate(self._bottleneck, parameters, grad_direction, last, grad_x, RELU, add=1)
        for i in range(len(self._trunk), 0, -1):
            inputs, layer = _Table(self._trunk_outputs(i - 1, tiles)), self._trunk[i - 1]
            self._sum(layer, inputs, grad_x)
            if i - 1 == self.shape.skip:
                self._grid_gradient(layer, parameters, grad_x, self.shape.width, add=0)
            grad_inputs = self._table(f"grad_hidden {i % 2}", tiles, width)
            self._differentiate(layer, parameters, grad_x, inputs, grad_inputs, RELU)
            grad_x = grad_inputs
        self._sum(self._first, _Table(*self.position(tiles)), grad_x)
        grad_grid = self._grid_gradient(self._first, parameters, grad_x, 0, add=int(self.shape.skip is not None))
        count = self.shape.network_length
        self._program.dense_sums(
            items=count // int(self.workspace.device.tuning["LANES"]),
            partials=self._partials(tiles),
            gradient=gradient,
            chunks=-(-tiles // CHUNK),
            count=count,
        )
        return grad_grid

    def _grid_gradient(self, layer: DenseLayer, parameters: Array, grad_outputs: Array, row: int, add: int) -> Array:
        """Compute the gradient of the grid's features, which are a layer's inputs from `row` on."""
        tiles = grad_outputs.shape[0]
        position, grad_grid = _Table(*self.position(tiles)), self._table("grad_grid", tiles, self.shape.grid_rows)
        self._differentiate(layer, parameters, grad_outputs, position, grad_grid, NO_LIMIT, add, row)
        return grad_grid

    def _trunk_outputs(self, i: int, tiles: int) -> Array:
        """Return the outputs of layer i of the trunk, with room for the encoded position if it is appended there."""
        extra_rows = self.shape.position_rows if i == self.shape.skip else 0
        return self._table(f"hidden {i}", tiles, self.shape.width + extra_rows)

    def _table(self, name: str, tiles: int, rows: int) -> Array:
        return self.workspace.array(f"field {name}", (tiles, rows, SAMPLES))

    def _partials(self, tiles: int) -> Array:
        """Return the array of partial sums, [chunks, network_length].  The padding is zero."""
        return self.workspace.array("field partials", (-(-tiles // CHUNK), self.shape.network_length))

    def _apply(self, layer: DenseLayer, parameters: Array, inputs: _Table, outputs: Array, lower_bound: float) -> None:
        tiles = outputs.shape[0]
        count = tiles * self._columns * (layer.columns // BLOCK)
        self._program.dense_forward(
            items=count,
            inputs=inputs.array,
            parameters=parameters,
            outputs=outputs,
            first_parameter=layer.first,
            input_rows=inputs.rows,
            first_input=inputs.first,
            input_count=layer.rows,
            output_rows=outputs.shape[1],
            output_count=layer.columns,
            lower_bound=lower_bound,
            count=count,
        )

    def _differentiate(
        self,
        layer: DenseLayer,
        parameters: Array,
        grad_outputs: Array,
        inputs: _Table,
        grad_inputs: Array,
        lower_bound: float,
        add: int = 0,
        row: int = 0,
    ) -> None:
        """Compute the gradient of a layer's inputs, starting with input `row`.  add: 1 to add to `grad_inputs`."""
        tiles, grad_rows, output_rows = *grad_inputs.shape[:2], grad_outputs.shape[1]
        count = tiles * self._columns * (grad_rows // BLOCK)
        self._program.dense_backward(
            items=count,
            grad_outputs=grad_outputs,
            parameters=parameters,
            inputs=inputs.array,
            grad_inputs=grad_inputs,
            first_parameter=layer.first + row * layer.columns,
            input_rows=inputs.rows,
            first_input=inputs.first,
            derived_count=grad_rows,
            output_rows=output_rows,
            output_count=layer.columns,
            lower_bound=lower_bound,
            accumulate=add,
            count=count,
        )

    def _sum(self, layer: DenseLayer, inputs: _Table, grad_outputs: Array) -> None:
        """Write the partial sums of the gradient of a layer's parameters."""
        tiles, output_rows = grad_outputs.shape[:2]
        chunks = -(-tiles // CHUNK)
        count = chunks * (layer.rows // BLOCK) * (layer.columns // BLOCK)
        arguments: dict[str, Any] = {
            "grad_outputs": grad_outputs,
            "partials": self._partials(tiles),
            "parameter_count": self.shape.network_length,
            "output_rows": output_rows,
            "output_count": layer.columns,
            "tiles": tiles,
        }
        self._program.dense_weights(
            items=count,
            inputs=inputs.array,
            first_parameter=layer.first,
            input_rows=inputs.rows,
            first_input=inputs.first,
            input_count=layer.rows,
            count=count,
            **arguments,
        )
        biases = chunks * layer.columns
        self._program.dense_biases(items=biases, first_parameter=layer.first_bias, count=biases, **arguments)


# The encodings of samples that the network reads, and the gradient of the grid.

PLACE_ROWS = int(GRID["PLACE_ROWS"])
PARTS_PER_UNIT = 64  # parts of all levels together, per compute unit of a GPU


@dataclass(frozen=True)
class Samples:
    """Samples along the cones of rays."""

    cones: Array  # [rays, RAY_VALUES]
    edges: Array  # [rays, samples + 1]

    @property
    def samples_per_ray(self) -> int:
        return self.edges.shape[1] - 1

    @property
    def count(self) -> int:
        return self.edges.shape[0] * self.samples_per_ray

    @property
    def tile_count(self) -> int:
        return self.count // SAMPLES


class Encoding:
    """The encodings of samples, which are written to the tables that the network reads."""

    def __init__(self, workspace: Workspace, shape: FieldShape, network: Network) -> None:
        self.workspace, self.shape, self.network = workspace, shape, network
        device = workspace.device
        self._program, self._grid = device.program("encode.cl"), device.program("grid.cl")
        self._lanes = int(device.tuning["LANES"])
        self._levels = device.upload(shape.grid.table) if shape.grid else None
        self.parts = parts_per_level(device, shape.grid.levels) if shape.grid else 0

    def forward(self, parameters: Array, samples: Samples) -> None:
        """Write the encoded positions and directions of samples."""
        if self.shape.grid:
            self._locate(samples)
            self.read_grid(parameters, samples.tile_count)
        shape, (features, first) = self.shape, self.network.position(samples.tile_count)
        arguments: dict[str, Any] = {
            "items": samples.count // self._lanes,
            "cones": samples.cones,
            "samples": samples.samples_per_ray,
            "count": samples.count,
        }
        if shape.degrees:
            self._program.encode_frustums(
                edges=samples.edges,
                features=features,
                rows=features.shape[1],
                first_row=first + shape.grid_rows,
                degrees=shape.degrees,
                written=round_to_blocks(6 * shape.degrees),
                **arguments,
            )
        features, first = self.network.direction(samples.tile_count)
        self._program.encode_directions(
            features=features,
            rows=features.shape[1],
            first_row=first,
            degrees=shape.direction_degrees,
            written=shape.direction_rows,
            **arguments,
        )

    def backward(self, grad_position: Array, gradient: Array) -> None:
        """Add the gradient of the grid's entries to `gradient`, [P].

        grad_position: [tiles, grid_rows, SAMPLES], gradient of the grid's features at the last `forward`'s samples.
        """
        if not self.shape.grid:
            return
        tiles, rows = grad_position.shape[:2]
        count = self.shape.grid.levels * self.parts
        self._grid.grid_backward(
            groups=-(-count // int(self.workspace.device.tuning["TEAM"])),
            places=self.grid_positions(tiles),
            levels=self._levels,
            grad_features=grad_position,
            gradient=gradient,
            first_parameter=self.shape.network_length,
            rows=rows,
            parts=self.parts,
            samples=tiles * SAMPLES,
            count=count,
        )

    def grid_positions(self, tiles: int) -> Array:
        """Return the positions of samples in the grid's cube, [tiles, PLACE_ROWS, SAMPLES], which `forward` writes."""
        return self.workspace.array("field places", (tiles, PLACE_ROWS, SAMPLES))

    def read_grid(self, parameters: Array, tiles: int) -> None:
        """Write the features of the grid at the positions of samples."""
        grid, (features, first) = self.shape.grid, self.network.position(tiles)
        assert grid is not None
        count = grid.levels * tiles * SAMPLES // self._lanes
        self._grid.grid_forward(
            items=count,
            places=self.grid_positions(tiles),
            levels=self._levels,
            parameters=parameters,
            features=features,
            first_parameter=self.shape.network_length,
            rows=features.shape[1],
            first_row=first,
            samples=tiles * SAMPLES,
            count=count,
        )

    def _locate(self, samples: Samples) -> None:
        """Write the positions of samples relative to the grid's cube."""
        grid = self.shape.grid
        assert grid is not None
        x, y, z = grid.corner
        self._grid.grid_places(
            items=samples.count // self._lanes,
            cones=samples.cones,
            edges=samples.edges,
            places=self.grid_positions(samples.tile_count),
            corner_x=x,
            corner_y=y,
            corner_z=z,
            side=grid.side,
            samples=samples.samples_per_ray,
            count=samples.count,
        )


def parts_per_level(device: Device, levels: int) -> int:
    """Return the number of parts in which the entries of each level are summed; the sums do not depend on it.

    Each part reads all samples, so a CPU uses only enough parts to keep its cores busy.
    """
    parts = 2 * device.info.units if int(device.tuning["TEAM"]) == 1 else PARTS_PER_UNIT * device.info.units
    return max(1, parts // levels)
