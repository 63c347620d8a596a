"""Write a camera path as nerfstudio does."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clsplat.scene.transforms_json import opengl_matrix
from clsplat.scene.view import View


def write_camera_path(path: Path, views: Sequence[View], fps: float) -> None:
    """Write views as a camera_path.json, which holds only the vertical field of view of a lens."""
    camera = views[0].camera
    table = {
        "camera_type": "perspective",
        "render_width": camera.width,
        "render_height": camera.height,
        "fps": fps,
        "seconds": len(views) / fps,
        "camera_path": [_frame(view) for view in views],
    }
    path.write_text(json.dumps(table, indent=1))


def _frame(view: View) -> dict[str, Any]:
    camera, matrix = view.camera, opengl_matrix(view.world_to_camera)
    fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
    time = {} if view.time is None else {"render_time": view.time}
    return {"camera_to_world": matrix.ravel().tolist(), "fov": fov, "aspect": camera.width / camera.height, **time}
