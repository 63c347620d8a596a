"""Structure from motion with pycolmap: from photographs to cameras and points, in three steps that can be repeated.

    find_features    photographs        -> images/, database.db
    match_features   images, database   -> images/, database.db with matches
    map_cameras      images, database   -> images/, sparse/0: a COLMAP folder

Each changes nothing in its source.  The first two go on where an interrupted call with the same photographs and
settings stopped; mapping starts again.  The same photographs and settings give the same cameras and points: images are
registered in order of their names before threads read them, every random number has a seed, and mapping runs in one
thread by default.
"""

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from clsplat.errors import DataError
from clsplat.files import write_text
from clsplat.progress import Count
from data_tools.gather import MIN_PHOTOGRAPHS, gather, link, list_photographs
from data_tools.pycolmap_import import require_pycolmap
from data_tools.vocabulary import alike

LOG = logging.getLogger("clsplat")
Matching = Literal["auto", "exhaustive", "sequential", "vocabulary"]
Mapper = Literal["incremental", "global"]
Cameras = Literal["auto", "one", "per_folder", "per_image"]
CameraModel = Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE"]
MAX_EXHAUSTIVE = 200  # photographs whose pairs are all matched: the time grows with the square of their number
CHUNK = 10  # photographs between two counts
DATABASE, IMAGES = "database.db", "images"


def find_features(
    photographs: Path,
    out: Path,
    long_side: int = 1600,
    features: int = 8192,
    camera_model: CameraModel = "SIMPLE_RADIAL",
    cameras: Cameras = "auto",
    without: Path | None = None,
) -> dict[str, Any]:
    """Find SIFT features (Lowe 2004) in photographs, at most `long_side` px large, for at most `features` of each.

    Photographs with an EXIF rotation are copied upright, others are linked.  With `cameras: auto`, photographs of one
    size and focal length share a camera.  Raises DataError when fewer than three can be read.
    """
    pycolmap = require_pycolmap()
    names = gather(photographs, out / IMAGES, list_photographs(photographs, without))
    database, mode = str(out / DATABASE), {"auto": "AUTO", "one": "SINGLE"}.get(cameras, cameras.upper())
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model = camera_model
    extraction.max_image_size, extraction.use_gpu = long_side, False
    extraction.sift.max_num_features = features
    with _explained(photographs, "find features"):
        pycolmap.Database.open(database).close()
        if _image_names(pycolmap, out / DATABASE) != sorted(names):  # a new database, or one cut short
            _remove(out / DATABASE)
            pycolmap.Database.open(database).close()
            pycolmap.import_images(
                database, str(out / IMAGES), getattr(pycolmap.CameraMode, mode), image_names=names, options=reader
            )
        missing, count = _without_features(pycolmap, out / DATABASE), Count("photographs with features", len(names))
        for start in range(0, len(missing), CHUNK):
            count.reach(len(names) - len(missing) + start)
            pycolmap.extract_features(
                database,
                str(out / IMAGES),
                missing[start : start + CHUNK],
                extraction_options=extraction,
                reader_options=reader,
                device=pycolmap.Device.cpu,
            )
        count.reach(len(names))
    return {"photographs": len(names)}


def match_features(source: Path, out: Path, matching: Matching = "auto", neighbours: int = 10) -> dict[str, Any]:
    """Match features between photographs: all pairs, each with the `neighbours` next ones by name, or similar ones.

    `auto` matches all pairs of up to 200 photographs; of more, each with the most similar ones.  Raises DataError when
    no pair matches.
    """
    pycolmap = require_pycolmap()
    link(source / IMAGES, out / IMAGES)
    database = out / DATABASE
    if not database.exists():  # pairs that it holds are not matched again
        half = out / f".{DATABASE}"
        shutil.copyfile(source / DATABASE, half)
        half.replace(database)
    count = len(_image_names(pycolmap, database))
    chosen = ("exhaustive" if count <= MAX_EXHAUSTIVE else "vocabulary") if matching == "auto" else matching
    options, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.use_gpu, verification.ransac.random_seed = False, 0
    common = {
        "matching_options": options,
        "verification_options": verification,
        "device": pycolmap.Device.cpu,
    }
    LOG.info("matching %d photographs, %s", count, chosen)
    with _explained(source, "match photographs"):
        if chosen == "sequential":
            pairing = pycolmap.SequentialPairingOptions()
            pairing.overlap = neighbours
            pycolmap.match_sequential(str(database), pairing_options=pairing, **common)
        elif chosen == "vocabulary":
            pairs = out / "pairs.txt"
            write_text(pairs, "".join(f"{a} {b}\n" for a, b in _alike_pairs(pycolmap, database, 2 * neighbours)))
            imported = pycolmap.ImportedPairingOptions()
            imported.match_list_path = pairs
            pycolmap.match_image_pairs(str(database), pairing_options=imported, **common)
        else:
            pycolmap.match_exhaustive(str(database), **common)
    verified = _matched_pairs(pycolmap, database)
    if verified == 0:
        raise DataError(
            f"{source / IMAGES}: no two of the {count} photographs show the same features; take photographs with more "
            "overlap, of a scene in which nothing moves"
        )
    return {"matching": chosen, "pairs": verified}


