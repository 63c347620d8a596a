"""Render views and compute gradients, with NumPy arrays as inputs and outputs."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, wraps
from typing import Any, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.quick import open_verified
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.gaussians.model import Model
from clsplat.metrics.images import to_8_bits
from clsplat.metrics.views import require_finite
from clsplat.nerf.files import FieldModel
from clsplat.opencl.device import Array, Device
from clsplat.opencl.discovery import Schedule
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.render.camera import DeviceCamera, upload_camera
from clsplat.render.painter import Layers, layers
from clsplat.render.rasterizer import Content, Frame, Rasterizer
from clsplat.render.tiles import Sort
from clsplat.scene.view import View, to_color

Method = TypeVar("Method", bound=Callable[..., Any])
Floats = NDArray[np.float32]
Color = float | Sequence[float]
_OPEN_LOCK = threading.Lock()
GEOMETRY = 6  # number of pixel sums for the geometry; the others are for the color (cl_kernels/splat.h)


def open_checked(device: str | Device | None, schedule: Schedule = "auto", sort: Sort = "auto") -> Device:
    """Open a device by name, or the default device, and check it against the reference; return it.

    The check runs once per device, as for a run.  Raises DeviceError if the device computes wrongly.
    """
    return open_verified(default_device(schedule) if device is None else device, schedule, sort)


def default_device(schedule: Schedule = "auto") -> Device:
    """Return the default device, which is opened on first use."""
    with _OPEN_LOCK:  # so that all threads get the same device
        return _open_default(schedule)


@cache
def _open_default(schedule: Schedule) -> Device:
    return Device(schedule=schedule)


@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients of a loss with respect to the parameters before activation, [N, components] float32."""

    means: Floats
    quats: Floats
    log_scales: Floats
    logit_opacity: Floats
    sh_base: Floats
    sh_rest: Floats
    mean2d: Floats  # [N, 2] px⁻¹, with respect to the projected mean
    motion: Floats | None = None  # [N, 5 or more] if the Gaussians move

    def __repr__(self) -> str:
        return f"Gradients(of {len(self.means):,} Gaussians)"


@dataclass(frozen=True, eq=False)
class RenderResult:
    """A rendered view; the caller owns the arrays."""

    image: Floats  # [height, width, 3], with the background
    alpha: Floats  # [height, width] in [0, 1], opacity of each pixel
    depth: Floats | None  # [height, width] scene units, mean depth of each pixel; 0 for empty pixels
    view: View
    background: Floats  # [3]
    model: DeviceModel  # the rendered version, which this reference keeps on the device
    renderer: "Renderer"

    def backward(self, image: Floats | None = None, alpha: Floats | None = None) -> Gradients:
        """Return the gradients of a loss with respect to all parameters.

        image: [height, width, 3] dL/d image; alpha: [height, width] dL/d alpha.  May be called repeatedly, also after
        an update of the renderer: the gradients are those of the rendered model.  Raises ValueError for other shapes.
        """
        return self.renderer.backward(self, image, alpha)

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"RenderResult({width} x {height} px of '{self.view.name}')"

    def png(self) -> bytes:
        """Return the image as an 8-bit PNG file."""
        _, data = cv2.imencode(".png", to_8_bits(self.image)[:, :, ::-1])
        return bytes(data)

    def _repr_png_(self) -> bytes:
        return self.png()


