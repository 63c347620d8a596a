"""Rendering of a field with NumPy out."""

from clsplat.api.device import proved
from clsplat.metrics.views import require_finite
from clsplat.opencl.device import Device
from clsplat.render.camera import upload_camera
from clsplat.render.pictures import Layers
from clsplat.scene.view import View
from clsplat.training.field_file import FieldModel


class FieldRenderer:
    """A field on a device, which serves one thread."""

    def __init__(self, model: FieldModel, device: str | Device | None = None) -> None:
        """Copy a field to a device, or to one by its name; by default `default_device()`.

        Raises DeviceError when there is none, or when it computes wrongly.
        """
        self.model, self.device = model, proved(device)
        self._field = model.upload(self.device)

    def render(self, view: View, depth: bool = False) -> Layers:
        """Return `image` [height, width, 3] before the field's background, `alpha` and `depth` [height, width].

        depth: mean depth of what covers a pixel, scene units; None where it is not asked for.
        Raises ValueError for a camera that cannot be, NumericError where a value of the picture is not finite.
        """
        view.camera.check()
        found = self._field.layers(upload_camera(self.device, view), depth)
        for values in found.arrays:
            require_finite(values, view)
        return found
