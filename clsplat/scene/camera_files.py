"""Write cameras for other programs (COLMAP, nerfstudio, and INRIA's 3DGS), and read the cameras of INRIA's 3DGS."""

import json
import logging
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from clsplat.core.errors import ConfigError, DataError, PoseError, quote
from clsplat.core.files import open_atomic, path_exists, write_text
from clsplat.core.progress import counted
from clsplat.core.reading import open_file, read_json
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL, Camera
from clsplat.scene.colmap_writer import FILES, MODEL, write_colmap
from clsplat.scene.images import EXPOSURES_FILE, is_image, write_exposures
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import Scene
from clsplat.scene.transforms_json import POINTS_FILE, TRANSFORMS_FILE, JsonFrame, opengl_matrix
from clsplat.scene.view import NO_FILE, Floats, View, load_exposures, photo_lens

# Rename the views of a scene to the paths of their images in one folder.

IMAGES = "images"  # the folder of the photographs, as in COLMAP and nerfstudio


def with_image_names(scene: Scene) -> Scene:
    """Return the scene with views named like their images.

    Raises DataError for duplicate names, and for names with unprintable characters or spaces at either end.
    """
    names = []
    for view in scene.views:  # some formats leave out the suffix of the file
        has_suffix = is_image(PurePosixPath(view.name)) or view.image_path == NO_FILE
        names.append(view.name if has_suffix else f"{view.name}{view.image_path.suffix}")
    if all(name.startswith(f"{IMAGES}/") for name in names):
        names = [name.removeprefix(f"{IMAGES}/") for name in names]
    previous_names: set[str] = set()
    for name in names:
        if not name.isprintable() or name != name.strip():
            raise DataError(f"{scene.path}: an image is named {quote(name)}; remove spaces at its ends and line breaks")
        if name in previous_names:
            raise DataError(f"{scene.path}: two images would be named {quote(name)}; rename one")
        previous_names.add(name)
    return scene.renamed(names)


def plan_copies(views: Sequence[View], folder: Path) -> dict[Path, Path]:
    """Return a dictionary from the path of each copy in `folder` to the path of the photograph to copy.

    Raises DataError if a view has no photograph or is one face of a wide photograph.
    """
    for view in views:
        if view.image_path == NO_FILE:
            raise DataError(f"the view {quote(view.name)} has no photo to copy; write only the cameras")
        if view.lens is not None and view.lens.is_wide:
            raise DataError(
                f"the view {quote(view.name)} is part of a wide photo; run `clsplat data undistort` first, "
                "or write only the cameras"
            )
    return {folder / view.name: view.image_path for view in views}


LOG = logging.getLogger("clsplat")

# cameras.json, which the reference implementation of 3DGS writes next to a model (Kerbl et al. 2023).

INRIA_FILE = "cameras.json"
MAX_BYTES = 1 << 27
MAX_VIEWS = 100_000
TOLERANCE = 0.5  # px: smaller offsets come from different conventions for pixel centers


def write_inria(out: Path, scene: Scene) -> list[Path]:
    """Write out/cameras.json, without points and tracks, and return its path in a list.  Raises OutputError.

    Warns if a principal point is not at the center of the image, because other programs assume that it is.
    """
    write_text(out / INRIA_FILE, json.dumps([_entry(view, i) for i, view in enumerate(scene.views)], indent=1) + "\n")
    cameras = [view.camera for view in scene.views]
    offset = max(max(abs(c.cx - c.width / 2), abs(c.cy - c.height / 2)) for c in cameras)
    if offset > TOLERANCE:
        LOG.warning(
            "%s: other programs assume that the principal point is the image center; it is up to %.1f px away",
            *(out / INRIA_FILE, offset),
        )
    return [out / INRIA_FILE]


def _entry(view: View, index: int) -> dict[str, Any]:
    camera, pose = view.camera, view.world_to_camera
    return {
        "id": index,
        "img_name": view.name,
        "width": camera.width,
        "height": camera.height,
        "position": view.position.tolist(),
        "rotation": pose[:, :3].T.tolist(),
        "fy": camera.fy,
        "fx": camera.fx,
        "cx": camera.cx,
        "cy": camera.cy,
    }


