"""Image pyramids beside a dataset's photographs: images_2, images_4, images_8, as Mip-NeRF 360 ships them."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import atomic
from clsplat.core.manifest import Made, hash_of
from clsplat.core.progress import Count
from clsplat.scene.images import is_image, read_image

QUALITY = 98  # of JPEG


def write_pyramid(scene: Path, levels: int = 3) -> int:
    """Write images_2, images_4, … beside `scene`/images; return the number of images written.

    Pixels are means over areas; names, folders and file formats stay; sizes are rounded as in Camera.downscaled.
    Images that exist stay unchanged, unless an earlier call has made them of others.
    Raises DataError when there are none, or when one cannot be read.
    """
    folder = scene / "images"
    names = sorted(path.relative_to(folder) for path in folder.rglob("*") if is_image(path))
    if not names:
        raise DataError(f"{folder}: holds no images; expected the folder above `images`")
    made = {2**k: Made(scene / f"images_{2**k}") for k in range(1, levels + 1)}
    written, count = 0, Count("photographs resized", len(names))
    for number, name in enumerate(names, 1):
        content = hash_of(folder / name)
        due = [factor for factor, record in made.items() if record.is_due(record.folder / name, content)]
        pixels = read_image(folder / name) if due else None
        for factor in due:
            assert pixels is not None
            _write(scene / f"images_{factor}" / name, pixels, factor)
            written += 1
        count.reach(number)
    return written


def _write(path: Path, pixels: NDArray[Any], factor: int) -> None:
    height, width = pixels.shape[:2]
    size = max(1, round(width / factor)), max(1, round(height / factor))
    small = np.rint(cv2.resize(pixels.astype(np.float32), size, interpolation=cv2.INTER_AREA)).astype(pixels.dtype)
    ordered = small.reshape(size[1], size[0], -1)[:, :, [2, 1, 0, 3][: pixels.shape[2]]]
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if path.suffix.lower() in (".jpg", ".jpeg") else []
    _, encoded = cv2.imencode(path.suffix, np.ascontiguousarray(ordered), options)
    with atomic(path) as file:
        file.write(encoded.tobytes())
