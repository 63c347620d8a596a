"""Learn the light response of each camera: the falloff of its lens, and a response curve per channel."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from clsplat.core.schedule import NonNegative, at_step
from clsplat.losses.base import LossValue
from clsplat.opencl.device import Array
from clsplat.photos.appearance import Floats, ViewTable
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.scene.scene import Scene
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run

KERNEL, FILE = "camera_response.cl", "view_responses.json"
CURVES = [f"{channel}_{node}" for channel in ("red", "green", "blue") for node in (0, 1, 3, 4)]
NODE_AREAS = np.array([0.5, 1, 1, 1, 0.5]) / 4  # contribution of a slope of 1 at each node to f(1)
TABLE = ViewTable("responses", (), ("center_x", "center_y", "a", "b", "c", *CURVES), is_centered=False)


class CameraResponse(TrainingModule):
    """Learn vignetting and response curves together with the Gaussians, one set of parameters per camera.

    A pixel x of the render becomes f(v x) before the losses.  v = 1 + a q + b q² + c q³ is the falloff of the lens
    (Goldman and Chen 2005): q is the squared distance from the center of the falloff, in half diagonals of the image.
    center_x and center_y are the offset of that center from the principal point.  f is a monotone spline for each
    channel (Ramsay 1988), f(0) = 0 and f(1) = 1.  Its slope is piecewise linear; red_0, red_1, red_3, and red_4 are
    the logarithms of the slope at 0, 1/4, 3/4, and 1, relative to the slope at 1/2.  PPISP (Deutsch et al. 2026) has
    a similar falloff, but power curves.  All parameters start at 0, which is the identity.

    Views with the same lens or the same pinhole camera in the dataset share a set.  Test views are evaluated with the
    set of their camera, or with the identity if it has no training photos.  The model and its renders do not change.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "weight"})
    order: ClassVar[int] = 25  # before color modules, which clamp at white
    device_planes: ClassVar[int] = 8  # the image after the response and its gradient, with four channels each
    conflicts: ClassVar[Mapping[str, str]] = {"blocks": "the responses of blocks would differ"}
    side_files: ClassVar[Mapping[str, str]] = {FILE: "responses of the cameras"}

    type: Literal["camera_response"] = "camera_response"
    rate: NonNegative = 1e-3
    """Learning rate (Adam) of the parameters; may be scheduled. Runs of a few hundred steps need 5e-3."""
    weight: NonNegative = 1e-2
    """Weight of the sum of the squared parameters of the step's camera; may be scheduled. With this loss,
    the Gaussians, not the curves, learn a response that all photos share."""

    def create_state(self, run: Run) -> ModuleState:
        return CameraResponseState(self, [view.name for view in run.scene.split("train")], run.original.cameras)

    @classmethod
    def apply_side_files(cls, model: Path, scene: Scene) -> Scene:
        return with_rows(scene, TABLE.read(model.with_name(FILE)))


class CameraResponseState(ModuleState):
    """The parameters of each camera, keyed by the first view that uses it."""

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "kept"

    def __init__(self, settings: CameraResponse, views: Sequence[str], cameras: dict[str, str]) -> None:
        """views: names of the training views by index; cameras: the camera of each view, by name."""
        super().__init__()
        self.settings, self.views, self.cameras = settings, views, cameras

    def row(self, view: str) -> Floats:
        """Return the parameters of a view's camera, [17]."""
        return TABLE.row(self.scalars, self.cameras[view])

    def after_render(self, step: TrainingStep) -> None:
        if step.view_index is not None:
            row, weight = self.row(self.views[step.view_index]), at_step(self.settings.weight, step.number)
            step.module_losses.append(LossValue("response", lambda: weight * float(row @ row)))
            step.save(self, (step.image, row, 2 * weight * row, []))
            step.image = respond(step.workspace, step.camera, step.image, row)

    def backward(self, step: TrainingStep) -> None:
        if saved := step.saved_value(self):
            step.gradient = respond(step.workspace, step.camera, saved[0], saved[1], step.gradient)
            saved[3].append(step.workspace.array("response sums", (20, step.camera.rows)).get_later())

    def update(self, step: TrainingStep) -> None:
        if (saved := step.saved_value(self)) and step.view_index is not None:
            gradient, rate = row_gradient(saved[1], saved[3][0]()) + saved[2], at_step(self.settings.rate, step.number)
            TABLE.update(self.scalars, self.cameras[self.views[step.view_index]], gradient, rate)

    def apply_to(self, scene: Scene) -> Scene:
        return with_rows(scene, {view: self.row(view) for view in self.cameras})

    def write(self, run: Run) -> None:
        TABLE.write(run.out / FILE, {view: self.row(view) for view in self.cameras})


def with_rows(scene: Scene, rows: Mapping[str, Floats]) -> Scene:
    """Return a scene whose views are evaluated with their cameras' responses.  rows: parameters by view, [17]."""
    responses = {view: partial(respond, row=row) for view, row in rows.items()}
    return replace(scene, views=tuple(replace(view, response=responses.get(view.name)) for view in scene.views))


def curve_slopes(row: Floats) -> Floats:
    """Compute the slopes of the three curves at their nodes, [3, 5], from a camera's parameters, [17]."""
    slopes = np.exp(np.insert(row[5:].reshape(3, 4), 2, 0, axis=1))
    return np.asarray(slopes / (slopes @ NODE_AREAS)[:, None])


def row_gradient(row: Floats, sums: Floats) -> Floats:
    """Compute the gradient of a camera's parameters, [17], from sums over pixel rows, [20, rows]."""
    totals, slopes = np.cumsum(sums, axis=1, dtype=np.float64)[:, -1], curve_slopes(row)
    grad_logs = slopes * totals[5:].reshape(3, 5)
    grad_logs -= slopes * NODE_AREAS * grad_logs.sum(axis=1, keepdims=True)
    return np.concatenate([totals[:5], np.delete(grad_logs, 2, axis=1).ravel()])


def respond(workspace: Workspace, camera: DeviceCamera, image: Array, row: Floats, grad: Array | None = None) -> Array:
    """Apply a camera's response to an image, [3 or 4, rows, stride].

    grad: the gradient of the result.  If it is not None, the gradient of the image is returned, and the sums over pixel
    rows are left in the workspace.
    """
    result = workspace.array("grad_response" if grad else "response", image.shape)
    sums, half = workspace.array("response sums", (20, camera.rows)), float(np.hypot(camera.width, camera.height)) / 2
    numbers = np.concatenate([row[2:5], curve_slopes(row).ravel()]).astype(np.float32)
    values = workspace.upload("response numbers", numbers)
    center = {f"center_{x}": float(camera.values[f"c{x}"] + half * shift) for x, shift in zip("xy", row, strict=False)}
    arguments: dict[str, Any] = {"image": image, "gradient": grad or image, "out": result, "row_sums": sums, **center}
    arguments |= {"numbers": values, "channels": image.shape[0], "back": int(grad is not None), "per_px": 1 / half}
    workspace.device.program(KERNEL).camera_response(groups=(1, camera.rows), **arguments, **camera.plane_arguments())
    return result
