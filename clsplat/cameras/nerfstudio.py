"""nerfstudio's transforms.json, with points3d.ply beside it."""

import json
from pathlib import Path
from typing import Any

from clsplat.cameras.posed import IMAGES, Posed
from clsplat.errors import DataError
from clsplat.files import write_text
from clsplat.scene.lens import Lens
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud
from clsplat.scene.transforms import opengl_matrix

FILE, POINTS = "transforms.json", "points3d.ply"
DISTORTION = {  # of COLMAP's models: the model that nerfstudio knows, and the names of what follows the middle
    "SIMPLE_PINHOLE": ("OPENCV", ()),
    "PINHOLE": ("OPENCV", ()),
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}


def write(out: Path, views: list[Posed], points: PointCloud | None) -> list[Path]:
    """Write out/transforms.json, and the points where there are some; return the files.

    Raises DataError for a lens that nerfstudio has no name for, OutputError where it cannot be written.
    """
    lenses = [_lens(one) for one in views]
    common = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    matrices = [opengl_matrix(one.view.world_to_camera).tolist() for one in views]
    frames = [
        {"file_path": f"{IMAGES}/{one.name}", **({} if common else lens), "transform_matrix": matrix}
        for one, lens, matrix in zip(views, lenses, matrices, strict=True)
    ]
    table: dict[str, Any] = {**common, "frames": frames}
    for name, test in (("train_filenames", False), ("test_filenames", True)):
        table[name] = [f"{IMAGES}/{one.name}" for one in views if one.test is test]
    written = [out / FILE]
    if points is not None:
        table["ply_file_path"] = POINTS
        write_points_ply(out / POINTS, points)
        written.append(out / POINTS)
    write_text(out / FILE, json.dumps(table, indent=1) + "\n")
    return written


def _lens(one: Posed) -> dict[str, Any]:
    lens: Lens = one.lens
    if lens.model not in DISTORTION:
        raise DataError(
            f"{one.name}: nerfstudio has no camera model {lens.model}; write colmap, or `clsplat data undistort` first"
        )
    model, names = DISTORTION[lens.model]
    camera, distortion = lens.camera, lens.params[len(lens.params) - len(names) :]
    return {
        "camera_model": model,
        "w": lens.width,
        "h": lens.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        **dict(zip(names, distortion, strict=True)),
    }
