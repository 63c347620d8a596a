"""What the network of a field reads of samples, and derivatives by the numbers of its grid, on the device."""

from dataclasses import dataclass
from typing import Any

from clsplat.fields.grid import GRID
from clsplat.fields.network import Network
from clsplat.fields.shape import SAMPLES, FieldShape, in_blocks
from clsplat.opencl.device import Array, Device
from clsplat.render.workspace import Workspace

PLACE_ROWS = int(GRID["PLACE_ROWS"])
PARTS = 64  # of all levels together, for each unit of a GPU


@dataclass(frozen=True)
class Samples:
    """Rays, cut into samples."""

    cones: Array  # [rays, RAY_VALUES]
    edges: Array  # [rays, samples + 1]

    @property
    def of_ray(self) -> int:
        return self.edges.shape[1] - 1

    @property
    def count(self) -> int:
        return self.edges.shape[0] * self.of_ray

    @property
    def tiles(self) -> int:
        return self.count // SAMPLES


class Encoding:
    """Puts the encodings of samples where the network reads them."""

    def __init__(self, workspace: Workspace, shape: FieldShape, network: Network) -> None:
        self.workspace, self.shape, self.network = workspace, shape, network
        device = workspace.device
        self._program, self._grid = device.program("encode.cl"), device.program("grid.cl")
        self._lanes = int(device.tuning["LANES"])
        self._levels = device.upload(shape.grid.table) if shape.grid else None
        self.parts = parts_of_levels(device, shape.grid.levels) if shape.grid else 0

    def forward(self, parameters: Array, samples: Samples) -> None:
        """Write the encoded positions and directions."""
        if self.shape.grid:
            self._place(samples)
            self.read_grid(parameters, samples.tiles)
        shape, (features, first) = self.shape, self.network.position(samples.tiles)
        shared: dict[str, Any] = {
            "items": samples.count // self._lanes,
            "cones": samples.cones,
            "samples": samples.of_ray,
            "count": samples.count,
        }
        if shape.degrees:
            self._program.encode_frustums(
                edges=samples.edges,
                features=features,
                rows=features.shape[1],
                first_row=first + shape.grid_rows,
                degrees=shape.degrees,
                written=in_blocks(6 * shape.degrees),
                **shared,
            )
        features, first = self.network.seen(samples.tiles)
        self._program.encode_directions(
            features=features,
            rows=features.shape[1],
            first_row=first,
            degrees=shape.direction_degrees,
            written=shape.direction_rows,
            **shared,
        )

    def backward(self, by_position: Array, gradient: Array) -> None:
        """Add the derivatives by the grid's numbers to `gradient`, [P].

        by_position: those by its features of the samples of the last `forward`, [tiles, grid_rows, SAMPLES].
        """
        if not self.shape.grid:
            return
        tiles, rows = by_position.shape[:2]
        count = self.shape.grid.levels * self.parts
        self._grid.grid_backward(
            groups=-(-count // int(self.workspace.device.tuning["TEAM"])),
            places=self.places(tiles),
            levels=self._levels,
            by_features=by_position,
            gradient=gradient,
            first_parameter=self.shape.of_network,
            rows=rows,
            parts=self.parts,
            samples=tiles * SAMPLES,
            count=count,
        )

    def places(self, tiles: int) -> Array:
        """Return the places of samples in the grid's cube, [tiles, PLACE_ROWS, SAMPLES], until the next `forward`."""
        return self.workspace.array("field places", (tiles, PLACE_ROWS, SAMPLES))

    def read_grid(self, parameters: Array, tiles: int) -> None:
        """Write the features of the grid at the places of samples."""
        grid, (features, first) = self.shape.grid, self.network.position(tiles)
        assert grid is not None
        count = grid.levels * tiles * SAMPLES // self._lanes
        self._grid.grid_forward(
            items=count,
            places=self.places(tiles),
            levels=self._levels,
            parameters=parameters,
            features=features,
            first_parameter=self.shape.of_network,
            rows=features.shape[1],
            first_row=first,
            samples=tiles * SAMPLES,
            count=count,
        )

    def _place(self, samples: Samples) -> None:
        """Write the places of samples."""
        grid = self.shape.grid
        assert grid is not None
        x, y, z = grid.corner
        self._grid.grid_places(
            items=samples.count // self._lanes,
            cones=samples.cones,
            edges=samples.edges,
            places=self.places(samples.tiles),
            corner_x=x,
            corner_y=y,
            corner_z=z,
            side=grid.side,
            samples=samples.of_ray,
            count=samples.count,
        )


def parts_of_levels(device: Device, levels: int) -> int:
    """Return in how many parts the entries of each level are summed: their sums do not depend on it.

    Each part looks through all samples: so on a CPU they are as few as keep its cores busy.
    """
    wanted = 2 * device.info.units if int(device.tuning["TEAM"]) == 1 else PARTS * device.info.units
    return max(1, wanted // levels)
