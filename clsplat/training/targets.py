"""Photographs on the device, 8 bits a channel, and the float planes that losses compare with."""

from dataclasses import dataclass

import numpy as np

from clsplat.opencl.device import Array, Device
from clsplat.render.renderer import DeviceCamera, upload_camera
from clsplat.render.workspace import Workspace
from clsplat.scene.images import load_image
from clsplat.scene.scene import Background, View

BACKGROUNDS: dict[Background, tuple[float, float, float]] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class Target:
    """One photograph and its camera."""

    camera: DeviceCamera
    pixels: Array  # [3, height, width] uint8


class Targets:
    """The photographs of a scene by view, loaded when first asked for."""

    def __init__(self, device: Device, background: Background) -> None:
        self.device = device
        self.background_name = background
        self.background_array = device.upload(np.array(BACKGROUNDS[background], np.float32))
        self._cameras: dict[tuple[str, float], DeviceCamera] = {}  # by name and scale of the view
        self._targets: dict[tuple[str, float], Target] = {}

    def camera(self, view: View) -> DeviceCamera:
        """Return the camera of a view."""
        key = view.name, view.scale
        if key not in self._cameras:
            self._cameras[key] = upload_camera(self.device, view)
        return self._cameras[key]

    def get(self, view: View) -> Target:
        """Return the photograph of a view.  Raises DataError when its file cannot be read."""
        key = view.name, view.scale
        if key not in self._targets:
            image = load_image(view, BACKGROUNDS[self.background_name])
            pixels = self.device.upload(np.ascontiguousarray(image.transpose(2, 0, 1)))
            self._targets[key] = Target(self.camera(view), pixels)
        return self._targets[key]


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
