"""Plan the launches of a part of a step: bind kernels and arguments once, and then only enqueue them.

A part is code that only launches kernels.  Its key determines all launches and arguments, except for arguments
that change from step to step and are given by name.  The first run with a key allocates what the part needs, the
second one records its launches, and later ones replay them.
"""

import weakref
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from clsplat.core.errors import KernelError
from clsplat.opencl import runtimes
from clsplat.opencl.device import Array, Buffer, Device, Kernel

runtimes.prepare()
import pyopencl as cl  # noqa: E402

T = TypeVar("T")
MAX_PLANS = 128  # upper bound; an edit or another image size needs new plans


@dataclass
class Launch:
    """One launch of a plan."""

    source: Kernel
    kernel: Any  # pyopencl kernel; no other launch sets its arguments
    size: tuple[int, ...]
    group: tuple[int, ...]
    arguments: list[Any]  # numbers, and weak references to buffers, so that a plan keeps no memory alive


class Plan:
    """The launches of a part, in order.  changes: the arguments that may change, by name."""

    def __init__(self, device: Device, changes: Mapping[str, Any]) -> None:
        self.launches: list[Launch] = []
        self.is_replayable = True  # False if the part also copied or allocated memory
        self.result: Any = None
        self._device = device
        self._values = {name: _identity(value) for name, value in changes.items()}
        self._uses: dict[str, list[tuple[Launch, int]]] = {name: [] for name in changes}

    def add(self, source: Kernel, size: tuple[int, ...], group: tuple[int, ...], arguments: list[Any]) -> Any:
        """Add a launch with checked arguments; return its kernel, whose arguments are set."""
        kernel = source.take()
        kernel.set_args(*arguments)
        references = [weakref.ref(value) if isinstance(value, Buffer) else value for value in arguments]
        launch = Launch(source, kernel, size, group, references)
        self.launches.append(launch)
        for index, argument in enumerate(source.arguments):
            if argument.name in self._uses:
                value = arguments[index]
                if _identity(value) != self._values[argument.name]:
                    raise KernelError(f"{source.label}: the plan expects another value of {argument.name}")
                self._uses[argument.name].append((launch, index))
        return kernel

    def bind(self, changes: Mapping[str, Any]) -> None:
        """Set the arguments that changed since the last replay.  Raises KernelError for other names or types."""
        if changes.keys() != self._values.keys():
            raise KernelError(f"the plan expects values of {', '.join(self._values)}; got {', '.join(changes)}")
        changed_launches = {}
        for name, value in changes.items():
            identity, current = _identity(value), self._values[name]
            if identity is current or (identity and identity == current):  # 0.0 equals -0.0
                continue
            self._values[name] = identity
            for launch, index in self._uses[name]:
                argument = launch.source.arguments[index]
                if argument.is_pointer != isinstance(value, Array) or (
                    argument.is_pointer and argument.dtype not in (None, value.dtype)
                ):
                    raise KernelError(f"{launch.source.label}: {name} is a {type(value).__name__} of the wrong type")
                if argument.is_pointer:
                    launch.arguments[index] = weakref.ref(value.buffer)
                    launch.kernel.set_arg(index, value.buffer)
                else:
                    launch.arguments[index] = value
                    changed_launches[id(launch)] = launch
        for launch in changed_launches.values():  # pyopencl sets all of them faster than a single number
            launch.kernel.set_args(*(value() if type(value) is weakref.ref else value for value in launch.arguments))

    def enqueue(self) -> None:
        """Enqueue all launches."""
        queue, timings, enqueue, launch = self._device.queue, self._device.timings, cl.enqueue_nd_range_kernel, None
        try:
            for launch in self.launches:
                event = enqueue(queue, launch.kernel, launch.size, launch.group)
                if timings.sampling:
                    timings.add(launch.source.label, event)
        except cl.Error:
            with self._device.raising_errors(launch.source.label if launch else "work in progress"):
                raise

    def release(self) -> None:
        """Release the kernels for use in later plans, because some runtimes take 0.2 ms to create one."""
        for launch in self.launches:
            launch.source.spare_kernels.append(launch.kernel)
        self.launches = []


def _identity(value: Any) -> Any:
    """Return what identifies an argument: a number, or the serial number of a buffer."""
    if isinstance(value, Array):
        return value.buffer.serial
    return value.serial if isinstance(value, Buffer) else value


class Plans:
    """The plans of the parts of a step, by key.  Each thread needs its own `Plans`."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._plans: dict[Hashable, Plan | None] = {}  # None: the part ran once

    def clear(self) -> None:
        """Forget all plans."""
        for plan in filter(None, self._plans.values()):
            plan.release()
        self._plans.clear()

    def run(self, key: Hashable, changes: Mapping[str, Any], launch: Callable[..., T], *inputs: Any) -> T:
        """Return the result of `launch(*inputs)`, or replay its launches and return the result of the recorded run.

        key: identifies the part; it must contain all numbers, and the serial numbers of all buffers, that its launches
        and its result depend on.  changes: kernel arguments, by name, that may differ from run to run.
        """
        if self._device.recording.plan is not None:  # inside a part that is being recorded
            return launch(*inputs)
        plan = self._plans.get(key)
        if plan is not None:
            plan.bind(changes)
            plan.enqueue()
            result: T = plan.result
            return result
        if key not in self._plans:
            result = launch(*inputs)
            if len(self._plans) >= MAX_PLANS:
                self.clear()
            self._plans[key] = None
            return result
        del self._plans[key]
        plan = self.record(changes, launch, *inputs)
        result = plan.result
        if plan.is_replayable:
            self._plans[key] = plan
        else:
            plan.release()
        return result

    def record(self, changes: Mapping[str, Any], launch: Callable[..., Any], *inputs: Any) -> Plan:
        """Run a part, and return a plan that replays its launches."""
        plan = self._device.recording.plan = Plan(self._device, changes)
        try:
            plan.result = launch(*inputs)
        finally:
            self._device.recording.plan = None
        return plan
