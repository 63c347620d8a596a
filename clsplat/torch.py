"""Rendering inside torch: one function with a gradient.  Torch is not a dependency; this module imports it.

    import clsplat.torch
    image, alpha = clsplat.torch.render(renderer, view, parameters)

Tensors live on the CPU, whose memory NumPy shares; those of other devices are copied there and back.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from clsplat.api.renderer import Colour, Renderer
from clsplat.gaussians.tables import PARAMETERS
from clsplat.scene.view import View


class _Render(torch.autograd.Function):
    """Forward: a picture; backward: Picture.backward."""

    @staticmethod
    def forward(ctx: Any, renderer: Renderer, view: View, background: Colour | None, *tensors: torch.Tensor) -> Any:
        arrays = {n: t.detach().cpu().numpy() for n, t in zip(PARAMETERS, tensors, strict=True)}
        model = replace(renderer.model, **arrays)
        renderer.update(model)
        ctx.picture, ctx.model, ctx.devices = renderer.render(view, background), model, [t.device for t in tensors]
        image, alpha = (torch.from_numpy(a.copy()) for a in (ctx.picture.image, ctx.picture.alpha))
        return image.to(tensors[0].device), alpha.to(tensors[0].device)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        by_image, by_alpha = (gradient.detach().cpu().numpy() for gradient in gradients)
        if ctx.picture.renderer.model is not ctx.model:
            ctx.picture.renderer.update(ctx.model)
        found = ctx.picture.backward(image=by_image, alpha=by_alpha if by_alpha.any() else None)
        arrays = [torch.from_numpy(getattr(found, name)) for name in PARAMETERS]
        return None, None, None, *(a.to(d) for a, d in zip(arrays, ctx.devices, strict=True))


def render(
    renderer: Renderer, view: View, parameters: Mapping[str, torch.Tensor], background: Colour | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return image [height, width, 3] and alpha [height, width] of a view, with gradients.

    parameters: the tables of a model by name, float32, before activation; filters and the like are those of the
    renderer's model.  Raises KeyError for a table that is missing.
    """
    image, alpha = _Render.apply(renderer, view, background, *(parameters[name] for name in PARAMETERS))
    return image, alpha
