"""Rendering inside torch: one function with a gradient.  Torch is not a dependency; this module imports it.

    import clsplat.torch
    image, alpha = clsplat.torch.render(renderer, view, parameters)

Tensors live on the CPU, whose memory NumPy shares; those of other devices are copied there and back.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from clsplat.api.renderer import Color, Renderer
from clsplat.formats.splats import PARAMETERS
from clsplat.scene.view import View


class _Render(torch.autograd.Function):
    """Forward: a picture; backward: Picture.backward."""

    @staticmethod
    def forward(ctx: Any, renderer: Renderer, view: View, background: Color | None, *tensors: torch.Tensor) -> Any:
        tables: dict[str, Any] = {n: t.detach().cpu().numpy() for n, t in zip(PARAMETERS, tensors, strict=True)}
        model, count = renderer.model, len(tables["means"])
        if model.motion is not None:
            raise ValueError(
                "the renderer's model moves, which has no gradient here; expected one that stands still: give the "
                "renderer one moment, `model.at(time)`"
            )
        if model.filter_variance is not None and count != len(model):
            raise ValueError(
                f"the renderer's model has a world filter of {len(model)} Gaussians, the parameters have {count}; "
                "expected as many: give the renderer `model.baked()`"
            )
        renderer.update(replace(model, **tables))
        ctx.picture = renderer.render(view, background)
        ctx.save_for_backward(*tensors)  # torch refuses backward where one was changed in place
        image, alpha = (torch.from_numpy(a.copy()) for a in (ctx.picture.image, ctx.picture.alpha))
        return image.to(tensors[0].device), alpha.to(tensors[0].device)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        by_image, by_alpha = (gradient.detach().cpu().numpy() for gradient in gradients)
        found = ctx.picture.backward(image=by_image, alpha=by_alpha if by_alpha.any() else None)
        arrays = [torch.from_numpy(getattr(found, name)) for name in PARAMETERS]
        return None, None, None, *(a.to(t.device) for a, t in zip(arrays, ctx.saved_tensors, strict=True))


def render(
    renderer: Renderer, view: View, parameters: Mapping[str, torch.Tensor], background: Color | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return image [height, width, 3] and alpha [height, width] of a view, differentiable once.

    parameters: the tables of a model by name, float32 [N, components], before activation; filters and the like are
    those of the renderer's model, whose tables these replace.  The number of Gaussians may change from call to call,
    but not where that model has a filter_variance.  Raises KeyError for a table that is missing, and ValueError for a
    shape that does not fit and for a renderer whose model moves.
    """
    apply: Any = _Render.apply
    image, alpha = apply(renderer, view, background, *(parameters[name] for name in PARAMETERS))
    return image, alpha
