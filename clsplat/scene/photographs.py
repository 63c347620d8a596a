"""The photograph of a view for training: its colours and its mask."""

import hashlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.files import atomic
from clsplat.scene.images import read_image
from clsplat.scene.scene import View
from clsplat.scene.view import load_image, load_mask


def load_photograph(
    view: View, background: tuple[float, float, float], undistorted: Path | None = None
) -> NDArray[np.uint8]:
    """Return RGB, [H, W, 3], or with a mask RGB and 0 or 1, [H, W, 4].

    The folder `undistorted` keeps undistorted photographs, so that each is undistorted once.
    Raises DataError as load_image does.
    """
    if view.lens is None or undistorted is None:
        return _loaded(view, background)
    file = undistorted / f"{view.name}.{_key(view, background)}.png"
    try:
        return read_image(file).astype(np.uint8)
    except DataError:
        pixels = _loaded(view, background)
    order = [2, 1, 0, 3][: pixels.shape[2]]
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels[:, :, order]))
    with atomic(file) as stream:
        stream.write(encoded.tobytes())
    return pixels


def _key(view: View, background: tuple[float, float, float]) -> str:
    """A hash of the file, the lens, the size, and what is behind transparent pixels."""
    state = view.image_path.stat() if view.image_path.exists() else None
    file = state and (state.st_mtime_ns, state.st_size)
    parts = view.lens, view.camera, view.mask_path, view.alpha, background, file
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


def _loaded(view: View, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    pixels, mask = load_image(view, background), load_mask(view)
    return pixels if mask is None else np.dstack([pixels, mask.astype(np.uint8)])
