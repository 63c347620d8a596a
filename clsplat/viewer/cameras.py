"""Cameras as the scripts of a page read them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.stand import Stand
from clsplat.scene.view import View


def stand_data(stand: Stand) -> dict[str, Any]:
    """Return where a page begins to look, as main.js reads it."""
    return {
        "pivot": rounded(stand.pivot),
        "up": rounded(stand.up),
        "radius": stand.radius,
        "focal": stand.focal,
        "start": camera_data(stand.start),
    }


def camera_data(view: View) -> dict[str, Any]:
    """Return a view's pose, by rows, and its lens as camera.js reads them."""
    c = view.camera
    moment = {} if view.time is None else {"time": view.time}
    lens = [c.fx, c.fy, c.cx, c.cy, c.width, c.height]
    return {"pose": rounded(view.world_to_camera.ravel()), "lens": lens, **moment}


def rounded(values: NDArray[np.floating]) -> list[float]:
    """Return numbers as short as single precision reads them."""
    return [float(f"{value:.9g}") for value in np.asarray(values, np.float64).tolist()]
