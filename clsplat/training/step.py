"""The heart of a training step: render a view, compare it with its photograph, differentiate, update."""

from collections.abc import Collection, Sequence

from clsplat.gaussians.tables import DeviceModel
from clsplat.losses.image import Comparison, Loss, ViewGradients
from clsplat.losses.penalties import Penalty, PenaltyInputs
from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from clsplat.training.adam import Adam
from clsplat.views.photographs import Photograph, cover, unpack
from clsplat.views.texture import known_gradient

TEXTURE = int(constants("splat.h")["SUM_TEXTURE"])


def differentiate(
    rasterizer: Rasterizer,
    model: DeviceModel,
    target: Photograph,
    background: Array,
    losses: Sequence[Loss],
    step: int = 1,
    count: int = PIXEL_SUMS,
) -> ViewGradients:
    """Return the derivative of the sum of `losses` at one view, as `count` pixel_sums of pixels.  background: [3]."""
    workspace, camera = rasterizer.workspace, target.camera
    frame = rasterizer.forward(model, camera, background)
    photograph = unpack(workspace, camera, target.pixels)
    gradient = workspace.array("grad_image", (3, camera.rows, camera.stride))
    comparison = Comparison(workspace, camera, frame.image, photograph, gradient, step)
    if target.masked:  # what does not count is black in both, and pulls at nothing
        cover(workspace, camera, frame.image, photograph)
        cover(workspace, camera, photograph, photograph)
    terms = [loss.add(comparison) for loss in losses]
    if target.masked:
        cover(workspace, camera, gradient, photograph)
    texture = known_gradient(workspace, camera, photograph, photograph) if count > TEXTURE else None
    return ViewGradients(frame, comparison, terms, rasterizer.pixel_sums(model, frame, gradient, count, texture))


def update(
    rasterizer: Rasterizer,
    model: DeviceModel,
    adam: Adam,
    view: ViewGradients,
    rates: dict[str, float],
    penalties: Sequence[Penalty] = (),
    without: Collection[str] = (),
    extent: float = 1.0,
) -> Array:
    """Update every parameter but those named in `without`, and add the penalties to the view's losses.

    Returns the gradient of the projected means, [2, S] px⁻¹.  Gradients go through memory only where they must.
    """
    if not (penalties or without):
        return adam.update(model, view.frame, view.pixel_sums, rates)
    gradients = rasterizer.gradients(model, view.frame, view.pixel_sums)
    shapes = PenaltyInputs(rasterizer.workspace, model.gaussians, gradients, extent, view.comparison.step)
    view.terms.extend(penalty.add(shapes) for penalty in penalties)
    adam.step(model, gradients, rates, without)
    return gradients.mean2d