def read_inria(path: Path) -> list[View]:
    """Return the views of a cameras.json, without photographs.

    Raises DataError if the file has another format, or if its values are invalid.
    """
    rows = read_json(path, "a cameras.json of 3DGS", limit=MAX_BYTES)
    if not isinstance(rows, list) or not 1 <= len(rows) <= MAX_VIEWS or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{path}: expected a list of 1 to {MAX_VIEWS} cameras, as 3DGS writes it: export it again")
    return [_make_view(JsonFrame(path.parent, f"{path}: [{i}]", row), i) for i, row in enumerate(rows)]


def _make_view(frame: JsonFrame, index: int) -> View:
    width, height, fx, fy = (frame.number(key) or 0.0 for key in ("width", "height", "fx", "fy"))
    if min(width, height) < 1 or max(width, height) > MAX_SIDE or min(fx, fy) < MIN_FOCAL:
        raise DataError(
            f"{frame.source}: the camera is {width:g}x{height:g} with focal lengths {fx:g}, {fy:g}; expected positive "
            f"numbers, and sizes of at most {MAX_SIDE}: export the file again"
        )
    cx, cy = frame.number("cx"), frame.number("cy")
    camera = Camera(int(width), int(height), fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    name = frame.value("img_name")
    rotation, position = _read_array(frame, "rotation", (3, 3)), _read_array(frame, "position", (3,))
    try:
        pose = np.column_stack([rotation.T, -rotation.T @ position])
        return View(name if isinstance(name, str) else f"{index:05d}", camera, pose)
    except PoseError as error:
        raise DataError(f"{frame.source}: {error}; remove that camera or export the file again") from error


def _read_array(frame: JsonFrame, key: str, shape: tuple[int, ...]) -> Floats:
    array = frame.array(key)
    if array.shape != shape or not np.isfinite(array).all():
        fault = f"{key} is {quote(frame.value(key))}; expected finite numbers of shape {shape}"
        raise DataError(f"{frame.source}: {fault}; export the file again")
    return array


# nerfstudio's transforms.json, with points3d.ply next to it.

DISTORTION = {  # by COLMAP's model: nerfstudio's model, and its names of the distortion parameters
    "SIMPLE_PINHOLE": ("OPENCV", ()),
    "PINHOLE": ("OPENCV", ()),
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}

REMEDY = "use --format colmap, or run `clsplat data undistort` first"


def write_nerfstudio(out: Path, scene: Scene) -> list[Path]:
    """Write out/transforms.json and the points (without their tracks), if there are any; return the paths.

    The test views are also listed as validation views, which nerfstudio evaluates.  Raises OutputError.
    """
    lenses = [_lens_fields(view) for view in scene.views]
    model, common_fields = lenses[0]["camera_model"], lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    matrices = [opengl_matrix(view.world_to_camera).tolist() for view in scene.views]
    frames = [
        {
            "file_path": f"{IMAGES}/{view.name}",
            **({} if common_fields else {key: value for key, value in lens.items() if key != "camera_model"}),
            **({} if view.time is None else {"time": view.time}),
            "transform_matrix": matrix,
        }
        for view, lens, matrix in zip(scene.views, lenses, matrices, strict=True)
    ]
    document: dict[str, Any] = {"camera_model": model, **common_fields, "frames": frames}
    if scene.test:
        names = [f"{IMAGES}/{view.name}" for view in scene.views]
        train = [name for i, name in enumerate(names) if i not in scene.test]
        test = [name for i, name in enumerate(names) if i in scene.test]
        document |= {"train_filenames": train, "val_filenames": test, "test_filenames": test}
    files = [out / TRANSFORMS_FILE]
    if scene.points is not None:
        document["ply_file_path"] = POINTS_FILE
        write_points_ply(out / POINTS_FILE, scene.points)
        files.append(out / POINTS_FILE)
    write_text(out / TRANSFORMS_FILE, json.dumps(document, indent=1) + "\n")
    return files


def _lens_fields(view: View) -> dict[str, Any]:
    lens = photo_lens(view)
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


# The formats by name.

WRITERS: dict[str, Callable[[Path, Scene], list[Path]]] = {
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
    "inria": write_inria,
}
OUTPUTS = {  # the files of each format
    "colmap": [MODEL / name for name in FILES],
    "nerfstudio": [Path(TRANSFORMS_FILE), Path(POINTS_FILE)],
    "inria": [Path(INRIA_FILE)],
}
UNDISTORTED = ("inria",)  # formats without lens distortion
COPIES = ("none", "copy")  # the values of `images` in write_cameras
SPLIT_FORMAT = "nerfstudio"  # the format that stores the split and times
TRACKS_FORMAT = "colmap"  # the format that stores which points each photograph shows


def check_cameras(scene: Scene, format_: str) -> None:
    """Raise DataError if a format cannot store the cameras of a scene."""
    views, view_by_model = with_image_names(scene).views, dict[str, str]()
    for view in views if format_ == "nerfstudio" else ():
        if (model := photo_lens(view).model) not in DISTORTION:
            raise DataError(f"{view.name}: nerfstudio has no camera model {model}; {REMEDY}")
        view_by_model[DISTORTION[model][0]] = view.name
    if len(view_by_model) > 1:
        model, name = view_by_model.popitem()
        other_model = next(iter(view_by_model))
        raise DataError(
            f"{name}: has the camera model {model}, but others have {other_model}; nerfstudio allows only one; {REMEDY}"
        )


def write_cameras(scene: Scene, out: Path, format_: str, images: str = "none", overwrite: bool = False) -> list[Path]:
    """Write the cameras of a scene and, with `images="copy"`, copies of the photographs and their exposures.

    Returns the paths of the camera files.  The scene must not be downscaled.  overwrite: whether to replace existing
    files.  Raises ConfigError for an unknown format and for an existing file, and DataError if the format cannot store
    the scene.
    """
    for name, value, choices in (("format", format_, tuple(WRITERS)), ("images", images, COPIES)):
        if value not in choices:
            raise ConfigError(f"{name}: expected one of {', '.join(choices)}, got {quote(value)}")
    scene = scene.in_world()
    check_cameras(scene, format_)
    renamed_scene = with_image_names(scene)
    if images == "copy" and format_ in UNDISTORTED and any(view.lens is not None for view in scene.views):
        raise DataError(
            f"{scene.path}: {format_} has no lens distortion, and these photos are distorted; "
            "run `clsplat data undistort` first, or write only the cameras"
        )
    copies = plan_copies(renamed_scene.views, out / IMAGES) if images == "copy" else {}
    sidecars = [out / IMAGES / EXPOSURES_FILE] if copies else []
    for path in () if overwrite else (*(out / file for file in OUTPUTS[format_]), *copies, *sidecars):
        if path_exists(path):
            raise ConfigError(f"{path}: exists; choose another folder, or remove the file")
    files = WRITERS[format_](out, renamed_scene)
    if format_ != SPLIT_FORMAT and scene.test:
        count = f"{len(scene.test)} of {len(scene.views)}"
        LOG.warning("%s: %s does not store which %s views are test views; %s does", out, format_, count, SPLIT_FORMAT)
    if format_ != SPLIT_FORMAT and any(view.time is not None for view in scene.views):
        LOG.warning("%s: %s does not store the times of the views; %s does", out, format_, SPLIT_FORMAT)
    if format_ != TRACKS_FORMAT and copies and scene.tracks is not None:
        LOG.warning("%s: %s does not store which points the photos show; %s does", out, format_, TRACKS_FORMAT)
    for path, source in counted(copies.items(), "photos copied", len(copies)):
        with open_file(source, "an image") as src, open_atomic(path) as dst:
            shutil.copyfileobj(src, dst)
    if copies:
        exposures = load_exposures(scene.views)  # looked up by the names in the dataset
        write_exposures(out / IMAGES, dict(zip((view.name for view in renamed_scene.views), exposures, strict=True)))
    return files
