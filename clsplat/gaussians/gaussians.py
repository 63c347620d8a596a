"""Store Gaussians on the device as a struct of arrays, with a single operation that changes their number.

Each table is [components, capacity] on the device and [N, components] on the host.  Parameters, Adam's moments, and
statistics are all tables, so that their rows always move together.

    means [3] scene units · quats [4] (w, x, y, z), unnormalized · log_scales [3] log of scene units
    logit_opacity [1] · sh_base [3] band 0 · sh_rest [(K-1)*3] the other bands, coefficient-major
    filter_variance [1] scene units², the world filter; zero if there is none, never optimized
    motion [W] of moving Gaussians (clsplat/formats/splats.py); absent in static models
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError
from clsplat.formats.splats import MOTION, PARAMETERS, columns_to_sh_degree, sh_coefficients
from clsplat.gaussians.sh_offload import HostTables, slot_defines
from clsplat.gaussians.sky import DeviceSky
from clsplat.gaussians.structs import HARMONICS, DeferredUpdates, GaussianTables, check_rows, moment_tables
from clsplat.opencl.device import Array, Device

# Detection of NaN and infinity.


def find_nonfinite(gaussians: GaussianTables) -> list[str]:
    """Return the names of parameters that contain NaN or infinity, in their values or in their Adam moments."""
    device, names = gaussians.device, set()
    counters = {name: device.zeros(1, np.uint32) for name in gaussians.trained}
    for name, counter in counters.items():
        for table in gaussians.tables.keys() & {name, *moment_tables(name)}:
            if gaussians.on_host and table in gaussians.on_host:
                names |= set() if np.isfinite(gaussians.get(table)).all() else {name}
                continue
            device.program("check.cl").count_not_finite(
                items=(gaussians.count, gaussians.tables[table].components),
                values=gaussians[table],
                counter=counter,
                stride=gaussians.capacity,
                count=gaussians.count,
            )
    return [name for name, counter in counters.items() if name in names or counter.get_item(0) > 0]


# Dropout of Gaussians in a training step.


@dataclass(frozen=True)
class DropoutMask:
    """The Gaussians that a training step drops at random, each with a probability below 1.

    The random numbers depend only on seed, step, and row.
    """

    probability: float
    seed: int
    step: int  # global

    @property
    def opacity_factor(self) -> float:
        """The factor on the remaining opacities that preserves their mean (DropGaussian, Park et al. 2025)."""
        return 1 / (1 - self.probability)


HIDDEN = "hidden"  # which training views hide a Gaussian
INTERVAL2 = "sampling_interval2"  # scene units², smallest over training views; exists only if needed
ALIGNMENT = 64  # capacity is a multiple of this, so that wide kernels need no tail
GROWTH = 1.125  # factor on the capacity; small, since every edit copies all tables anyway


@dataclass
class Table:
    """An array of one quantity for all Gaussians, [components, capacity]."""

    array: Array
    components: int
    zero_fresh: bool  # rows of new Gaussians start at zero instead of copying their source


_serial = attrgetter("array.buffer.serial")


class Gaussians:
    """The tables of N Gaussians on a device."""

    def __init__(self, device: Device, parameters: Mapping[str, NDArray[np.float32]]) -> None:
        """Upload `parameters`, [N, components] by name: all PARAMETERS, and optionally filter_variance and motion."""
        self.device = device
        self.count = len(parameters["means"])
        self.capacity = _align(self.count)
        self.sh_degree = columns_to_sh_degree(parameters["sh_rest"].shape[1])
        self.tables: dict[str, Table] = {}
        self.deferred: DeferredUpdates | None = None  # deferred Adam updates
        self.on_host: HostTables | None = None  # tables in host memory
        self.no_slot = device.zeros(1, np.uint32)
        for name in PARAMETERS:
            self.add(name, parameters[name].shape[1])
            self.set(name, parameters[name])
        self.add("filter_variance", 1)
        for name in ("filter_variance", INTERVAL2, MOTION):
            if name in parameters:
                self.add(name, parameters[name].shape[1])
                self.set(name, parameters[name])
        self._gather = device.program("gather.cl")

    def __getitem__(self, name: str) -> Array:
        if self.on_host and name in self.on_host:
            raise ConfigError(f"{name} is in host memory; set `rasterizer.harmonics: device`")
        return self._current_table(name).array

    def _current_table(self, name: str) -> Table:
        """Apply the deferred updates of a table, and return it."""
        if self.deferred and name in self.deferred.names:
            self.deferred.flush()
        return self.tables[name]

    @property
    def key(self) -> tuple[int, ...]:
        """Numbers that identify the memory and the sizes of all tables; the keys of plans contain them."""
        slots = (self.on_host.slot.buffer.serial, self.on_host.block_size) if self.on_host else ()
        return (self.count, self.capacity, *slots, *map(_serial, self.tables.values()))

    @property
    def components(self) -> dict[str, int]:
        """The number of components of each table, by name."""
        return {name: table.components for name, table in self.tables.items()}

    def add(self, name: str, components: int, zero_fresh: bool = False) -> None:
        """Add a table of zeros."""
        if self.on_host and name in HARMONICS:
            array = self.on_host.add(name, components)
        else:
            array = self.device.zeros((components, self.capacity))
        self.tables[name] = Table(array, components, zero_fresh)

    def move_to_host(self) -> None:
        """Move the SH bands above 0 and their moments to the host; the device stores only those visible in a view."""
        if self.on_host:
            return
        harmonics = {name: self.get(name) for name in HARMONICS if name in self.tables}
        self.on_host = HostTables(self)
        for name, values in harmonics.items():
            self.add(name, values.shape[1], self.tables[name].zero_fresh)
            self.set(name, values)

    def get(self, name: str) -> NDArray[np.float32]:
        """Copy a table to the host, [N, components]."""
        table = self._current_table(name)
        if self.on_host and name in self.on_host:
            return self.on_host.get(name)
        planes = table.array.get()
        return np.ascontiguousarray(planes[:, : self.count].T)

    def set(self, name: str, values: NDArray[Any]) -> None:
        """Copy values, [N, components], from the host into a table."""
        table = self._current_table(name)
        if values.shape != (self.count, table.components):
            raise ValueError(f"{name}: expected {(self.count, table.components)}, got {values.shape}")
        if self.on_host and name in self.on_host:
            self.on_host.set(name, values)
            return
        planes = np.zeros((table.components, self.capacity), np.float32)
        planes[:, : self.count] = values.T
        table.array.set(planes)

    def set_rows(self, name: str, rows: NDArray[np.integer], values: NDArray[Any]) -> None:
        """Write values, [n, components], from the host into some rows of a table.

        rows: [n] integers, see `check_rows`.  Raises ValueError for invalid rows or shapes.
        """
        table, rows = self._current_table(name), check_rows(rows, self.count)
        if values.shape != (len(rows), table.components):
            raise ValueError(f"{name}: expected the shape {(len(rows), table.components)}, got {values.shape}")
        if self.on_host and name in self.on_host:
            self.on_host.set_rows(name, rows, values)
            return
        self._gather.set_rows(
            items=(len(rows), table.components),
            rows=self.device.upload(rows),
            values=self.device.upload(np.ascontiguousarray(values, np.float32)),
            table=table.array,
            components=table.components,
            stride=self.capacity,
            count=len(rows),
        )

    def zero_rows(self, names: Collection[str], rows: NDArray[np.integer]) -> None:
        """Set some rows of tables to zero.

        rows: [n] integers, see `check_rows`.  Raises ValueError for invalid rows.
        """
        device_rows = self.device.upload(check_rows(rows, self.count))
        for name in names:
            table = self._current_table(name)
            if self.on_host and name in self.on_host:
                self.on_host.set_rows(name, rows, np.zeros((len(rows), table.components), np.float32))
                continue
            self._gather.zero_rows(
                items=(len(rows), table.components),
                rows=device_rows,
                table=table.array,
                stride=self.capacity,
                count=len(rows),
            )

    def lower_sh_degree(self, degree: int) -> None:
        """Drop the SH bands above `degree` and their moments, if there are any."""
        if degree >= self.sh_degree:
            return
        self.sh_degree, components = degree, 3 * (sh_coefficients(degree) - 1)
        for name in self.tables.keys() & set(HARMONICS):
            lower_bands = self.get(name)[:, :components]
            self.add(name, components, self.tables[name].zero_fresh)
            self.set(name, lower_bands)

    @property
    def trained(self) -> tuple[str, ...]:
        """The names of the trained tables: the parameters, and the motion if there is one."""
        return (*PARAMETERS, *([MOTION] if self.is_moving else []))

    @property
    def is_moving(self) -> bool:
        """Whether the Gaussians move over time."""
        return MOTION in self.tables

    @property
    def zero_fresh(self) -> list[str]:
        """The names of the tables that are zero in new rows."""
        return [name for name, table in self.tables.items() if table.zero_fresh]

    def find_nonfinite(self) -> list[str]:
        """Return the names of parameters that contain NaN or infinity, in their values or in their Adam moments."""
        return find_nonfinite(self)

    def rearrange(self, source: Array, fresh: Array, count: int) -> None:
        """Replace row i of every table with its row source[i]; set moments and statistics of fresh rows to zero.

        source, fresh: [count] uint32; fresh is 1 for new rows.  No other operation changes the number of Gaussians.
        """
        capacity = self.capacity
        self._current_table("sh_rest")
        if count > capacity:
            row_bytes = max(table.components for table in self.tables.values()) * np.dtype(np.float32).itemsize
            grown_capacity = min(int(self.capacity * GROWTH), self.device.info.allocation // row_bytes - ALIGNMENT)
            capacity = _align(max(count, grown_capacity))
        host_tables = self.on_host.rearrange(source.get()[:count], fresh.get()[:count]) if self.on_host else {}
        for table in (table for name, table in self.tables.items() if name not in host_tables):
            array = self.device.zeros((table.components, capacity))
            self._gather.gather_rows(
                items=(count, table.components),
                table=table.array,
                source=source,
                fresh=fresh,
                moved=array,
                zero_fresh=int(table.zero_fresh),
                table_stride=self.capacity,
                moved_stride=capacity,
                count=count,
            )
            table.array = array
        self.count, self.capacity = count, capacity
        for name, values in host_tables.items():
            self.set(name, values)


@dataclass
class DeviceModel:
    """Gaussians on the device and their rendering parameters."""

    gaussians: Gaussians
    degree: int  # active SH degree
    near: float = 0.2  # scene units
    screen_variance: float = 0.3  # px²
    compensate: float = 0.0  # 1: the screen filter reduces opacities to conserve energy
    pixel_box: float = 0.0  # 1: splats are integrated over the pixel's box instead
    dropout: DropoutMask | None = None  # of this training step
    sky: DeviceSky | None = None  # behind the Gaussians, instead of a background color

    @property
    def key(self) -> tuple[float, ...]:
        """Numbers that identify the model, except for its dropout and its sky; the keys of plans contain them."""
        screen_filter = self.screen_variance, self.compensate, self.pixel_box
        return (self.degree, self.near, *screen_filter, *self.gaussians.key)

    @property
    def defines(self) -> dict[str, int]:
        """The macros for kernels that project, list, and blend these splats."""
        return ({"PIXEL_BOX": 1} if self.pixel_box else {}) | slot_defines(self.gaussians)


def _align(count: int) -> int:
    return max(ALIGNMENT, -(-count // ALIGNMENT) * ALIGNMENT)


# Gaussians that a render omits: those hidden in a training view, and those dropped in a step.

HIDDEN_VIEWS = 22  # bits per component; to_VI in lanes.h converts such integers exactly


def hide(gaussians: Gaussians, hidden: NDArray[np.bool_]) -> None:
    """Write the mask of the Gaussians that each training view hides, [V, N], into the table HIDDEN.

    View v has bit v % HIDDEN_VIEWS of component v // HIDDEN_VIEWS.
    """
    views, count = hidden.shape
    bits = np.zeros((count, -(-views // HIDDEN_VIEWS)), np.float32)  # integers
    for view in range(views):
        plane, bit = divmod(view, HIDDEN_VIEWS)
        bits[:, plane] += hidden[view] * np.float32(1 << bit)
    if HIDDEN not in gaussians.tables:
        gaussians.add(HIDDEN, bits.shape[1])
    gaussians.set(HIDDEN, bits)


def visibility_arguments(model: DeviceModel, view: int | None, mask: Array) -> dict[str, Any]:
    """Return the kernel arguments with which project_forward omits hidden and dropped Gaussians.

    view: the index of a training view with hidden Gaussians; mask: [S], overwritten if the model has a dropout mask.
    """
    hidden = _hidden_arguments(model.gaussians, view)
    if model.dropout is None:
        return {**hidden, "opacity_factor": 1.0}
    gaussians, dropout = model.gaussians, model.dropout
    gaussians.device.program("dropout.cl").draw_left_out(
        items=gaussians.count,
        **hidden,
        left_out=mask,
        below=round(dropout.probability * 2**32),
        seed=dropout.seed,
        step=dropout.step,
        stride=gaussians.capacity,
        count=gaussians.count,
    )
    return {"hidden": mask, "hidden_plane": 0, "hidden_bit": 1, "opacity_factor": dropout.opacity_factor}


def _hidden_arguments(gaussians: Gaussians, view: int | None) -> dict[str, Any]:
    if view is None or HIDDEN not in gaussians.tables:
        any_table = gaussians["filter_variance"]  # its bits are masked out
        return {"hidden": any_table, "hidden_plane": 0, "hidden_bit": 0}
    plane, bit = divmod(view, HIDDEN_VIEWS)
    return {"hidden": gaussians[HIDDEN], "hidden_plane": plane, "hidden_bit": 1 << bit}
