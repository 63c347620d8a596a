"""A runtime that refuses memory or a call ends the command with the matching exit code."""

import re

import numpy as np
import pyopencl as cl
import pytest

from clsplat.core.errors import DeviceError, MemoryLimitError, as_clsplat_error
from clsplat.opencl import device as device_module
from clsplat.opencl.device import Device

NUMBERS = np.arange(8, dtype=np.float32)
CALLS = {
    "get": ("enqueue_copy", lambda device, array: array.get()),
    "get_item": ("enqueue_copy", lambda device, array: array.get_item(3)),
    "set": ("enqueue_copy", lambda device, array: array.set(NUMBERS)),
    "fill": ("enqueue_nd_range_kernel", lambda device, array: array.fill(1.0)),
    "context": ("Context", lambda device, array: Device(device.info, device.schedule)),
    "queues": ("CommandQueue", lambda device, array: Device(device.info, device.schedule)),
    "another queue": ("enqueue_marker", lambda device, array: array.get()),
}


FAULTS = (cl.MemoryError, MemoryLimitError, 5), (cl.RuntimeError, DeviceError, 4)


@pytest.mark.parametrize(
    ("name", "error", "expected", "code"), [(name, *FAULTS[i % 2]) for i, name in enumerate(CALLS)]
)
def test_refused_call_has_the_exit_code_of_its_cause(name, error, expected, code, info, monkeypatch):
    def refuse(*arguments, **values):
        raise error("the runtime refuses")

    function, call = CALLS[name]
    device = Device(info)
    array = device.upload(NUMBERS)
    device.timings.sampling = name == "another queue"
    monkeypatch.setattr(device_module, "create_context", device_module.create_context.__wrapped__)  # a new one
    monkeypatch.setattr(device_module.cl, function, refuse)
    with pytest.raises(expected, match=f"{re.escape(device.info.name)}.*the runtime refuses") as raised:
        call(device, array)
    assert as_clsplat_error(raised.value).exit_code == code


@pytest.mark.parametrize(("error", "expected"), [(cl.MemoryError, MemoryLimitError), (cl.RuntimeError, DeviceError)])
def test_failure_while_waiting_is_a_device_error(error, expected, info):
    class Refusing:
        """A queue, or the event of a launch, whose work fails after it was taken."""

        def wait(self):
            raise error("the runtime refuses")

        finish = wait

    device = Device(info)
    device._queues[False] = Refusing()
    with pytest.raises(expected, match=re.escape(info.name)):
        device.finish()
    device.timings.sampling = True
    device.timings.add("fill.cl:fill_words", Refusing())
    with pytest.raises(expected, match="fill_words"):
        device.timings.take()