def serialized(method: Method) -> Method:
    """Decorate methods so that one thread at a time runs any of them; the object must have a `_lock`."""

    @wraps(method)
    def locked(self: Any, *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return cast(Method, locked)


class Renderer:
    """Renders a model on a device.

    Threads may share a renderer; it renders one image at a time.  Several renderers can share a device.
    """

    def __init__(self, model: Model, device: str | Device | None = None) -> None:
        """Copy a model to a device, given by name or open; default: `default_device()`.

        Raises DeviceError if there is none, or if it computes wrongly.
        """
        self._lock = threading.RLock()
        self.device = open_checked(device)
        self.rasterizer = Rasterizer(self.device)
        self.update(model)

    @serialized
    def update(self, model: Model) -> None:
        """Use another model, or the same one after its arrays were changed in place."""
        self.model, self._model = model, model.upload(self.device)

    @serialized
    def render(self, view: View, background: Color | None = None, depth: bool = False) -> RenderResult:
        """Render a view, with a moving model at the time of the view.

        background: a color in [0, 1], one number or three; default: the model's sky or color, or else black; depth:
        whether to compute the depth, in another pass.  Raises ValueError for an invalid camera or background, and
        NumericError if a value of the result is not finite.
        """
        view.camera.check()
        camera, color = upload_camera(self.device, view), self._color(background)
        model = self._model if background is None else replace(self._model, sky=None)
        rendered = layers(self.rasterizer, model, camera, self.device.upload(color), depth)
        for values in rendered.arrays:
            require_finite(values, view)
        return RenderResult(rendered.image, rendered.alpha, rendered.depth, view, color, model, self)

    @serialized
    def backward(self, result: RenderResult, image: Floats | None, alpha: Floats | None) -> Gradients:
        """Return the gradients of a loss; see `RenderResult.backward`."""
        camera = upload_camera(self.device, result.view)
        model = result.model
        size = camera.height, camera.width
        sums = np.zeros((0, 0), np.float32)
        if alpha is not None:  # alpha is the second channel of a render of (depth, 1, 0) on black
            planes = np.zeros((*size, 3), np.float32)
            planes[:, :, 1] = _check_shape("alpha", alpha, size)
            frame = self._forward(model, camera, np.zeros(3, np.float32), "depth")
            sums = self._pixel_sums(model, frame, planes).get()[:GEOMETRY]
        frame = self._forward(model, camera, result.background)
        planes = np.zeros((*size, 3), np.float32) if image is None else _check_shape("image", image, (*size, 3))
        pixel_sums = self._pixel_sums(model, frame, planes)
        if alpha is not None:
            both = pixel_sums.get()
            both[:GEOMETRY] += sums
            pixel_sums.set(both)
        gradients = self.rasterizer.gradients(model, frame, pixel_sums)
        arrays = {**{name: gradients[name] for name in model.gaussians.trained}, "mean2d": gradients.mean2d}
        count = model.gaussians.count
        return Gradients(**{name: np.ascontiguousarray(a.get()[:, :count].T) for name, a in arrays.items()})

    def _forward(
        self, model: DeviceModel, camera: DeviceCamera, background: Floats, content: Content = "color"
    ) -> Frame:
        return self.rasterizer.forward(model, camera, self.device.upload(background), content)

    def _pixel_sums(self, model: DeviceModel, frame: Frame, derivative: Floats) -> Array:
        camera = frame.camera
        planes = np.zeros((3, camera.rows, camera.stride), np.float32)
        planes[:, : camera.height, : camera.width] = derivative.transpose(2, 0, 1)
        return self.rasterizer.pixel_sums(model, frame, self.device.upload(planes))

    def _color(self, background: Color | None) -> Floats:
        if background is None:
            background = BACKGROUNDS[self.model.rendering.background or "black"]
        return np.ascontiguousarray(to_color(background), np.float32)


def _check_shape(name: str, derivative: Floats, shape: tuple[int, ...]) -> Floats:
    array = np.asarray(derivative, np.float32)
    if array.shape != shape:
        raise ValueError(f"gradient of {name}: expected the shape of the render, {shape}, got {array.shape}")
    return array


# Rendering of fields.


class FieldRenderer:
    """Renders a field on a device.  Threads may share it; it renders one image at a time."""

    def __init__(self, model: FieldModel, device: str | Device | None = None) -> None:
        """Copy a field to a device, given by name or open; default: `default_device()`.

        Raises DeviceError if there is none, or if it computes wrongly.
        """
        self._lock = threading.RLock()
        self.model, self.device = model, open_checked(device)
        self._field = model.upload(self.device)

    @serialized
    def render(self, view: View, depth: bool = False) -> Layers:
        """Return `image` [height, width, 3] with the field's background, `alpha` and `depth` [height, width].

        depth: whether to compute the mean depth of each pixel, scene units; else it is None.
        Raises ValueError for an invalid camera, and NumericError if a value of the result is not finite.
        """
        view.camera.check()
        rendered = self._field.layers(upload_camera(self.device, view), depth)
        for values in rendered.arrays:
            require_finite(values, view)
        return rendered