def map_cameras(source: Path, out: Path, mapper: Mapper = "incremental", threads: int = 1) -> dict[str, Any]:
    """Place cameras and points; keep the largest model as sparse/0 and log the others.

    `mapper: global` is faster for many photographs; more than one thread is faster and not repeatable to the bit.
    Raises DataError when no model has three images.
    """
    pycolmap = require_pycolmap()
    link(source / IMAGES, out / IMAGES)
    work = out / ".models"
    work.mkdir()
    names = _image_names(pycolmap, source / DATABASE)
    is_global = mapper == "global"
    options = pycolmap.GlobalPipelineOptions() if is_global else pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = 0
    options.min_model_size = MIN_PHOTOGRAPHS
    pycolmap.set_random_seed(0)
    with _explained(source / IMAGES, "place the cameras"):
        function = pycolmap.global_mapping if is_global else pycolmap.incremental_mapping
        paths = str(source / DATABASE), str(out / IMAGES), str(work)
        count = Count("photographs placed", len(names))

        def placed() -> None:
            count.reach(min(max(2, count.done) + 1, len(names)))

        watched = {} if is_global else {"next_image_callback": placed}
        models = list(function(*paths, options=options, **watched).values())
    shutil.rmtree(work)
    models.sort(key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    if not models or models[0].num_reg_images() < MIN_PHOTOGRAPHS:
        raise DataError(
            f"{source / IMAGES}: the {len(names)} photographs could not be placed; take more sharp ones, from "
            "places a step apart, of a textured scene in which nothing moves"
        )
    best = models[0]
    (out / "sparse" / "0").mkdir(parents=True)
    best.write(str(out / "sparse" / "0"))
    registered = {best.images[number].name for number in best.reg_image_ids()}
    missing = [name for name in names if name not in registered]
    if missing:
        LOG.warning("%d photographs could not be placed: %s", len(missing), ", ".join(missing[:8]))
    others = [model.num_reg_images() for model in models[1:]]
    if others:
        LOG.warning("%d smaller models, of %s images, are left out", len(others), ", ".join(map(str, others)))
    return {
        "registered": len(registered),
        "not_registered": missing,
        "other_models": others,
        "points": best.num_points3D(),
        "error_px": round(best.compute_mean_reprojection_error(), 3),
    }


def _alike_pairs(pycolmap: ModuleType, database: Path, neighbours: int) -> list[tuple[str, str]]:
    opened = pycolmap.Database.open(str(database))
    images = sorted(opened.read_all_images(), key=lambda image: image.name)
    tables = [np.asarray(opened.read_descriptors(image.image_id).data, np.float32) for image in images]
    opened.close()
    if spaced := [image.name for image in images if len(image.name.split()) > 1]:
        raise DataError(
            f"'{spaced[0]}': COLMAP's lists of pairs allow no spaces in names; rename it, or match all pairs"
        )
    return [(images[i].name, images[j].name) for i, j in alike(tables, neighbours)]


def _matched_pairs(pycolmap: ModuleType, database: Path) -> int:
    """Number of pairs whose matches pass geometric verification."""
    opened = pycolmap.Database.open(str(database))
    try:
        _, inliers = opened.read_two_view_geometry_num_inliers()
        return int(np.count_nonzero(inliers))
    finally:
        opened.close()


def _image_names(pycolmap: ModuleType, database: Path) -> list[str]:
    opened = pycolmap.Database.open(str(database))
    try:
        return sorted(image.name for image in opened.read_all_images())
    finally:
        opened.close()


def _without_features(pycolmap: ModuleType, database: Path) -> list[str]:
    """The names of images whose features are not in the database, or not all, sorted."""
    opened = pycolmap.Database.open(str(database))
    try:
        return sorted(
            image.name
            for image in opened.read_all_images()
            if not (opened.exists_keypoints(image.image_id) and opened.exists_descriptors(image.image_id))
        )
    finally:
        opened.close()


def _remove(database: Path) -> None:
    for file in database.parent.glob(f"{database.name}*"):  # with its journal
        file.unlink()


@contextmanager
def _explained(place: Path, what: str) -> Iterator[None]:
    """pycolmap's errors as one sentence."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        raise DataError(f"{place}: could not {what} ({str(error).splitlines()[0]}); check the photographs") from error
