"""Files of cameras for other programs: COLMAP, nerfstudio and INRIA, read and written."""

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
from clsplat.scene.camera import MAX_SIDE, MIN_FOCAL, Camera, Lens
from clsplat.scene.colmap_writer import FILES, MODEL, write_colmap
from clsplat.scene.images import EXPOSURES_FILE, is_image, write_exposures
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud, Scene, Tracks
from clsplat.scene.transforms_json import JsonFrame, opengl_matrix
from clsplat.scene.view import NO_FILE, PosedView, View, load_exposures

# The views of a scene as files name them: unique names of images below one folder, and lenses.

IMAGES = "images"  # the folder of the photographs, as COLMAP and nerfstudio have it


def posed_views(scene: Scene) -> list[PosedView]:
    """Return the views in their order.  Raises DataError for names that no line of text can hold, or that repeat."""
    names = [_file_name(view) for view in scene.views]
    if all(name.startswith(f"{IMAGES}/") for name in names):
        names = [name.removeprefix(f"{IMAGES}/") for name in names]
    seen: set[str] = set()
    for name in names:
        if not name.isprintable() or name != name.strip():
            raise DataError(f"{scene.path}: an image is called {quote(name)}; expected a name in one line of text")
        if name in seen:
            raise DataError(f"{scene.path}: two images would be called {quote(name)}; rename one")
        seen.add(name)
    test = set(scene.test)
    return [PosedView(name, view, i in test) for i, (name, view) in enumerate(zip(names, scene.views, strict=True))]


def _file_name(view: View) -> str:
    """A view's name with the suffix of its file, which some formats leave out."""
    name = PurePosixPath(view.name)
    if is_image(name) or view.image_path == NO_FILE:
        return view.name
    return f"{view.name}{view.image_path.suffix}"


def image_files(views: list[PosedView], folder: Path) -> dict[Path, Path]:
    """Return where each photograph lies, by where it belongs below a folder.  Raises DataError without a photograph."""
    for one in views:
        if one.view.image_path == NO_FILE:
            raise DataError(f"the view {quote(one.name)} has no photograph to copy; write the cameras alone")
        if one.view.lens is not None and one.view.lens.is_wide:
            raise DataError(
                f"the view {quote(one.name)} is a part of a wide photograph; `clsplat data undistort` first, "
                "or write the cameras alone"
            )
    return {folder / one.name: one.view.image_path for one in views}


# What a file of cameras cannot hold, and takes from them: said in a line.

LOG = logging.getLogger("clsplat")
TOLERANCE = 0.5  # px: less is no more than a convention about the middle of a pixel


def warn_center_lost(path: Path, cameras: Sequence[Camera]) -> None:
    """Warn where readers of a file look for the principal point elsewhere than it is."""
    off = max(max(abs(c.cx - c.width / 2), abs(c.cy - c.height / 2)) for c in cameras)
    if off > TOLERANCE:
        LOG.warning(
            "%s: other programs take the middle of the image for the principal point, which is up to %.1f px away",
            *(path, off),
        )


# cameras.json, as the reference implementation of 3DGS writes it next to a model (Kerbl et al. 2023).

INRIA_FILE = "cameras.json"
MAX_BYTES = 1 << 27
MAX_VIEWS = 100_000


def write_inria(out: Path, views: list[PosedView], points: PointCloud | None, tracks: Tracks | None) -> list[Path]:
    """Write out/cameras.json; return it.  Points and tracks have no place in it.  Raises OutputError."""
    write_text(out / INRIA_FILE, json.dumps([_camera(one, i) for i, one in enumerate(views)], indent=1) + "\n")
    warn_center_lost(out / INRIA_FILE, [one.view.camera for one in views])
    return [out / INRIA_FILE]


def _camera(one: PosedView, number: int) -> dict[str, Any]:
    camera, pose = one.view.camera, one.view.world_to_camera
    return {
        "id": number,
        "img_name": one.name,
        "width": camera.width,
        "height": camera.height,
        "position": one.view.position.tolist(),
        "rotation": pose[:, :3].T.tolist(),
        "fy": camera.fy,
        "fx": camera.fx,
        "cx": camera.cx,
        "cy": camera.cy,
    }


def read_inria(path: Path) -> list[View]:
    """Return the views of a cameras.json, without photographs.

    Raises DataError for another file and for damaged numbers.
    """
    table = read_json(path, "a cameras.json of 3DGS", limit=MAX_BYTES)
    if not isinstance(table, list) or not 1 <= len(table) <= MAX_VIEWS or not all(isinstance(v, dict) for v in table):
        raise DataError(f"{path}: expected a list of 1 to {MAX_VIEWS} cameras, as 3DGS writes it")
    return [_view(JsonFrame(path.parent, f"{path}: [{i}]", one), i) for i, one in enumerate(table)]


