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
from clsplat.scene.tracks import Tracks
from clsplat.scene.transforms import opengl_matrix

FILE, POINTS = "transforms.json", "points3d.ply"
DISTORTION = {  # of COLMAP's models: the model that nerfstudio knows, and the names of what follows the middle
    "SIMPLE_PINHOLE": ("OPENCV", ()),
    "PINHOLE": ("OPENCV", ()),
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}

REMEDY = "write colmap, or `clsplat data undistort` first"


def write(out: Path, views: list[Posed], points: PointCloud | None, tracks: Tracks | None) -> list[Path]:
    """Write out/transforms.json, and the points where there are some, without tracks; return the files.

    nerfstudio evaluates at the validation views, for which the test views are named too.
    Raises OutputError where it cannot be written.
    """
    lenses = [_lens(one) for one in views]
    model, common = lenses[0]["camera_model"], lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    matrices = [opengl_matrix(one.view.world_to_camera).tolist() for one in views]
    frames = [
        {
            "file_path": f"{IMAGES}/{one.name}",
            **({} if common else {key: value for key, value in lens.items() if key != "camera_model"}),
            **({} if one.view.time is None else {"time": one.view.time}),
            "transform_matrix": matrix,
        }
        for one, lens, matrix in zip(views, lenses, matrices, strict=True)
    ]
    table: dict[str, Any] = {"camera_model": model, **common, "frames": frames}
    if any(one.test for one in views):
        train, test = ([f"{IMAGES}/{one.name}" for one in views if one.test is held] for held in (False, True))
        table |= {"train_filenames": train, "val_filenames": test, "test_filenames": test}
    written = [out / FILE]
    if points is not None:
        table["ply_file_path"] = POINTS
        write_points_ply(out / POINTS, points)
        written.append(out / POINTS)
    write_text(out / FILE, json.dumps(table, indent=1) + "\n")
    return written


def check(views: list[Posed]) -> None:
    """Raise DataError for a lens that nerfstudio has no name for, and for kinds of lenses that one file cannot hold."""
    kinds = {}
    for one in views:
        if one.lens.model not in DISTORTION:
            raise DataError(f"{one.name}: nerfstudio has no camera model {one.lens.model}; {REMEDY}")
        kinds[DISTORTION[one.lens.model][0]] = one.name
    if len(kinds) > 1:
        model, name = kinds.popitem()
        raise DataError(f"{name}: {model}, and others are {next(iter(kinds))}; nerfstudio takes one; {REMEDY}")


def _lens(one: Posed) -> dict[str, Any]:
    lens: Lens = one.lens
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
