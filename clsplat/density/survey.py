"""Passes over training views between two steps: what each Gaussian does in their pixels.

The sums are those of the backward pass, in a fixed order: the same bits on the same device.
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
from clsplat.render.painter import inside
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.scene.view import View

WEIGHT, BLENDED, SQUARE = (int(constants("splat.h")[f"SUM_{name}"]) for name in ("WEIGHT", "BLENDED", "SQUARE"))
LOSSES = L1(weight=0.8), Dssim(weight=0.2)  # of a view in published scores
Floats = NDArray[np.float32]
Found = TypeVar("Found")


@dataclass(frozen=True)
class SurveyView:
    """One view as the Gaussians show it; valid until the next.  Pixels that a mask leaves out do not count."""

    rasterizer: Rasterizer
    model: DeviceModel
    photograph: Photograph
    frame: Frame

    @classmethod
    def at(cls, rasterizer: Rasterizer, model: DeviceModel, photograph: Photograph, background: Array) -> "SurveyView":
        """Render the view of a photograph.  background: [3]."""
        return cls(rasterizer, model, photograph, rasterizer.forward(model, photograph.camera, background))

    @classmethod
    def each(
        cls, rasterizer: Rasterizer, model: DeviceModel, photographs: Iterable[Photograph], background: Array
    ) -> Iterator["SurveyView"]:
        """Render the views of photographs, one after another.  background: [3]."""
        return (cls.at(rasterizer, model, photograph, background) for photograph in photographs)

    def counted(self) -> NDArray[np.bool_]:
        """Return which pixels count, [height, width]."""
        camera, mask = self.photograph.camera, self.photograph.counted()
        return np.ones((camera.height, camera.width), bool) if mask is None else mask

    def error(self) -> Floats:
        """Return the absolute difference of image and photograph, the mean over channels, [height, width]."""
        image = inside(self.frame, self.frame.image.get())
        found: Floats = np.abs(image - self.photograph.image() / np.float32(255)).mean(axis=2)
        return found

    def loss(self, losses: Sequence[ImageLoss]) -> float:
        """Return the sum of losses; pixels that do not count are black afterwards."""
        workspace, camera, planes = self._workspace, self.photograph.camera, self.photograph.planes(self._workspace)
        if planes.mask is not None:
            apply_mask(workspace, camera, self.frame.image, planes.mask)
            apply_mask(workspace, camera, planes.colors, planes.mask)
        comparison = Comparison(workspace, camera, self.frame.image, planes.colors, self._gradient(), planes.mask)
        return sum(loss.add(comparison).value() for loss in losses)

    def radius(self) -> Floats:
        """Return the radius of each splat, three standard deviations, [N] px; 0: not seen."""
        return np.asarray(self.frame.radius.get()[: self.model.gaussians.count])

    def sum(self, number: int, plane: NDArray[Any] | None = None, channel: int | None = None) -> Floats:
        """Return one of the sums over pixels of cl_kernels/splat.h for each Gaussian, [N]; 0 where it is not seen.

        plane: the texture, [height, width], 0 or more; None: 0.  channel: the one whose sum over the image is the loss
        of the gradients; None: there is no loss.
        """
        camera, counted = self.photograph.camera, self.counted()
        texture = np.full((camera.rows, camera.stride), -1, np.float32)  # not known
        texture[: camera.height, : camera.width] = np.where(counted, 0 if plane is None else plane, -1)
        uploaded = self._workspace.array("surveyed texture", texture.shape)
        uploaded.set(texture)
        gradient = self._gradient()
        if channel is None:
            gradient.fill(0)
        else:
            gradient.set((texture >= 0) * (np.arange(3) == channel)[:, None, None])
        sums = self.rasterizer.pixel_sums(self.model, self.frame, gradient, _computed(number), uploaded)
        return np.asarray(sums.get()[number, : self.model.gaussians.count])

    @property
    def _workspace(self) -> Any:
        return self.rasterizer.workspace

    def _gradient(self) -> Array:
        camera = self.photograph.camera
        return self.rasterizer.workspace.array("grad_image", (3, camera.rows, camera.stride))


def _computed(number: int) -> int:
    """Sums that a backward pass computes so that one of them is there: up to the texture's, or all."""
    return SQUARE + 1 if number >= BLENDED else BLENDED


class Survey:
    """The training views for the rules of one edit, which see the Gaussians as they are before it."""

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
        self._found: dict[Any, Any] = {}

    def looks(self, views: Iterable[View]) -> Iterator[SurveyView]:
        """Render views, one after another."""
        photographs = (self._photographs.get(view) for view in views)
        return SurveyView.each(self._rasterizer, self._model, photographs, self._photographs.background)

    @property
    def count(self) -> int:
        """Number of Gaussians, N."""
        return self._model.gaussians.count

    def drawn(self, number: int) -> list[View]:
        """Return that many of the views, drawn by seed and step, in their order; all where there are no more."""
        count = len(self.views)
        places = np.random.default_rng([self._seed, self._step, count, number]).permutation(count)[:number]
        return [self.views[place] for place in np.sort(places)]

    def once(self, function: Callable[..., Found], *arguments: Any) -> Found:
        """Return function(survey, *arguments); rules that ask for the same share it."""
        key = function, arguments
        if key not in self._found:
            self._found[key] = function(self, *arguments)
        found: Found = self._found[key]
        return found


def scaled(values: NDArray[np.float64], counted: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return values between 0 for the least of those that count and 1 for the largest; all 0 where these are equal."""
    least, most = (
        float(bound(values[counted], initial=start)) for bound, start in ((np.min, np.inf), (np.max, -np.inf))
    )
    return (values - least) / (most - least) if most > least else np.zeros_like(values)
