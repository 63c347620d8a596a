"""Render training views between two steps, and sum the contributions of each Gaussian to their pixels.

The sums are computed by the backward pass in a fixed order, so they are reproducible bit for bit on a device.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.gaussians import DeviceModel
from clsplat.losses.base import Comparison, ImageLoss
from clsplat.losses.image import L1, Dssim
from clsplat.opencl.device import Array, constants
from clsplat.photos.photographs import Photograph, Photographs, apply_mask
from clsplat.render.painter import crop
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.scene.view import View

WEIGHT, BLENDED, SQUARE = (int(constants("splat.h")[f"SUM_{name}"]) for name in ("WEIGHT", "BLENDED", "SQUARE"))
LOSSES = L1(weight=0.8), Dssim(weight=0.2)  # the loss that published scores use (Kerbl et al. 2023)
Floats = NDArray[np.float32]
Result = TypeVar("Result")


@dataclass(frozen=True)
class RenderedView:
    """A rendered view, valid until the next one is rendered.  Masked pixels are ignored."""

    rasterizer: Rasterizer
    model: DeviceModel
    photograph: Photograph
    frame: Frame

    @classmethod
    def render(
        cls, rasterizer: Rasterizer, model: DeviceModel, photograph: Photograph, background: Array
    ) -> "RenderedView":
        """Render the view of a photograph.  background: [3]."""
        return cls(rasterizer, model, photograph, rasterizer.forward(model, photograph.camera, background))

    @classmethod
    def render_all(
        cls, rasterizer: Rasterizer, model: DeviceModel, photographs: Iterable[Photograph], background: Array
    ) -> Iterator["RenderedView"]:
        """Yield the rendered views of photographs, each valid until the next is rendered.  background: [3]."""
        return (cls.render(rasterizer, model, photograph, background) for photograph in photographs)

    def counted_pixels(self) -> NDArray[np.bool_]:
        """Return the mask of the unmasked pixels, [height, width]."""
        camera, mask = self.photograph.camera, self.photograph.unmasked_pixels()
        return np.ones((camera.height, camera.width), bool) if mask is None else mask

    def error(self) -> Floats:
        """Return the absolute difference between render and photograph, averaged over channels, [height, width]."""
        image = crop(self.frame, self.frame.image.get())
        error: Floats = np.abs(image - self.photograph.image() / np.float32(255)).mean(axis=2)
        return error

    def loss(self, losses: Sequence[ImageLoss]) -> float:
        """Return the sum of losses, and set masked pixels of the render to black."""
        workspace, camera, planes = self._workspace, self.photograph.camera, self.photograph.planes(self._workspace)
        if planes.mask is not None:
            apply_mask(workspace, camera, self.frame.image, planes.mask)
            apply_mask(workspace, camera, planes.colors, planes.mask)
        comparison = Comparison(workspace, camera, self.frame.image, planes.colors, self._gradient(), planes.mask)
        return sum(loss.add(comparison).value() for loss in losses)

    def radius(self) -> Floats:
        """Return the radius of each splat, three standard deviations, [N] px; 0 if it is not visible."""
        return np.asarray(self.frame.radius.get()[: self.model.gaussians.count])

    def sum(self, index: int, plane: NDArray[Any] | None = None, channel: int | None = None) -> Floats:
        """Return a sum over pixels for each Gaussian, [N]; 0 if it is not visible.

        index: `SUM_*` in cl_kernels/splat.h.  plane: the texture, [height, width], at least 0; None for zeros.
        channel: index of the image channel whose sum over the image is the loss to differentiate; None for no loss.
        """
        camera, counted_mask = self.photograph.camera, self.counted_pixels()
        texture = np.full((camera.rows, camera.stride), -1, np.float32)  # -1: the pixel is ignored
        texture[: camera.height, : camera.width] = np.where(counted_mask, 0 if plane is None else plane, -1)
        texture_array = self._workspace.array("survey texture", texture.shape)
        texture_array.set(texture)
        gradient = self._gradient()
        if channel is None:
            gradient.fill(0)
        else:
            gradient.set((texture >= 0) * (np.arange(3) == channel)[:, None, None])
        sums = self.rasterizer.pixel_sums(self.model, self.frame, gradient, _sum_count(index), texture_array)
        return np.asarray(sums.get()[index, : self.model.gaussians.count])

    @property
    def _workspace(self) -> Any:
        return self.rasterizer.workspace

    def _gradient(self) -> Array:
        camera = self.photograph.camera
        return self.rasterizer.workspace.array("grad_image", (3, camera.rows, camera.stride))


def _sum_count(index: int) -> int:
    """Return the number of sums that the backward pass must compute to include sum `index`."""
    return SQUARE + 1 if index >= BLENDED else BLENDED


class Survey:
    """The training views for the rules of one edit, rendered with the Gaussians before the edit."""

    def __init__(
        self,
        rasterizer: Rasterizer,
        model: DeviceModel,
        photographs: Photographs,
        views: Sequence[View],
        seed: int,
        step: int,
    ) -> None:
        self.views = views
        self._rasterizer, self._model, self._photographs = rasterizer, model, photographs
        self._seed, self._step = seed, step
        self._cache: dict[Any, Any] = {}

    def render(self, views: Iterable[View]) -> Iterator[RenderedView]:
        """Yield rendered views, each valid until the next is rendered."""
        photographs = (self._photographs.get(view) for view in views)
        return RenderedView.render_all(self._rasterizer, self._model, photographs, self._photographs.background)

    @property
    def count(self) -> int:
        """Number of Gaussians, N."""
        return self._model.gaussians.count

    def sample_views(self, number: int) -> list[View]:
        """Return a random sample of at most `number` views, in their original order; it depends on seed and step."""
        count = len(self.views)
        indices = np.random.default_rng([self._seed, self._step, count, number]).permutation(count)[:number]
        return [self.views[index] for index in np.sort(indices)]

    def compute_once(self, function: Callable[..., Result], *arguments: Any) -> Result:
        """Return the result of `function(survey, *arguments)`, computed only once for all rules of the edit."""
        key = function, arguments
        if key not in self._cache:
            self._cache[key] = function(self, *arguments)
        result: Result = self._cache[key]
        return result


def normalize(values: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Scale values linearly so that those in the mask range from 0 to 1; return zeros if they are all equal."""
    low = float(np.min(values[mask], initial=np.inf))
    high = float(np.max(values[mask], initial=-np.inf))
    return (values - low) / (high - low) if high > low else np.zeros_like(values)
