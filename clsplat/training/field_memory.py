"""The memory that the training of a field needs on the device, computed before it is allocated."""

from dataclasses import dataclass

from clsplat.errors import MemoryLimitError
from clsplat.fields.encoding import PLACE_ROWS
from clsplat.fields.levels import rays_at_a_time
from clsplat.fields.network import CHUNK
from clsplat.fields.shape import COLOUR_ROWS, SAMPLES, FieldShape
from clsplat.training.memory import Limits

TABLES = 4  # of the length of the parameters: these, Adam's moments, and the gradient
MIB = 2**20


@dataclass(frozen=True)
class FieldPlan:
    """Bytes on the device."""

    parameters: int  # one table of them
    features: int  # of the samples that are computed at a time, with derivatives
    partials: int  # sums of chunks of samples, for each parameter of the network
    photographs: int

    @property
    def needed(self) -> int:
        """Bytes in all."""
        return TABLES * self.parameters + self.features + self.partials + self.photographs

    def text(self, limits: Limits) -> str:
        """Return one line: the memory needed, and that of the device."""
        return (
            f"memory: {self.needed / MIB:,.0f} MiB for a field ({TABLES} tables of {self.parameters / MIB:,.0f} MiB, "
            f"samples {(self.features + self.partials) / MIB:,.0f} MiB, photographs {self.photographs / MIB:,.0f} MiB) "
            f"in {limits.memory / MIB:,.0f} MiB with buffers up to {limits.allocation / MIB:,.0f} MiB"
        )

    def check(self, limits: Limits) -> None:
        """Raise MemoryLimitError where it does not fit."""
        if self.needed > limits.memory or max(self.parameters, self.partials) > limits.allocation:
            raise MemoryLimitError(
                f"{self.text(limits)}: take fewer levels or entries of the grid (train_field.field.grid), a smaller "
                "train_field.field.width, or fewer samples"
            )


def field_plan(shape: FieldShape, photographs: int) -> FieldPlan:
    """Return the plan for a field.  photographs: their bytes on the device."""
    samples = rays_at_a_time(shape) * max(shape.coarse_samples, shape.fine_samples)
    hidden = (shape.depth + 3) * shape.width  # outputs of the trunk, and derivatives by three layers
    encoded = shape.position_rows + shape.grid_rows + PLACE_ROWS + shape.direction_rows
    rows = hidden + encoded + shape.width + 2 * shape.colour_width + 4 * COLOUR_ROWS
    chunks = -(-samples // (SAMPLES * CHUNK))
    return FieldPlan(4 * shape.parameters, 4 * rows * samples, 4 * chunks * shape.of_network, photographs)
