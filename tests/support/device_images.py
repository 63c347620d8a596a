"""Images, photographs and trainers on a device."""

import numpy as np

from clsplat.conformance.checks.images import make_camera
from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.losses.base import Comparison, Loss
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photograph
from clsplat.photos.transforms import Planes
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.training.adam import Adam, Rates
from clsplat.training.trainer import StepTrainer


def planes_of(device, image: np.ndarray, mask: np.ndarray | None = None) -> Planes:
    """image: [3, H, W]; mask: [H, W]."""
    camera = make_camera(device, image.shape[2], image.shape[1])

    def padded(values: np.ndarray) -> np.ndarray:
        planes = np.zeros((len(values), camera.rows, camera.stride), np.float32)
        planes[:, : camera.height, : camera.width] = values
        return planes

    workspace = Workspace(device)
    workspace.array("blur", (4, camera.rows, camera.stride)).fill(7)
    uploaded = None if mask is None else device.upload(padded(mask[None]))
    return Planes(workspace, camera, device.upload(padded(image)), uploaded)


def colors_of(planes: Planes) -> np.ndarray:
    """The colors inside the image, [3, H, W]; outside it they must be zero."""
    colors, camera = planes.colors.get(), planes.camera
    assert (colors[:, camera.height :] == 0).all()
    assert (colors[:, :, camera.width :] == 0).all()
    return colors[:, : camera.height, : camera.width]


# around the window (11), vectors (8, 16), tiles (16) and the columns of a group (256)
SIZES = ((1, 1), (5, 3), (11, 11), (16, 16), (17, 33), (100, 31), (255, 12), (256, 6), (257, 9), (600, 4))


def gradient_of(comparison: Comparison) -> np.ndarray:
    """The gradient inside the image; outside it must be zero."""
    planes, camera = comparison.gradient.get(), comparison.camera
    assert (planes[:, camera.height :] == 0).all()
    assert (planes[:, :, camera.width :] == 0).all()
    return planes[:, : camera.height, : camera.width]


def trainer_of(device: Device, rng: np.random.Generator, losses: list[Loss]) -> tuple[StepTrainer, Photograph]:
    """A trainer of a few Gaussians, and a photograph of noise of which a third is masked."""
    case = random_case(rng, 60, 40, 30)
    model = case.model(device)
    trainer = StepTrainer(
        Rasterizer(device, "radix"),
        model,
        Adam(model.gaussians),
        SplatStats(model.gaussians),
        device.zeros(3),
        losses,
        Rates(),
    )
    colors = rng.integers(0, 256, (3, 30, 40)).astype(np.uint8)
    mask = np.ones((1, 30, 40), np.uint8)
    mask[:, :, :13] = 0
    return trainer, Photograph(case.device_camera(device), device.upload(colors), device.upload(mask))
