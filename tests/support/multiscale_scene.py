"""The multi-scale Blender dataset of mip-NeRF (Barron et al. 2021), made from a single-scale one.

Level j of an image is the mean over boxes of 2^j x 2^j pixels of the stored RGBA values, not premultiplied,
truncated to 8 bits; its focal length is that of the full image divided by 2^j.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import PIPELINE, remove_partial_files, write_text
from clsplat.scene.images import read_image, write_image
from clsplat.scene.transforms_json import FrameFiles, Transforms, view_name

MIN_DEPTH, MAX_DEPTH = 2.0, 6.0  # scene units; mip-NeRF's values for these scenes


def write_multiscale(source: Path, out: Path, levels: int = 4) -> int:
    """Write images_train, images_test, … and metadata.json into `out`; return the number of images.

    Raises DataError if `source` is not a Blender folder or its images cannot be halved `levels - 1` times.
    """
    splits = {path.stem.removeprefix("transforms_"): path for path in sorted(source.glob("transforms_*.json"))}
    if "train" not in splits:
        raise DataError(f"{source}: has no transforms_train.json; expected the folder of a Blender dataset")
    remove_partial_files(out, marker=PIPELINE)
    metadata = {name: _write_split(Transforms(path), name, out, levels) for name, path in splits.items()}
    write_text(out / "metadata.json", json.dumps(metadata) + "\n")
    points = source / "points3d.ply"
    if points.is_file():
        shutil.copyfile(points, out / points.name)
    return sum(len(table["file_path"]) for table in metadata.values())


def pyramid(pixels: NDArray[np.uint8], levels: int) -> list[NDArray[np.uint8]]:
    """Return an image [H, W, C] at 1, 1/2, 1/4, …; H and W are divisible by 2^(levels - 1)."""
    images = [pixels]
    level = pixels.astype(np.float64)  # sums of 8-bit values and their means by powers of two are exact
    while len(images) < levels:
        height, width, channels = level.shape
        level = level.reshape(height // 2, 2, width // 2, 2, channels).mean(axis=(1, 3))
        images.append(level.astype(np.uint8))
    return images


def _write_split(transforms: Transforms, name: str, out: Path, levels: int) -> dict[str, Any]:
    """Write one split's images and return its columns, one value per image."""
    folder, rows = transforms.path.parent, []
    views = filter(None, FrameFiles(folder, folder, transforms.frames).make_views(transforms.path, "refuse"))
    for i, (frame, view) in enumerate(zip(transforms.frames, views, strict=True)):
        pixels = read_image(view.image_path)
        height, width = pixels.shape[:2]
        if pixels.dtype != np.uint8 or height % 2 ** (levels - 1) or width % 2 ** (levels - 1):
            raise DataError(
                f"{view.image_path}: {width}x{height} pixels of {pixels.dtype}; expected 8 bits and a size that can be "
                f"halved {levels - 1} times: use fewer levels"
            )
        for j, image in enumerate(pyramid(pixels, levels)):
            file = view_name(f"images_{name}/{i:03d}_d{j}.png")
            write_image(out / file, image)
            camera = {"width": width >> j, "height": height >> j, "focal": view.camera.fx / 2**j}
            sampling = {"label": j, "near": MIN_DEPTH, "far": MAX_DEPTH, "lossmult": 4.0**j}
            inverse = _pixel_to_camera(**camera)
            pose = frame.value("transform_matrix")
            rows.append({"file_path": file, "cam2world": pose, **camera, **sampling, "pix2cam": inverse})
    return {key: [row[key] for row in rows] for key in rows[0]}


def _pixel_to_camera(width: int, height: int, focal: float) -> list[list[float]]:
    """Return the inverse calibration matrix with OpenGL axes, as the format defines it."""
    return [[1 / focal, 0.0, -0.5 * width / focal], [0.0, -1 / focal, 0.5 * height / focal], [0.0, 0.0, -1.0]]
