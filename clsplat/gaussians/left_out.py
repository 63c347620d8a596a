"""Gaussians that a picture leaves out: those that a training view hides, and those that a step drops."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.tables import HIDDEN, DeviceModel, Gaussians
from clsplat.opencl.device import Array

HIDDEN_VIEWS = 22  # to a component, a whole number that to_VI of lanes.h converts


def hide(gaussians: Gaussians, left_out: NDArray[np.bool_]) -> None:
    """Write which Gaussians each training view leaves out, [V, N], into the table HIDDEN.

    View v has bit v % HIDDEN_VIEWS of component v // HIDDEN_VIEWS.
    """
    views, count = left_out.shape
    bits = np.zeros((count, -(-views // HIDDEN_VIEWS)), np.float32)  # whole numbers
    for view in range(views):
        plane, bit = divmod(view, HIDDEN_VIEWS)
        bits[:, plane] += left_out[view] * np.float32(1 << bit)
    if HIDDEN not in gaussians.tables:
        gaussians.add(HIDDEN, bits.shape[1])
    gaussians.set(HIDDEN, bits)


def left_out_arguments(model: DeviceModel, view: int | None, drawn: Array) -> dict[str, Any]:
    """Return the arguments of project_forward that leave Gaussians out.

    view: the number of a training view, whose hidden ones are among them; drawn: [S], written where the model has a
    dropout.
    """
    hidden = _hidden(model.gaussians, view)
    if model.dropout is None:
        return {**hidden, "opacity_factor": 1.0}
    gaussians, dropout = model.gaussians, model.dropout
    gaussians.device.program("dropout.cl").draw_left_out(
        items=gaussians.count,
        **hidden,
        left_out=drawn,
        below=round(dropout.probability * 2**32),
        seed=dropout.seed,
        step=dropout.step,
        stride=gaussians.capacity,
        count=gaussians.count,
    )
    return {"hidden": drawn, "hidden_plane": 0, "hidden_bit": 1, "opacity_factor": dropout.opacity_factor}


def _hidden(gaussians: Gaussians, view: int | None) -> dict[str, Any]:
    if view is None or HIDDEN not in gaussians.tables:
        return {"hidden": gaussians["filter_variance"], "hidden_plane": 0, "hidden_bit": 0}  # any table: no bit counts
    plane, bit = divmod(view, HIDDEN_VIEWS)
    return {"hidden": gaussians[HIDDEN], "hidden_plane": plane, "hidden_bit": 1 << bit}
