"""Evaluate a moving model at the timestamp of a camera, and backpropagate to its motion."""

import copy
import logging
from dataclasses import replace
from functools import cache
from typing import Any

from clsplat.formats.splats import MOTION, TURN, WIDTHS
from clsplat.gaussians.gaussians import DeviceModel, Gaussians, Table
from clsplat.gaussians.structs import GaussianGradients
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace

LOG = logging.getLogger("clsplat")
DEFAULT_TIME = 0.0  # time of cameras without a time


def evaluate_motion(workspace: Workspace, model: DeviceModel, camera: DeviceCamera) -> DeviceModel:
    """Return the model at the time of a camera, in memory that the next call reuses; return a static model unchanged.

    A camera without a time shows the first timestamp, and a warning is logged once.
    """
    gaussians = model.gaussians
    if not gaussians.is_moving:
        return model
    if camera.time is None:
        _warn_about_first_timestamp()
    stride = gaussians.capacity
    means, logit = workspace.array("moved means", (3, stride)), workspace.array("moved logit", (1, stride))
    gaussians.device.program("motion.cl").move_forward(
        **_arguments(gaussians, camera),
        means=gaussians["means"],
        logit_opacity=gaussians["logit_opacity"],
        moved_means=means,
        moved_logit=logit,
        degree=_degree_and_rotation(gaussians)[0],
    )
    tables = {"means": means, "logit_opacity": logit}
    if rotation := _rotation_argument(gaussians):
        tables["quats"] = workspace.array("moved quats", (4, stride))
        gaussians.device.program("motion.cl").turn_forward(
            **_arguments(gaussians, camera), quats=gaussians["quats"], moved_quats=tables["quats"], **rotation
        )
    return replace(model, gaussians=_with_tables(gaussians, tables))


def backpropagate_motion(model: DeviceModel, camera: DeviceCamera, gradients: GaussianGradients) -> None:
    """Convert gradients of the model at the time of a camera to those of the model and its motion, in place."""
    gaussians = model.gaussians
    if not gaussians.is_moving:
        return
    program = gaussians.device.program("motion.cl")
    program.move_backward(
        **_arguments(gaussians, camera),
        logit_opacity=gaussians["logit_opacity"],
        grad_means=gradients["means"],
        grad_logit_opacity=gradients["logit_opacity"],
        grad_motion=gradients[MOTION],
        degree=_degree_and_rotation(gaussians)[0],
    )
    if rotation := _rotation_argument(gaussians):
        program.turn_backward(
            **_arguments(gaussians, camera), grad_quats=gradients["quats"], grad_motion=gradients[MOTION], **rotation
        )


def _arguments(gaussians: Gaussians, camera: DeviceCamera) -> dict[str, Any]:
    return {
        "items": -(-gaussians.count // int(gaussians.device.tuning["LANES"])),
        "motion": gaussians[MOTION],
        "time": DEFAULT_TIME if camera.time is None else camera.time,
        "stride": gaussians.capacity,
        "count": gaussians.count,
    }


def _degree_and_rotation(gaussians: Gaussians) -> tuple[int, bool]:
    """Return the degree of the polynomials, and whether Gaussians rotate."""
    return WIDTHS[gaussians.tables[MOTION].components]


def _rotation_argument(gaussians: Gaussians) -> dict[str, int]:
    """Return the kernel argument for rotation, the index of its first plane; empty if Gaussians do not rotate."""
    return {"first": gaussians.tables[MOTION].components - TURN} if _degree_and_rotation(gaussians)[1] else {}


def _with_tables(gaussians: Gaussians, arrays: dict[str, Array]) -> Gaussians:
    """Return a shallow copy of Gaussians with some tables replaced."""
    result = copy.copy(gaussians)
    tables = {name: Table(array, array.shape[0], zero_fresh=False) for name, array in arrays.items()}
    result.tables = {**gaussians.tables, **tables}
    return result


@cache
def _warn_about_first_timestamp() -> None:
    LOG.warning(
        "a view without a time shows a moving model at its first timestamp; set `--time T` in commands, or `View.time` "
        "in Python"
    )
