"""Project Gaussians to splats, those of the view being up to date."""

from dataclasses import fields, replace

import numpy as np

from clsplat.gaussians.left_out import left_out_arguments
from clsplat.gaussians.tables import DeviceModel
from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.render.arguments import shape_arguments
from clsplat.render.camera import DeviceCamera
from clsplat.render.tiles import Band, Footprints
from clsplat.render.workspace import Workspace

RECORD = int(constants()["RECORD"])


def project(
    workspace: Workspace, model: DeviceModel, camera: DeviceCamera, band: Band, splats: Array, radius: Array
) -> Footprints:
    """Write the records and radii of splats; return where they lie among the tiles of a band.

    splats: [N, RECORD]; radius: [S] px.  The footprints are valid until the next call.
    """
    gaussians = model.gaussians
    device, count, stride = gaussians.device, gaussians.count, gaussians.capacity
    footprints = Footprints(*(workspace.array(field.name, stride, np.uint32) for field in fields(Footprints)))
    device.program("project.cl", **model.defines).project_forward(
        items=-(-count // int(device.tuning["LANES"])),
        **shape_arguments(model, camera),
        sh_base=gaussians["sh_base"],
        **left_out_arguments(model, camera.view, workspace.array("left_out", stride)),
        splats=splats,
        **vars(footprints),
        radius=radius,
        row_begin=band.row_begin,
        row_end=band.row_end,
    )
    return footprints


def catch_up(workspace: Workspace, model: DeviceModel, camera: DeviceCamera) -> None:
    """Do the updates that Gaussians in the view wait for, and fetch from the host what lies there.

    A projection without harmonics says which Gaussians those are.
    """
    deferred, on_host = model.gaussians.deferred, model.gaussians.on_host
    if on_host or (deferred and deferred.updates):
        splats = workspace.array("splats", (model.gaussians.count, RECORD))
        radius = workspace.array("radius", model.gaussians.capacity)
        no_band = Band(camera.tiles_x, camera.tiles_y, 0, 0)
        depth_key = project(workspace, replace(model, degree=0), camera, no_band, splats, radius).depth_key
        if on_host:
            on_host.bring(depth_key)
        if deferred:
            deferred.catch_up(depth_key)
