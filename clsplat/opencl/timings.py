"""The time of kernels on the device."""

from collections import defaultdict
from typing import Any

from clsplat.opencl.refusals import refusals


class Timings:
    """Times of kernels on the device, from profiling events, while `sampling` is True.

    Events are dropped as soon as they are read: some drivers slow down when many are alive.
    """

    def __init__(self, device_name: str) -> None:
        self.device_name = device_name
        self.sampling = False
        self.section = "other"  # part of a training step, for kernels that `profile.STAGES` does not list
        self._events: list[tuple[str, str, Any]] = []

    def add(self, name: str, event: Any) -> None:
        if self.sampling:
            self._events.append((name, self.section, event))

    def take(self) -> dict[tuple[str, str], list[float]]:
        """Return the seconds of every launch by kernel and section since the last call; waits for the launches.

        Raises MemoryLimitError or DeviceError where one has failed.
        """
        seconds: dict[tuple[str, str], list[float]] = defaultdict(list)
        for name, section, event in self._events:
            with refusals(name, self.device_name):
                event.wait()
                seconds[name, section].append((event.profile.end - event.profile.start) * 1e-9)
        self._events.clear()
        return seconds
