"""What the parts of a Gaussians struct know of each other."""

from typing import Any, ClassVar, Protocol

from numpy.typing import NDArray

from clsplat.opencl.device import Array, Device


class Waiting(Protocol):
    """Updates that rows wait for, as `Deferred` does them."""

    names: ClassVar[tuple[str, ...]]
    updates: int

    def catch_up(self, depth_key: Array) -> None:
        """Do what waits for the rows that a view sees."""

    def flush(self) -> None:
        """Do what waits for all rows."""

    def before(self, degree: int) -> None:
        """Make room for an update of the bands up to a degree."""

    def note(self, depth_key: Array, factors: tuple[float, float]) -> None:
        """Note an update that the rows that a view sees have had."""


class Struct(Protocol):
    """The part of `Gaussians` that its own parts use."""

    device: Device
    count: int
    capacity: int
    no_slot: Array
    tables: dict[str, Any]

    @property
    def trained(self) -> tuple[str, ...]:
        """The names of what training changes."""

    @property
    def on_host(self) -> Any:
        """The tables that lie on the host, `OnHost`, or None."""

    def __getitem__(self, name: str) -> Array: ...

    def get(self, name: str) -> NDArray[Any]:
        """Copy a table to the host."""
