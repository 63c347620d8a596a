"""The arguments of kernels that project Gaussians."""

from typing import Any

from clsplat.gaussians.on_host import slots_of
from clsplat.gaussians.tables import DeviceModel
from clsplat.render.camera import DeviceCamera


def shape_arguments(model: DeviceModel, camera: DeviceCamera) -> dict[str, Any]:
    """Return the arguments of every kernel that projects Gaussians, by name.

    Harmonics of rows that the camera does not see may wait for updates; those kernels do not read them.
    """
    gaussians = model.gaussians
    names = ("means", "quats", "log_scales", "logit_opacity", "sh_rest", "filter_variance")
    return {
        **{name: gaussians.tables[name].array for name in names},
        "camera": camera.array,
        "near_plane": model.near,
        "screen_variance": 0.0 if model.pixel_box else model.screen_variance,
        "compensate": 0.0 if model.pixel_box else model.compensate,
        "degree": model.degree,
        **slots_of(gaussians),
        "stride": gaussians.capacity,
        "count": gaussians.count,
    }
