"""The scenes of the benchmark: synthetic ones with a fixed seed, and real ones from files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.bench.cases import Case
from clsplat.formats.splats import Parameters
from clsplat.formats.table import detect
from clsplat.gaussians.model import load
from clsplat.gaussians.tables import SH_C0
from clsplat.opencl.device import Device
from clsplat.pipeline.file import PipelineFile
from clsplat.render.camera import upload_camera
from clsplat.scene.points import read_points_ply
from clsplat.scene.scene import Camera, View
from clsplat.stages.init import from_points
from clsplat.views.photographs import Photograph, Photographs

FOCAL = 400.0  # px, of the synthetic scenes
SIZE = 2.2  # px, standard deviation of their splats
SIZES = {"A": (400, 400, 50_000), "B": (800, 800, 300_000), "C": (1920, 1080, 1_000_000)}
GROWTH_COUNTS = (50_000, 100_000, 200_000, 400_000, 700_000, 1_000_000)


def synthetic(width: int, height: int, count: int, size: float = SIZE) -> tuple[Parameters, View]:
    """Return flat Gaussians that face the camera, of about `size` px, with log-normal sizes and random opacities."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-8, width + 8, count), rng.uniform(-8, height + 8, count)
    sizes = size * np.exp(rng.normal(0, 0.5, (count, 2)))
    angle, depth = rng.uniform(0, np.pi, count), rng.uniform(1, 10, count)
    means = np.stack([(u - width / 2) / FOCAL * depth, (v - height / 2) / FOCAL * depth, depth], axis=1)
    scales = np.column_stack([sizes * depth[:, None] / FOCAL, np.full(count, 1e-4)])
    zero = np.zeros(count)
    tables: dict[str, NDArray[Any]] = {
        "means": means,
        "quats": np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=1),
        "log_scales": np.log(scales),
        "logit_opacity": rng.normal(-1, 1.5, (count, 1)),
        "sh_base": (rng.uniform(0, 1, (count, 3)) - 0.5) / SH_C0,
        "sh_rest": rng.normal(0, 0.02, (count, 45)),
    }
    camera = Camera(width, height, FOCAL, FOCAL, width / 2, height / 2)
    parameters = {key: table.astype(np.float32) for key, table in tables.items()}
    return parameters, View("bench", camera, np.eye(4)[:3], Path("bench"))


def case(device: Device, width: int, height: int, count: int, settings: PipelineFile, size: float = SIZE) -> Case:
    """Return a synthetic scene with a noise image as its photograph."""
    parameters, view = synthetic(width, height, count, size)
    camera = upload_camera(device, view)
    shape = (3, height, width)
    pixels = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    return Case(device, parameters, Photograph(camera, device.upload(pixels)), "black", settings)


def real_case(device: Device, model: Path, scene: Path, settings: PipelineFile) -> Case:
    """Return a splat PLY, or the Gaussians that `init` makes of a point cloud, at a scene's first training view."""
    opened, background = settings.scene.read(scene)
    photographs = Photographs(device, background)
    parameters = load(model).tables() if detect(model) else from_points(read_points_ply(model), 0.1, 3)
    return Case(device, parameters, photographs.get(opened.split("train")[0]), background, settings)


def grown(device: Device, settings: PipelineFile) -> Iterator[Case]:
    """Yield scenes of 50 000 to a million Gaussians over one image; their total area is constant."""
    width, height, largest = SIZES["C"]
    for count in GROWTH_COUNTS:
        yield case(device, width, height, count, settings, SIZE * (largest / count) ** 0.5)
