"""Find SIFT features of photographs (Lowe 2004) with OpenCV, and store them in COLMAP's database.

The database has the images in order of their names, so that the same photographs give the same rows.  The features of
each photograph are written in one transaction, so a killed call can be resumed with the next photograph.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.progress import counted
from clsplat.prepare.database import (
    DATABASE,
    IMAGES,
    image_names,
    images_without_features,
    open_database,
    raising_data_error,
    remove_database,
    require_pycolmap,
)
from clsplat.prepare.gather import gather, list_photographs, log_warnings
from clsplat.prepare.shared_intrinsics import Cameras, group_photos, shared_camera_note
from clsplat.scene.images import read_gray, read_header

LOG = logging.getLogger("clsplat")
CameraModel = Literal[
    "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "EQUIRECTANGULAR"
]
LAYERS, MAX_EDGE, BLUR = 3, 10.0, 1.6  # Lowe 2004: scales of an octave, ratio of curvatures, px
LEVELS = 512  # scale of RootSIFT values, as COLMAP stores them; values above 255 are clipped


@dataclass(frozen=True)
class FeatureOptions:
    """Find at most `count` features in an image of `long_side` px; `contrast` is a fraction of the gray range."""

    long_side: int = 1600
    count: int = 12288
    contrast: float = 0.02  # COLMAP's; Lowe 2004 has 0.04


def find_features(
    photographs: Path,
    out: Path,
    options: FeatureOptions = FeatureOptions(),
    camera_model: CameraModel = "SIMPLE_RADIAL",
    cameras: Cameras = "auto",
    excluded: Path | None = None,
) -> dict[str, Any]:
    """Find features; return the number of photographs and cameras, and why some photographs cannot be read.

    Photographs with an EXIF rotation are copied upright, others are linked.  With `cameras: auto`, photographs of the
    same size share a camera if EXIF has the same lens for them, or none.  Raises DataError when fewer than three
    photographs can be read.
    """
    pycolmap = require_pycolmap()
    names, damaged = gather(photographs, out / IMAGES, list_photographs(photographs, excluded))
    groups = group_photos(out / IMAGES, names, cameras)
    figures = {"photographs": len(names), "cameras": len(groups), "damaged": damaged}
    log_warnings(figures)
    if camera_model != "EQUIRECTANGULAR" and all(_is_panorama(out / IMAGES / group[0]) for group in groups):
        LOG.warning(
            "the photographs are twice as wide as high, like panoramas; "
            "for panoramas, use --set find_features.camera_model=EQUIRECTANGULAR"
        )
    if note := shared_camera_note(out / IMAGES, groups):
        LOG.info("%s", note)
    with raising_data_error(photographs, "find features"):
        if image_names(pycolmap, out / DATABASE) != sorted(names):  # a new or an incomplete database
            remove_database(out / DATABASE)
            _register(pycolmap, out, groups, camera_model)
    add_features(out / IMAGES, out / DATABASE, options)
    return figures


def _is_panorama(photograph: Path) -> bool:
    """Return whether a photograph is twice as wide as high."""
    header = read_header(photograph)
    return header.width == 2 * header.height


def add_features(images: Path, database: Path, options: FeatureOptions) -> None:
    """Find features of the photographs in a database that do not have any yet.  Raises DataError."""
    pycolmap = require_pycolmap()
    with raising_data_error(images, "find features"), open_database(pycolmap, database) as rows:
        missing = images_without_features(rows)
        for number, name in counted(missing.items(), "photographs with features", len(missing)):
            pixels, (scale_x, scale_y) = read_gray(images / name, options.long_side)
            keypoints, descriptors = sift(pixels, options)
            keypoints[:, :3] *= scale_x, scale_y, (scale_x + scale_y) / 2
            with pycolmap.DatabaseTransaction(rows):
                rows.write_keypoints(number, keypoints)
                kind = pycolmap.FeatureExtractorType.SIFT
                rows.write_descriptors(number, pycolmap.FeatureDescriptors(data=descriptors, type=kind))


def sift(pixels: NDArray[np.uint8], options: FeatureOptions) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the features with the highest contrast as COLMAP stores them: x, y, scale in px and angle, [M, 4], and
    the descriptors, [M, 128].

    Pixel (0, 0) has its center at (0.5, 0.5).  Descriptors are RootSIFT (Arandjelović and Zisserman 2012).
    """
    detector = cv2.SIFT.create(
        nfeatures=options.count,
        nOctaveLayers=LAYERS,
        contrastThreshold=options.contrast,
        edgeThreshold=MAX_EDGE,
        sigma=BLUR,
        enable_precise_upscale=True,
    )
    points, raw = detector.detectAndCompute(pixels, None)
    if not points:
        return np.empty((0, 4), np.float32), np.empty((0, 128), np.uint8)
    best = np.argsort([-point.response for point in points], kind="stable")[: options.count]
    keypoints = [(p.pt[0] + 0.5, p.pt[1] + 0.5, p.size / 2, np.deg2rad(p.angle)) for p in points]
    fractions = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1.0e-6)
    descriptors = np.clip(np.rint(LEVELS * np.sqrt(fractions)), 0, 255).astype(np.uint8)
    return np.array(keypoints, np.float32)[best], descriptors[best]


def _register(pycolmap: ModuleType, out: Path, groups: Sequence[Sequence[str]], camera_model: CameraModel) -> None:
    """Write the images into a new database, with one camera per group and its focal length from EXIF."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera_model
    camera_of: Mapping[str, int] = {name: number for number, group in enumerate(groups, 1) for name in group}
    with open_database(pycolmap, out / DATABASE) as rows, pycolmap.DatabaseTransaction(rows):
        for number, group in enumerate(groups, 1):
            camera = pycolmap.infer_camera_from_image(out / IMAGES / group[0], reader)
            camera.camera_id = number
            rows.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig()
            rig.rig_id = number
            rig.add_ref_sensor(camera.sensor_id)
            rows.write_rig(rig, use_rig_id=True)
        for number, name in enumerate(sorted(camera_of), 1):
            image = pycolmap.Image(name=name, camera_id=camera_of[name], image_id=number)
            rows.write_image(image, use_image_id=True)
            frame = pycolmap.Frame()
            frame.frame_id, frame.rig_id = number, camera_of[name]
            frame.add_data_id(image.data_id)
            rows.write_frame(frame, use_frame_id=True)