def _view(one: JsonFrame, number: int) -> View:
    width, height, fx, fy = (one.number(key) or 0.0 for key in ("width", "height", "fx", "fy"))
    if min(width, height) < 1 or max(width, height) > MAX_SIDE or min(fx, fy) < MIN_FOCAL:
        raise DataError(
            f"{one.where}: the camera is {width:g}x{height:g} with focal lengths {fx:g}, {fy:g}; expected positive "
            f"numbers, sizes of at most {MAX_SIDE}: export the file again"
        )
    cx, cy = one.number("cx"), one.number("cy")
    camera = Camera(int(width), int(height), fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    name = one.value("img_name")
    rotation, position = _array(one, "rotation", (3, 3)), _array(one, "position", (3,))
    try:
        pose = np.column_stack([rotation.T, -rotation.T @ position])
        return View(name if isinstance(name, str) else f"{number:05d}", camera, pose)
    except PoseError as error:
        raise DataError(f"{one.where}: {error}; remove that camera or export the file again") from error


def _array(one: JsonFrame, key: str, shape: tuple[int, ...]) -> "np.ndarray[Any, np.dtype[np.float64]]":
    try:
        array = np.array(one.value(key), np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise DataError(f"{one.where}: {key} is {quote(one.value(key))}; expected finite numbers, {shape}")
    return array


# nerfstudio's transforms.json, with points3d.ply next to it.

NERFSTUDIO_FILE, POINTS = "transforms.json", "points3d.ply"
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


def write_nerfstudio(out: Path, views: list[PosedView], points: PointCloud | None, tracks: Tracks | None) -> list[Path]:
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
    written = [out / NERFSTUDIO_FILE]
    if points is not None:
        table["ply_file_path"] = POINTS
        write_points_ply(out / POINTS, points)
        written.append(out / POINTS)
    write_text(out / NERFSTUDIO_FILE, json.dumps(table, indent=1) + "\n")
    return written


def check_nerfstudio(views: list[PosedView]) -> None:
    """Raise DataError for a lens that nerfstudio has no name for, and for kinds of lenses that one file cannot hold."""
    kinds = {}
    for one in views:
        if one.lens.model not in DISTORTION:
            raise DataError(f"{one.name}: nerfstudio has no camera model {one.lens.model}; {REMEDY}")
        kinds[DISTORTION[one.lens.model][0]] = one.name
    if len(kinds) > 1:
        model, name = kinds.popitem()
        raise DataError(
            f"{name}: is {model}, other views are {next(iter(kinds))}; nerfstudio allows one model per file; {REMEDY}"
        )


def _lens(one: PosedView) -> dict[str, Any]:
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


# The formats by their names.

WRITERS: dict[str, Callable[[Path, list[PosedView], PointCloud | None, Tracks | None], list[Path]]] = {
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
    "inria": write_inria,
}
PLACES = {  # that each writes
    "colmap": [MODEL / name for name in FILES],
    "nerfstudio": [Path(NERFSTUDIO_FILE), Path(POINTS)],
    "inria": [Path(INRIA_FILE)],
}
UNDISTORTED = ("inria",)  # formats of cameras without lenses
COPIES = ("none", "copy")  # of the photographs
SPLIT = "nerfstudio"  # what keeps it, and times
TRACKS = "colmap"  # what keeps which points the photographs show


def check_cameras(scene: Scene, format_: str) -> list[PosedView]:
    """Return the views as a format names them.  Raises DataError for what it cannot hold."""
    views = posed_views(scene)
    if format_ == "nerfstudio":
        check_nerfstudio(views)
    return views


def write_cameras(scene: Scene, out: Path, format_: str, images: str = "none", over: bool = False) -> list[Path]:
    """Write the cameras of a scene, and the photographs where they are to be copied, with what their cameras noted of
    the exposures; return the files of cameras.

    The views have the size of the dataset.  over: whether files there may be replaced.
    Raises ConfigError for another name and where a file is there, DataError where the format cannot hold the scene.
    """
    for what, value, known in (("format", format_, tuple(WRITERS)), ("images", images, COPIES)):
        if value not in known:
            raise ConfigError(f"no {what} {quote(value)}; there are {', '.join(known)}")
    scene = scene.in_world()
    views = check_cameras(scene, format_)
    if images == "copy" and format_ in UNDISTORTED and any(one.view.lens is not None for one in views):
        raise DataError(
            f"{scene.path}: {format_} holds cameras of undistorted photographs, and these are distorted; "
            "`clsplat data undistort` first, or write the cameras alone"
        )
    copies = image_files(views, out / IMAGES) if images == "copy" else {}
    sidecars = [out / IMAGES / EXPOSURES_FILE] if copies else []
    for path in () if over else (*(out / place for place in PLACES[format_]), *copies, *sidecars):
        if path_exists(path):
            raise ConfigError(f"{path}: exists; give another folder for the cameras, or remove it")
    written = WRITERS[format_](out, views, scene.points, scene.tracks)
    if format_ != SPLIT and scene.test:
        lost = f"{len(scene.test)} of {len(views)}"
        LOG.warning("%s: %s does not keep which views are for testing, %s; %s does", out, format_, lost, SPLIT)
    if format_ != SPLIT and any(one.view.time is not None for one in views):
        LOG.warning("%s: %s does not keep the times of the views; %s does", out, format_, SPLIT)
    if format_ != TRACKS and copies and scene.tracks is not None:
        LOG.warning("%s: %s does not keep which points the photographs show; %s does", out, format_, TRACKS)
    for path, source in counted(copies.items(), "photographs copied", len(copies)):
        with open_file(source, "an image") as old, open_atomic(path) as new:
            shutil.copyfileobj(old, new)
    if copies:
        found = load_exposures([one.view for one in views])
        write_exposures(out / IMAGES, {one.name: exposure for one, exposure in zip(views, found, strict=True)})
    return written
