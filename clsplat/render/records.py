"""Sums of gradient records over the pairs of each Gaussian, and what the blended inverse depth has beside them."""

from collections.abc import Mapping

from clsplat.gaussians.tables import Gaussians
from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.tiles import TileLists
from clsplat.render.workspace import Workspace

INVERSE_DEPTHS = "inverse_depth_sums"  # in the workspace


def sum_records(
    pair_sums: Array,
    lists: TileLists,
    gaussians: Gaussians,
    pixel_sums: Array,
    defines: Mapping[str, int],
    accumulate: int,
) -> None:
    """Write the sums of the records [P, RECORD] of each Gaussian, [PIXEL_SUMS, S].

    defines: has PIXEL_SUMS where it is not the usual number; accumulate: 1 adds to the sums.
    """
    device = gaussians.device
    device.program("gather.cl", **defines).sum_records(
        items=-(-gaussians.count // int(device.tuning["LANES"])),
        pair_sums=pair_sums,
        first_pair=lists.first_pair,
        tile_count=lists.tile_count,
        pixel_sums=pixel_sums,
        accumulate=accumulate,
        stride=gaussians.capacity,
        count=gaussians.count,
    )


def sum_inverse_depths(
    workspace: Workspace, pair_sums: Array, lists: TileLists, gaussians: Gaussians, accumulate: int
) -> Array:
    """Return the sum over pixels of w dL/dD of each Gaussian, [S], of its records; `accumulate`: 1 adds to it."""
    sums = workspace.array(INVERSE_DEPTHS, gaussians.capacity)
    workspace.device.program("inverse_depth.cl").sum_inverse_depths(
        items=gaussians.count,
        pair_sums=pair_sums,
        first_pair=lists.first_pair,
        tile_count=lists.tile_count,
        sums=sums,
        accumulate=accumulate,
        count=gaussians.count,
    )
    return sums


def add_inverse_depth_gradient(workspace: Workspace, camera: DeviceCamera, splats: Array, grad_means: Array) -> None:
    """Add to the gradient of the means, [3, S], what the last sums and the splats [N, RECORD] give."""
    count, capacity = splats.shape[0], grad_means.shape[1]
    workspace.device.program("inverse_depth.cl").inverse_depth_backward(
        items=count,
        splats=splats,
        sums=workspace.array(INVERSE_DEPTHS, capacity),
        camera=camera.array,
        grad_means=grad_means,
        stride=capacity,
        count=count,
    )
