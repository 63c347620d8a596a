"""Structure from motion with pycolmap: from photographs to cameras and points, in three steps that can be repeated.

    find_features    photographs        -> images/, database.db
    match_features   images, database   -> images/, database.db with matches
    map_cameras      images, database   -> images/, sparse/0: a COLMAP folder

Each changes nothing in its source.  The first two go on where an interrupted call with the same photographs and
settings stopped; mapping starts again.  The same photographs and settings give the same cameras and points: images are
registered in order of their names before threads read them, every random number has a seed, and matching and mapping
run in one thread by default.
"""

import logging
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from clsplat.errors import DataError, first_few
from clsplat.files import write_text
from clsplat.progress import Count, watched
from data_tools.database import features_done, image_names, matched_pairs, pairs_done, remove, without_features
from data_tools.gather import MIN_PHOTOGRAPHS, gather, link, list_photographs
from data_tools.pycolmap_import import require_pycolmap
from data_tools.vocabulary import alike

LOG = logging.getLogger("clsplat")
Matching = Literal["auto", "exhaustive", "sequential", "vocabulary"]
Mapper = Literal["incremental", "global"]
Cameras = Literal["auto", "one", "per_folder", "per_image"]
CameraModel = Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE"]
MAX_EXHAUSTIVE = 200  # photographs whose pairs are all matched: the time grows with the square of their number
CHUNK = 10  # photographs in a call of pycolmap, which no signal ends
DATABASE, IMAGES, PAIRS = "database.db", "images", "pairs.txt"


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
    names, damaged = gather(photographs, out / IMAGES, list_photographs(photographs, without))
    figures = {"photographs": len(names), "damaged": damaged}
    for text in left_out(figures):
        LOG.warning("%s", text)
    database, mode = str(out / DATABASE), {"auto": "AUTO", "one": "SINGLE"}.get(cameras, cameras.upper())
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model = camera_model
    extraction.max_image_size, extraction.use_gpu = long_side, False
    extraction.sift.max_num_features = features
    with _explained(photographs, "find features"):
        pycolmap.Database.open(database).close()
        if image_names(pycolmap, out / DATABASE) != sorted(names):  # a new database, or one cut short
            remove(out / DATABASE)
            pycolmap.Database.open(database).close()
            pycolmap.import_images(
                database, str(out / IMAGES), getattr(pycolmap.CameraMode, mode), image_names=names, options=reader
            )
        missing, count = without_features(pycolmap, out / DATABASE), Count("photographs with features", len(names))
        count.reach(len(names) - len(missing))
        with watched(count, lambda: features_done(out / DATABASE)):
            for start in range(0, len(missing), CHUNK):
                pycolmap.extract_features(
                    database,
                    str(out / IMAGES),
                    missing[start : start + CHUNK],
                    extraction_options=extraction,
                    reader_options=reader,
                    device=pycolmap.Device.cpu,
                )
        count.reach(len(names))
    return figures


def match_features(
    source: Path, out: Path, matching: Matching = "auto", neighbours: int = 10, threads: int = 1
) -> dict[str, Any]:
    """Match features between photographs: all pairs, each with the `neighbours` next ones by name, or similar ones.

    `auto` matches all pairs of up to 200 photographs; of more, each with the most similar ones.  More than one thread
    is faster and not repeatable to the bit: in one call of a hundred, pycolmap 4.2 finds other matches of two pairs.
    Raises DataError when no pair matches.
    """
    pycolmap = require_pycolmap()
    link(source / IMAGES, out / IMAGES)
    database = out / DATABASE
    if not database.exists():  # pairs that it holds are not matched again
        half = out / f".{DATABASE}"
        shutil.copyfile(source / DATABASE, half)
        half.replace(database)
    count = len(image_names(pycolmap, database))
    chosen = ("exhaustive" if count <= MAX_EXHAUSTIVE else "vocabulary") if matching == "auto" else matching
    options, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.use_gpu, options.num_threads, verification.ransac.random_seed = False, threads, 0
    common = {
        "matching_options": options,
        "verification_options": verification,
        "device": pycolmap.Device.cpu,
    }
    LOG.info("matching %d photographs, %s", count, chosen)
    with _explained(source, "match photographs"):
        if chosen == "sequential":
            pairing = pycolmap.SequentialPairingOptions()
            pairing.overlap, pairing.quadratic_overlap = neighbours, True
            steps = {*range(1, neighbours + 1), *(1 << power for power in range(neighbours))}
            with _counted(database, sum(max(0, count - step) for step in steps)):
                pycolmap.match_sequential(str(database), pairing_options=pairing, **common)
        elif chosen == "vocabulary":
            pairs = _alike_pairs(pycolmap, database, 2 * neighbours)
            write_text(out / PAIRS, "".join(f"{a} {b}\n" for a, b in pairs))
            imported = pycolmap.ImportedPairingOptions()
            imported.match_list_path = out / PAIRS
            with _counted(database, len(pairs)):
                pycolmap.match_image_pairs(str(database), pairing_options=imported, **common)
        else:
            with _counted(database, count * (count - 1) // 2):
                pycolmap.match_exhaustive(str(database), **common)
    verified = matched_pairs(pycolmap, database)
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
    names = image_names(pycolmap, source / DATABASE)
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
    figures = {
        "registered": len(registered),
        "not_registered": [name for name in names if name not in registered],
        "other_models": [model.num_reg_images() for model in models[1:]],
        "points": best.num_points3D(),
        "error_px": round(best.compute_mean_reprojection_error(), 3),
    }
    for text in left_out(figures):
        LOG.warning("%s", text)
    return figures


def left_out(figures: Mapping[str, Any]) -> list[str]:
    """Return warnings of the photographs that a step has left out, by what it returned."""
    texts = []
    if damaged := figures.get("damaged"):
        names = [f"{name} ({reason})" for name, reason in damaged.items()]
        count = figures["photographs"] + len(names)
        texts.append(f"{len(names)} of {count} photographs cannot be read: {first_few(names)}; export them again")
    if missing := figures.get("not_registered"):
        texts.append(
            f"{len(missing)} of {figures['registered'] + len(missing)} photographs could not be placed: "
            f"{first_few(missing)}; the scene is made of the others: for more, add photographs from places between, or "
            "raise match_features.neighbours"
        )
    if others := figures.get("other_models"):
        texts.append(
            f"{len(others)} smaller models, of {', '.join(map(str, others))} photographs, are left out: add "
            "photographs that join them to the largest"
        )
    return texts


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


@contextmanager
def _counted(database: Path, pairs: int) -> Iterator[None]:
    """Count the pairs that pycolmap looks at in the block."""
    count = Count("pairs matched", pairs)
    with watched(count, lambda: pairs_done(database)):
        yield
    count.reach(pairs)


@contextmanager
def _explained(place: Path, what: str) -> Iterator[None]:
    """pycolmap's errors as one sentence."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        raise DataError(f"{place}: could not {what} ({str(error).splitlines()[0]}); check the photographs") from error
