"""Photographs on the device, 8 bits a channel, and the float planes that losses compare with."""

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Array, Device
from clsplat.render.renderer import DeviceCamera, upload_camera
from clsplat.render.workspace import Workspace
from clsplat.scene.images import load_image
from clsplat.scene.scene import Background, View

BACKGROUNDS: dict[Background, tuple[float, float, float]] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
BUDGET_SHARE = 0.25  # of the device's memory, when no budget is given


@dataclass(frozen=True)
class Target:
    """One photograph and its camera."""

    camera: DeviceCamera
    pixels: Array  # [3, height, width] uint8


Key = tuple[str, float]  # name and scale of a view


class Targets:
    """The photographs of a scene by view, on the device as long as `budget` bytes hold them, else read again.

    Views that are announced are read ahead by a thread; what a view looks like does not depend on who read it.
    """

    def __init__(self, device: Device, background: Background, budget: int | None = None) -> None:
        self.device = device
        self.background_name = background
        self.background_array = device.upload(np.array(BACKGROUNDS[background], np.float32))
        self.budget = int(device.info.memory * BUDGET_SHARE) if budget is None else budget
        self._cameras: dict[Key, DeviceCamera] = {}
        self._targets: dict[Key, Target] = {}  # least recently used first
        self._reading: dict[Key, Future[NDArray[Any]]] = {}
        self._reader: ThreadPoolExecutor | None = None

    def camera(self, view: View) -> DeviceCamera:
        """Return the camera of a view."""
        key = view.name, view.scale
        if key not in self._cameras:
            self._cameras[key] = upload_camera(self.device, view)
        return self._cameras[key]

    def get(self, view: View) -> Target:
        """Return the photograph of a view.  Raises DataError when its file cannot be read."""
        key = view.name, view.scale
        target = self._targets.pop(key, None)
        if target is None:
            reading = self._reading.pop(key, None)
            pixels = reading.result() if reading else self._read(view)
            self._make_room(pixels.nbytes)
            target = Target(self.camera(view), self.device.upload(pixels))
        self._targets[key] = target
        return target

    def announce(self, views: Iterable[View]) -> None:
        """Read ahead what will be asked for next; nothing when it is there already."""
        for view in views:
            key = view.name, view.scale
            if key not in self._targets and key not in self._reading:
                self._reader = self._reader or ThreadPoolExecutor(1, "photographs")
                self._reading[key] = self._reader.submit(self._read, view)

    def _read(self, view: View) -> NDArray[Any]:
        """Pixels [3, height, width] uint8."""
        image = load_image(view, BACKGROUNDS[self.background_name])
        return np.ascontiguousarray(image.transpose(2, 0, 1))

    def _make_room(self, size: int) -> None:
        held = sum(target.pixels.nbytes for target in self._targets.values())
        while self._targets and held + size > self.budget:
            held -= self._targets.pop(next(iter(self._targets))).pixels.nbytes


def unpack(workspace: Workspace, camera: DeviceCamera, pixels: Array, name: str = "target") -> Array:
    """Return 8-bit pixels [3, height, width] as float planes [3, rows, stride], zero outside the image."""
    planes = workspace.array(name, (3, camera.rows, camera.stride))
    workspace.device.program("loss.cl").unpack_target(
        items=(camera.stride, camera.rows, 3),
        pixels=pixels,
        target=planes,
        width=camera.width,
        height=camera.height,
        stride=camera.stride,
    )
    return planes
