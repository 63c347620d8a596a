"""The memory in which the harmonics of a training lie, and how a pipeline file names it."""

from typing import ClassVar, Literal

from clsplat.settings import Settings
from clsplat.training.memory import Where


class HarmonicsMemory(Settings):
    """Memory of the harmonics above band 0 and of Adam's moments of them, in training."""

    @property
    def in_use(self) -> Where:
        """The memory, once it is chosen."""
        raise NotImplementedError


class DeviceHarmonics(HarmonicsMemory):
    """In the memory of the device."""

    type: Literal["device"] = "device"

    @property
    def in_use(self) -> Where:
        return "device"


class HostHarmonics(HarmonicsMemory):
    """In the memory of the host.

    Each step sends those of its view to the device and fetches them; what other views see is updated later
    (`optimize.update: deferred`).
    """

    type: Literal["host"] = "host"

    @property
    def in_use(self) -> Where:
        return "host"


class PlannedHarmonics(HarmonicsMemory):
    """In the memory of the host where the device does not hold the training by its plan, else in that of the device.

    The plan is that of the Gaussians that a training begins with, and of `densify.max_gaussians`; it is chosen once,
    before the first step.  They lie on the device, too, where its memory is the host's, and where a stage needs all of
    them there, as `add_to_average` does.
    """

    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "reason"})

    type: Literal["auto"] = "auto"
    chosen: Where | None = None
    """Written by a run: where they lie."""
    reason: str = ""
    """Written by a run: why."""

    @property
    def in_use(self) -> Where:
        return self.chosen or "device"
