"""The heart of a training step: render a view, compare it with its photograph, differentiate, update."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from clsplat.gaussians.model import Model
from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.render.renderer import MOMENTS, Frame, Renderer
from clsplat.training.adam import Adam
from clsplat.training.losses import Comparison, Loss, Term
from clsplat.training.shape_losses import ShapeLoss, Shapes
from clsplat.training.targets import Target, cover, unpack
from clsplat.training.texture import known_gradient

TEXTURE = int(constants("splat.h")["MOMENT_TEXTURE"])


@dataclass(frozen=True)
class Differentiated:
    """A view's frame, its losses and what their gradients are made of; valid until the next one."""

    frame: Frame
    comparison: Comparison
    terms: list[Term]
    moments: Array  # [count, S]


def differentiate(
    renderer: Renderer,
    model: Model,
    target: Target,
    background: Array,
    losses: Sequence[Loss],
    step: int = 1,
    count: int = MOMENTS,
) -> Differentiated:
    """Return the derivative of the sum of `losses` at one view, as `count` moments of pixels.  background: [3]."""
    workspace, camera = renderer.workspace, target.camera
    frame = renderer.forward(model, camera, background)
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
    return Differentiated(frame, comparison, terms, renderer.moments(model, frame, gradient, count, texture))


def update(
    renderer: Renderer,
    model: Model,
    adam: Adam,
    view: Differentiated,
    rates: dict[str, float],
    penalties: Sequence[ShapeLoss] = (),
    without: Collection[str] = (),
    extent: float = 1.0,
) -> Array:
    """Update every parameter but those named in `without`, and add the penalties to the view's losses.

    Returns the gradient of the projected means, [2, S] px⁻¹.  Gradients go through memory only where they must.
    """
    if not (penalties or without):
        return adam.update(model, view.frame, view.moments, rates)
    gradients = renderer.gradients(model, view.frame, view.moments)
    shapes = Shapes(renderer.workspace, model.gaussians, gradients, extent, view.comparison.step)
    view.terms.extend(penalty.add(shapes) for penalty in penalties)
    adam.step(model, gradients, rates, without)
    return gradients.mean2d
