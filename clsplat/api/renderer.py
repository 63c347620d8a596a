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
from clsplat.render.painter import Layers, render_layers
from clsplat.render.rasterizer import Content, Frame, Rasterizer, pose_gradient
from clsplat.render.tiles import Sort
from clsplat.scene.view import View, to_color
from clsplat.viewer.video.frames import depth_normals

Method = TypeVar("Method", bound=Callable[..., Any])
Floats = NDArray[np.float32]
Color = float | Sequence[float]
_OPEN_LOCK = threading.Lock()
GEOMETRY_SUMS = 6  # number of pixel sums for the geometry; those for the color follow (cl_kernels/splat.h)


def open_checked(device: str | Device | None, schedule: Schedule = "auto", sort: Sort = "auto") -> Device:
    """Open a device by name, or the default device, check it against the reference, and return it.

    The check runs once per device, as it does for a run.  Raises DeviceError if the results of the device are wrong.
    """
    return open_verified(default_device(schedule) if device is None else device, schedule, sort)


def default_device(schedule: Schedule = "auto") -> Device:
    """Return the default device, which the first call opens."""
    with _OPEN_LOCK:  # all threads must get the same device
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
    rotation: NDArray[np.float64]  # [3] rad⁻¹; camera coordinates p become exp([rotation]x) p + translation
    translation: NDArray[np.float64]  # [3] 1 / scene units, in camera axes
    log_focal: float  # with respect to the logarithm of a factor that scales both focal lengths
    motion: Floats | None = None  # [N, 5 or more] for a dynamic model

    def __repr__(self) -> str:
        return f"Gradients(of {len(self.means):,} Gaussians)"


@dataclass(frozen=True, eq=False)
class RenderResult:
    """A rendered view.  The caller may change the arrays."""

    image: Floats  # [height, width, 3], over the background
    alpha: Floats  # [height, width] in [0, 1], opacity of each pixel
    depth: Floats | None  # [height, width] scene units, mean depth of each pixel; 0 where alpha is 0
    median_depth: Floats | None  # [height, width] scene units, where transmittance falls below ½; 0 if it stays above
    view: View
    background: Floats  # [3]
    model: DeviceModel  # the rendered model, which stays on the device as long as this result exists
    renderer: "Renderer"

    def backward(
        self, image: Floats | None = None, alpha: Floats | None = None, depth: Floats | None = None
    ) -> Gradients:
        """Return the gradients of a loss with respect to all parameters and the camera's pose and focal length.

        image: dL/d image, [height, width, 3]
        alpha: dL/d alpha, [height, width]
        depth: dL/d depth, [height, width] in 1 / scene units; it is ignored where alpha is 0

        This method can be called repeatedly, even after `Renderer.update`: the gradients are always those of the
        rendered model.  Raises ValueError for arrays of the wrong shape, and for `depth` if the model is dynamic; use a
        renderer of `model.at(time)` instead.
        """
        return self.renderer.backward(self, image, alpha, depth)

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"RenderResult({width} x {height} px of '{self.view.name}')"

    def normals(self) -> Floats:
        """Return unit normals from the mean depth, [height, width, 3], in scene axes; 0 where they are unknown.

        Raises ValueError for a view that was rendered without depth.
        """
        if self.depth is None:
            raise ValueError("normals: expected a view rendered with depth=True")
        return depth_normals(self.depth, self.view)

    def png(self) -> bytes:
        """Return the image as an 8-bit PNG file."""
        _, data = cv2.imencode(".png", to_8_bits(self.image)[:, :, ::-1])
        return bytes(data)

    def _repr_png_(self) -> bytes:
        return self.png()


