"""Find SIFT features of photographs (Lowe 2004) with OpenCV, and store them in COLMAP's database.

Images are stored in order of their names, so the same photographs always produce the same database.  The features of
each photograph are written in one transaction, so a run that was killed resumes at the next photograph.
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
    find_images_without_features,
    open_database,
    raising_data_error,
    read_image_names,
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
LAYERS, MAX_EDGE, BLUR = 3, 10.0, 1.6  # Lowe 2004: scales per octave, ratio of principal curvatures, sigma in px
LEVELS = 512  # scale of RootSIFT values, as COLMAP stores them; values above 255 are clipped


@dataclass(frozen=True)
class FeatureOptions:
    """Settings of the feature detector."""

    long_side: int = 1600  # px; larger images are downscaled
    count: int = 12288  # maximum number of features per image
    contrast: float = 0.02  # threshold, as a fraction of the gray range; the default of COLMAP, and 0.04 in Lowe 2004
    min_side: int = 0  # px; images whose long side is shorter are enlarged to twice their size


def find_features(
    photographs: Path,
    out: Path,
    options: FeatureOptions = FeatureOptions(),
    camera_model: CameraModel = "SIMPLE_RADIAL",
    cameras: Cameras = "auto",
    excluded_folder: Path | None = None,
) -> dict[str, Any]:
    """Find the features of the photographs in a folder, and write a COLMAP database in the folder `out`.

    Returns the number of photographs, the number of cameras, and a dict from the names of unreadable photographs to the
    reasons.  Photographs with an EXIF rotation are copied upright; others are linked.  With `cameras: auto`,
    photographs of the same size share a camera if EXIF names the same lens for them, or no lens.  Raises DataError
    when fewer than three photographs can be read.
    """
    pycolmap = require_pycolmap()
    names, read_errors = gather(photographs, out / IMAGES, list_photographs(photographs, excluded_folder))
    groups = group_photos(out / IMAGES, names, cameras)
    result = {"photographs": len(names), "cameras": len(groups), "damaged": read_errors}
    log_warnings(result)
    if camera_model != "EQUIRECTANGULAR" and all(_is_panorama(out / IMAGES / group[0]) for group in groups):
        LOG.warning(
            "the photos are twice as wide as they are high, like panoramas; "
            "for panoramas, use --set find_features.camera_model=EQUIRECTANGULAR"
        )
    if note := shared_camera_note(out / IMAGES, groups):
        LOG.info("%s", note)
    with raising_data_error(photographs, "find features"):
        if read_image_names(pycolmap, out / DATABASE) != sorted(names):  # a new or an incomplete database
            remove_database(out / DATABASE)
            _register(pycolmap, out, groups, camera_model)
    add_features(out / IMAGES, out / DATABASE, options)
    return result


def _is_panorama(photograph: Path) -> bool:
    """Return whether a photograph is twice as wide as high."""
    header = read_header(photograph)
    return header.width == 2 * header.height


def add_features(images: Path, database: Path, options: FeatureOptions) -> None:
    """Find the features of the photographs in a database that have no features yet.

    Raises DataError when a photograph cannot be read, or when pycolmap fails.
    """
    pycolmap = require_pycolmap()
    with raising_data_error(images, "find features"), open_database(pycolmap, database) as db:
        names_by_id = find_images_without_features(db)
        for image_id, name in counted(names_by_id.items(), "photos with features", len(names_by_id)):
            pixels, (scale_x, scale_y) = read_gray(images / name, options.long_side)
            keypoints, descriptors = detect_sift(pixels, options)
            keypoints[:, :3] *= scale_x, scale_y, (scale_x + scale_y) / 2
            with pycolmap.DatabaseTransaction(db):
                db.write_keypoints(image_id, keypoints)
                feature_type = pycolmap.FeatureExtractorType.SIFT
                db.write_descriptors(image_id, pycolmap.FeatureDescriptors(data=descriptors, type=feature_type))


def detect_sift(pixels: NDArray[np.uint8], options: FeatureOptions) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the keypoints, [M, 4], and descriptors, [M, 128], of the features with the highest contrast.

    Keypoints are x, y and scale in px, and the angle in radians, as COLMAP stores them: pixel (0, 0) has its center at
    (0.5, 0.5).  Descriptors are RootSIFT (Arandjelović and Zisserman 2012).
    """
    detector = cv2.SIFT.create(
        nfeatures=options.count,
        nOctaveLayers=LAYERS,
        contrastThreshold=options.contrast,
        edgeThreshold=MAX_EDGE,
        sigma=BLUR,
        enable_precise_upscale=True,
    )
    factor = 2 if max(pixels.shape) < options.min_side else 1
    enlarged = cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    points, raw_descriptors = detector.detectAndCompute(enlarged, None)
    if not points:
        return np.empty((0, 4), np.float32), np.empty((0, 128), np.uint8)
    best = np.argsort([-point.response for point in points], kind="stable")[: options.count]
    keypoints = [
        ((p.pt[0] + 0.5) / factor, (p.pt[1] + 0.5) / factor, p.size / 2 / factor, np.deg2rad(p.angle)) for p in points
    ]
    fractions = raw_descriptors / np.maximum(raw_descriptors.sum(axis=1, keepdims=True), 1.0e-6)
    descriptors = np.clip(np.rint(LEVELS * np.sqrt(fractions)), 0, 255).astype(np.uint8)
    return np.array(keypoints, np.float32)[best], descriptors[best]


def _register(pycolmap: ModuleType, out: Path, groups: Sequence[Sequence[str]], camera_model: CameraModel) -> None:
    """Write the images to a new database, with one camera per group.  Focal lengths come from EXIF if it has them."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera_model
    camera_ids: Mapping[str, int] = {name: i for i, group in enumerate(groups, 1) for name in group}
    with open_database(pycolmap, out / DATABASE) as db, pycolmap.DatabaseTransaction(db):
        for camera_id, group in enumerate(groups, 1):
            camera = pycolmap.infer_camera_from_image(out / IMAGES / group[0], reader)
            camera.camera_id = camera_id
            db.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig()
            rig.rig_id = camera_id
            rig.add_ref_sensor(camera.sensor_id)
            db.write_rig(rig, use_rig_id=True)
        for image_id, name in enumerate(sorted(camera_ids), 1):
            image = pycolmap.Image(name=name, camera_id=camera_ids[name], image_id=image_id)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame()
            frame.frame_id, frame.rig_id = image_id, camera_ids[name]
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
