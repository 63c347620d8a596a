"""Render inside PyTorch with one differentiable function.  PyTorch must be installed separately.

    import clsplat.torch
    image, alpha = clsplat.torch.render(renderer, view, parameters)

Images and gradients are computed in float32, whatever the dtype of the tensors.  Tensors should be on the CPU, where
NumPy shares their memory; tensors on other devices are copied to the CPU and back.
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
    """Renders in the forward pass, and calls `RenderResult.backward` in the backward pass."""

    @staticmethod
    def forward(ctx: Any, renderer: Renderer, view: View, background: Color | None, *tensors: torch.Tensor) -> Any:
        tables: dict[str, Any] = {n: t.detach().cpu().numpy() for n, t in zip(PARAMETERS, tensors, strict=True)}
        model, count = renderer.model, len(tables["means"])
        if model.motion is not None:
            raise ValueError("gradients of dynamic models are not supported; use a renderer of `model.at(time)`")
        if model.filter_variance is not None and count != len(model):
            raise ValueError(
                f"the renderer's model has a world filter for {len(model)} Gaussians, but the parameters have {count}; "
                "use a renderer of `model.baked()`"
            )
        renderer.update(replace(model, **tables))
        ctx.result = renderer.render(view, background)
        ctx.save_for_backward(*tensors)  # so that backward raises an error if a tensor was changed in place
        image, alpha = (torch.from_numpy(a.copy()) for a in (ctx.result.image, ctx.result.alpha))
        return image.to(tensors[0].device), alpha.to(tensors[0].device)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        grad_image, grad_alpha = (gradient.detach().cpu().numpy() for gradient in gradients)
        all_gradients = ctx.result.backward(image=grad_image, alpha=grad_alpha if grad_alpha.any() else None)
        arrays = [torch.from_numpy(getattr(all_gradients, name)) for name in PARAMETERS]
        return None, None, None, *(a.to(t) for a, t in zip(arrays, ctx.saved_tensors, strict=True))


def render(
    renderer: Renderer, view: View, parameters: Mapping[str, torch.Tensor], background: Color | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the image [height, width, 3] and the alpha [height, width] of a view, differentiable once.

    parameters: the tables of a model by name, [N, components] float32, before activation; they replace the tables of
        the renderer's model, whose filters and other settings still apply
    background: as for `Renderer.render`

    The number of Gaussians may change between calls, unless the renderer's model has a `filter_variance`.
    Raises KeyError for a missing table, and ValueError for a wrong shape or a dynamic model.
    """
    apply: Any = _Render.apply
    image, alpha = apply(renderer, view, background, *(parameters[name] for name in PARAMETERS))
    return image, alpha
