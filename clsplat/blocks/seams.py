"""Where the borders of blocks lie in the test views: a mask for each view, which the compare page reads."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.blocks.cells import Cell
from clsplat.files import atomic
from clsplat.gaussians.model import Model
from clsplat.names import SEAMS
from clsplat.opencl.device import Device
from clsplat.render.camera import upload_camera
from clsplat.render.pictures import layers
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.stages.render import image_path

NEAR_FACE = 0.05  # of a cell's size: what lies so near a face is at a border
COVERED = 0.5  # of a pixel, from which on its depth counts
Floats = NDArray[np.floating]


def write_seams(cells: list[Cell], model: Model, scene: Scene, device: Device, run: Path) -> None:
    """Write, for each test view, which pixels show what lies near a face between blocks: 255 there, else 0.

    run: the folder of the merged model; masks go into its folder `seams`.  Raises OutputError.
    """
    rasterizer, uploaded = Rasterizer(device), model.upload(device)
    black = device.upload(np.zeros(3, np.float32))
    for view in scene.split("test"):
        found = layers(rasterizer, uploaded, upload_camera(device, view), black, depth=True)
        assert found.depth is not None
        near = is_near(places(view, found.depth).reshape(-1, 3), cells).reshape(found.depth.shape)
        mask = np.where(near & (found.alpha >= COVERED), np.uint8(255), np.uint8(0))
        _, encoded = cv2.imencode(".png", mask)
        with atomic(image_path(run / SEAMS, view.name)) as file:
            file.write(encoded.tobytes())


def places(view: View, depth: Floats) -> Floats:
    """Return where the pixels of a view lie at these depths, [height, width, 3] scene units."""
    camera, pose = view.camera, np.asarray(view.world_to_camera, np.float64)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    return np.asarray((rays * depth[:, :, None] - pose[:, 3]) @ pose[:, :3])


def is_near(points: Floats, cells: list[Cell]) -> NDArray[np.bool_]:
    """Return which points, [N, 3], lie near a face of the cell that holds them, [N].

    Near is `NEAR_FACE` of the cell's size along the axis: half as far as growth goes beyond a face.
    """
    near = np.zeros(len(points), bool)
    for cell in cells:
        held, box = cell.box.holds(points), cell.box
        for axis in range(3):
            for bound in (box.low[axis], box.high[axis]):
                if bound is not None:
                    near |= held & (np.abs(points[:, axis] - bound) < NEAR_FACE * cell.size[axis])
    return near
