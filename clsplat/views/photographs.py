"""Photographs on the device, 8 bits a channel, and the float planes that losses compare with."""

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Array, Device
from clsplat.render.rasterizer import DeviceCamera, upload_camera
from clsplat.render.workspace import Workspace
from clsplat.scene.photographs import load_photograph
from clsplat.scene.scene import Background, View

Mask = NDArray[np.bool_]
BACKGROUNDS: dict[Background, tuple[float, float, float]] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
BUDGET_SHARE = 0.25  # of the device's memory, when no budget is given


@dataclass(frozen=True)
class Photograph:
    """One photograph and its camera."""

    camera: DeviceCamera
    pixels: Array  # [3, height, width] uint8, with a fourth plane of 0 and 1 where a mask says what counts

    @property
    def masked(self) -> bool:
        return bool(self.pixels.shape[0] == 4)

    def image(self) -> NDArray[np.uint8]:
        """The colours on the host, [height, width, 3]."""
        return np.asarray(self.pixels.get()[:3].transpose(1, 2, 0))

    def mask(self) -> Mask | None:
        """Which pixels count, [height, width], or None where all do."""
        return np.asarray(self.pixels.get()[3] > 0) if self.masked else None


Key = tuple[str, float]  # name and downscale of a view


class Photographs:
    """The photographs of a scene by view, on the device as long as `budget` bytes hold them, else read again.

    Views that are announced are read ahead by a thread; what a view looks like does not depend on who read it.
    """

    def __init__(
        self, device: Device, background: Background, budget: int | None = None, straightened: Path | None = None
    ) -> None:
        self.device = device
        self.straightened = straightened  # folder that keeps photographs of distorting lenses
        self.background_name = background
        self.background_array = device.upload(np.array(BACKGROUNDS[background], np.float32))
        self.budget = int(device.info.memory * BUDGET_SHARE) if budget is None else budget
        self._cameras: dict[Key, DeviceCamera] = {}
        self._targets: dict[Key, Photograph] = {}  # least recently used first
        self._reading: dict[Key, Future[NDArray[Any]]] = {}
        self._reader: ThreadPoolExecutor | None = None

    def fresh(self) -> "Photographs":
        """Return the same with nothing held, for views that are wanted once."""
        return Photographs(self.device, self.background_name, straightened=self.straightened)

    def camera(self, view: View) -> DeviceCamera:
        """Return the camera of a view."""
        key = view.name, view.downscale
        if key not in self._cameras:
            self._cameras[key] = upload_camera(self.device, view)
        return self._cameras[key]

    def get(self, view: View) -> Photograph:
        """Return the photograph of a view.  Raises DataError when its file cannot be read."""
        key = view.name, view.downscale
        target = self._targets.pop(key, None)
        if target is None:
            reading = self._reading.pop(key, None)
            pixels = reading.result() if reading else self._read(view)
            self._make_room(pixels.nbytes)
            target = Photograph(self.camera(view), self.device.upload(pixels))
        self._targets[key] = target
        return target

    def announce(self, views: Iterable[View]) -> None:
        """Read ahead what will be asked for next; nothing when it is there already."""
        for view in views:
            key = view.name, view.downscale
            if key not in self._targets and key not in self._reading:
                self._reader = self._reader or ThreadPoolExecutor(1, "photographs")
                self._reading[key] = self._reader.submit(self._read, view)

    def _read(self, view: View) -> NDArray[Any]:
        """Pixels [3 or 4, height, width] uint8."""
        image = load_photograph(view, BACKGROUNDS[self.background_name], self.straightened)
        return np.ascontiguousarray(image.transpose(2, 0, 1))

    def _make_room(self, size: int) -> None:
        held = sum(target.pixels.nbytes for target in self._targets.values())
        while self._targets and held + size > self.budget:
            held -= self._targets.pop(next(iter(self._targets))).pixels.nbytes


def unpack(workspace: Workspace, camera: DeviceCamera, pixels: Array, name: str = "target") -> Array:
    """Return 8-bit pixels [C, height, width] as float planes [C, rows, stride], zero outside the image.

    The first three are colours by 255; a fourth, the mask, stays 0 and 1.
    """
    channels = pixels.shape[0]
    planes = workspace.array(name, (channels, camera.rows, camera.stride))
    workspace.device.program("loss.cl").unpack_target(
        items=(camera.stride, camera.rows, channels),
        pixels=pixels,
        target=planes,
        width=camera.width,
        height=camera.height,
        stride=camera.stride,
    )
    return planes


def cover(workspace: Workspace, camera: DeviceCamera, planes: Array, target: Array) -> None:
    """Set `planes` [3, rows, stride] to zero where the fourth plane of `target` [4, rows, stride] is."""
    workspace.device.program("loss.cl").apply_mask(
        items=(camera.rows * camera.stride, 3), planes=planes, target=target, pixels=camera.rows * camera.stride
    )