def serialized(method: Method) -> Method:
    """Decorate methods so that only one thread at a time runs any of them; the object must have a `_lock`."""

    @wraps(method)
    def call(self: Any, *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return cast(Method, call)


class Renderer:
    """Renders a model on a device.

    Threads may share a renderer, which renders one image at a time.  Several renderers can share a device.
    """

    def __init__(self, model: Model, device: str | Device | None = None) -> None:
        """Copy a model to `device`: an open Device, or part of a name; default: `default_device()`.

        Raises DeviceError if no device is found, or if its results are wrong.
        """
        self._lock = threading.RLock()
        self.device = open_checked(device)
        self.rasterizer = Rasterizer(self.device)
        self.update(model)

    @serialized
    def update(self, model: Model) -> None:
        """Replace the model, or upload the same model again after its arrays were changed in place."""
        self.model, self._model = model, model.upload(self.device)

    @serialized
    def render(self, view: View, background: Color | None = None, depth: bool = False) -> RenderResult:
        """Render a view.  A dynamic model is rendered at the time of the view.

        background: a color in [0, 1], as one number or three; default: the model's sky or background, or black
        depth: also render the mean and the median depth, which requires a second pass

        Raises ValueError for an invalid camera or background, and NumericError if a value of the result is not finite.
        """
        view.camera.check()
        camera, color = upload_camera(self.device, view), self._color(background)
        model = self._model if background is None else replace(self._model, sky=None)
        layers = render_layers(self.rasterizer, model, camera, self.device.upload(color), depth)
        for values in layers.arrays:
            require_finite(values, view)
        depths = layers.depth, layers.median_depth
        return RenderResult(layers.image, layers.alpha, *depths, view, color, model, self)

    def render_batch(
        self, views: Sequence[View], background: Color | None = None, depth: bool = False
    ) -> list[RenderResult]:
        """Render views one after another; their sizes may differ.  The other arguments are those of `render`."""
        return [self.render(view, background, depth) for view in views]

    @serialized
    def backward(
        self, result: RenderResult, image: Floats | None, alpha: Floats | None, depth: Floats | None = None
    ) -> Gradients:
        """Return the gradients of a loss; see `RenderResult.backward`."""
        camera, pose = upload_camera(self.device, result.view), result.view.world_to_camera
        model, size = result.model, (camera.height, camera.width)
        count = model.gaussians.count
        if depth is not None and model.gaussians.is_moving:
            raise ValueError("gradient of depth: expected a static model; use `model.at(time)`")
        geometry, grad_depth = None, np.zeros(count)  # grad_depth: dL/d(depth of each mean), float64
        if alpha is not None or depth is not None:
            frame = self._forward(model, camera, np.zeros(3, np.float32), "depth")
            geometry = self._pixel_sums(model, frame, _depth_planes(frame, alpha, depth)).get()
            grad_depth += geometry[GEOMETRY_SUMS, :count]  # the first color channel of this frame is the depth
        frame = self._forward(model, camera, result.background)
        planes = np.zeros((*size, 3), np.float32) if image is None else _check_shape("image", image, (*size, 3))
        pixel_sums = self._pixel_sums(model, frame, planes)
        if geometry is not None:
            total_sums = pixel_sums.get()
            total_sums[:GEOMETRY_SUMS] += geometry[:GEOMETRY_SUMS]
            pixel_sums.set(total_sums)
        pose_sums = pose_gradient(self.rasterizer.workspace, model, frame, pixel_sums)
        gradients = self.rasterizer.gradients(model, frame, pixel_sums)
        arrays = {**{name: gradients[name] for name in model.gaussians.trained}, "mean2d": gradients.mean2d}
        tables = {name: np.ascontiguousarray(a.get()[:, :count].T) for name, a in arrays.items()}
        grad_shift, grad_rotation, grad_focal = np.split(pose_sums() if count else np.zeros(7), [3, 6])  # in world axes
        if depth is not None:
            grad_mean = grad_depth[:, None] * pose[2, :3]
            tables["means"] += grad_mean.astype(np.float32)
            grad_shift += grad_mean.sum(axis=0)
            grad_rotation += np.cross(model.gaussians.get("means") - result.view.position, grad_mean).sum(axis=0)
        rotation = pose[:, :3]
        return Gradients(
            **tables,
            rotation=rotation @ grad_rotation,
            translation=rotation @ grad_shift,
            log_focal=float(grad_focal[0]),
        )

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


def _depth_planes(frame: Frame, alpha: Floats | None, depth: Floats | None) -> Floats:
    """Return the gradient of a loss with respect to a render of (depth, 1, 0) on black, [height, width, 3].

    The mean depth is the first channel of this render divided by the second, which is alpha.
    """
    size = frame.camera.height, frame.camera.width
    planes = np.zeros((*size, 3), np.float32)
    if alpha is not None:
        planes[:, :, 1] = _check_shape("alpha", alpha, size)
    if depth is not None:
        weighted_depth, weight = frame.image.get()[:2, : size[0], : size[1]]
        is_covered = weight > 0
        planes[is_covered, 0] = _check_shape("depth", depth, size)[is_covered] / weight[is_covered]
        planes[is_covered, 1] -= planes[is_covered, 0] * weighted_depth[is_covered] / weight[is_covered]
    return planes


def _check_shape(name: str, derivative: Floats, shape: tuple[int, ...]) -> Floats:
    array = np.asarray(derivative, np.float32)
    if array.shape != shape:
        raise ValueError(f"gradient of {name}: expected the shape of the render, {shape}, got {array.shape}")
    return array


# Rendering of fields.


class FieldRenderer:
    """Renders a field on a device.  Threads may share a renderer, which renders one image at a time."""

    def __init__(self, model: FieldModel, device: str | Device | None = None) -> None:
        """Copy a field to `device`: an open Device, or part of a name; default: `default_device()`.

        Raises DeviceError if no device is found, or if its results are wrong.
        """
        self._lock = threading.RLock()
        self.model, self.device = model, open_checked(device)
        self._field = model.upload(self.device)

    @serialized
    def render(self, view: View, depth: bool = False) -> Layers:
        """Render a view: `image` [height, width, 3] over the field's background, `alpha` and `depth` [height, width].

        depth: also compute the mean depth of each pixel, in scene units; otherwise `depth` of the result is None

        Raises ValueError for an invalid camera, and NumericError if a value of the result is not finite.
        """
        view.camera.check()
        layers = self._field.render_layers(upload_camera(self.device, view), depth)
        for values in layers.arrays:
            require_finite(values, view)
        return layers
