"""Find cameras and points from matches with pycolmap, and try again while photographs are not registered.

The model with the most photographs is kept; of equal models, the earliest.
"""

import logging
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import cv2

from clsplat.core.errors import DataError
from clsplat.core.progress import ItemCounter
from clsplat.prepare.database import (
    DATABASE,
    IMAGES,
    MODEL,
    clear_features,
    raising_data_error,
    read_image_names,
    read_min_long_side,
    read_verified_pairs,
    require_pycolmap,
)
from clsplat.prepare.diagnosis import MatchGraph, diagnose, explain_unregistered
from clsplat.prepare.features import FeatureOptions, add_features
from clsplat.prepare.gather import MIN_PHOTOGRAPHS, link, log_warnings
from clsplat.prepare.matching import Pairing, expand_pairs, match_database, match_pairs
from clsplat.prepare.rotation_only import explain_missing_depth

LOG = logging.getLogger("clsplat")
Mapper = Literal["incremental", "global"]
ENOUGH = 0.9  # fraction of the photographs that must be registered to skip the attempts with denser features
DENSE, ENLARGED, WIDER = (f".{name}.{DATABASE}" for name in ("dense", "enlarged", "wider"))
DENSER = FeatureOptions(long_side=2400, count=16384, contrast=0.01)
SMALL = 1200  # px, long side; smaller photographs are enlarged to twice their size if denser features are not enough
FAILURES = (DataError, RuntimeError, ValueError, cv2.error)  # pycolmap raises the middle two
TWO_VIEWS = 2  # track length of points that COLMAP drops from its models
PAIR_ERROR = 1.0  # px, mean reprojection error; strict, since the two rays of any pair of features nearly meet
PAIR_ANGLE = 1.5  # degrees between two rays, as COLMAP requires for all points
LOOSE = {  # COLMAP's defaults: 100 matches, 16 degrees, 30 matches, 0.25
    "init_min_num_inliers": 50,
    "init_min_tri_angle": 5.0,
    "abs_pose_min_num_inliers": 15,
    "abs_pose_min_inlier_ratio": 0.15,
}


@dataclass(frozen=True)
class Attempt:
    """Settings of an attempt to find cameras."""

    label: str  # describes the attempt in the log
    mapper: Mapper = "incremental"
    is_loose: bool = False  # accept fewer matches and smaller angles
    has_more_pairs: bool = False  # match unregistered photographs with more photographs, unless all pairs were matched
    is_dense: bool = False  # find more features, and match the same pairs
    is_enlarged: bool = False  # find the features of small photographs at twice their size, unless none is small

    def database_path(self, source: Path, out: Path) -> Path:
        """Return the path of the database with the features and matches of the attempt."""
        if self.is_dense:
            return out / (ENLARGED if self.is_enlarged else DENSE)
        return out / WIDER if self.has_more_pairs else source / DATABASE


RETRIES = (
    Attempt("smaller angles and fewer matches", is_loose=True),
    Attempt("more pairs", is_loose=True, has_more_pairs=True),
    Attempt("denser features", is_loose=True, is_dense=True),
    Attempt("denser features of enlarged photos", is_loose=True, is_dense=True, is_enlarged=True),
    Attempt("denser features, all cameras at once", "global", is_dense=True),
)
MAX_ATTEMPTS = 1 + len(RETRIES)


def map_cameras(
    source: Path,
    out: Path,
    mapper: Mapper = "incremental",
    threads: int = 1,
    attempts: int = MAX_ATTEMPTS,
    min_track_length: int = 3,
) -> dict[str, Any]:
    """Find cameras and points in at most `attempts` attempts, and write the largest model to sparse/0.

    Returns statistics for the log.  `mapper: global` is faster for many photographs; more than one thread is faster but
    not bit-identical.  min_track_length: the number of photographs in which a point must be visible, 2 or 3.
    Raises DataError, with the likely reason, when no attempt registers three photographs.
    """
    pycolmap = require_pycolmap()
    link(source / IMAGES, out / IMAGES)
    names = read_image_names(pycolmap, source / DATABASE)
    graph = MatchGraph.from_database(pycolmap, source / DATABASE, source / IMAGES)
    if reason := explain_missing_depth(pycolmap, source / DATABASE):
        raise DataError(f"{source / IMAGES}: the photos {reason}")
    models, best, extra_pairs, count = list[Any](), (first := Attempt("as set", mapper)), list[tuple[str, str]](), 0
    for attempt in (first, *_retries(pycolmap, source / DATABASE)):
        registered_count = models[0].num_reg_images() if models else 0
        missing = set(names) - _registered_names(*models[:1])
        if count == attempts or not missing or (attempt.is_dense and registered_count >= ENOUGH * len(names)):
            break
        if attempt.is_dense and not models and graph.has_unrelated_photographs():
            break  # denser features would not help: most photographs have nothing in common
        try:
            if attempt.has_more_pairs and not (extra_pairs := expand_pairs(source / DATABASE, missing)):
                continue
            if attempt is not first:
                LOG.info("registered %d of %d photos; retrying with %s", registered_count, len(names), attempt.label)
            count += 1
            candidates = _run_attempt(source, out, attempt, threads, models[:1], extra_pairs)
            if attempt.has_more_pairs:
                graph = MatchGraph.from_database(pycolmap, attempt.database_path(source, out), source / IMAGES)
        except FAILURES as error:
            if not (attempt.has_more_pairs or models):
                raise
            LOG.warning("skipping a failed attempt: %s", error)
            if not attempt.has_more_pairs:
                break
            extra_pairs, candidates = [], []
        if candidates and candidates[0].num_reg_images() > registered_count:
            models, best = candidates, attempt
    if not models:
        raise DataError(f"{source / IMAGES}: the {len(names)} photos could not be registered: {diagnose(graph)}")
    database, registered_names = best.database_path(source, out), _registered_names(models[0])
    if reason := explain_missing_depth(pycolmap, database, registered_names):
        raise DataError(f"{source / IMAGES}: the {len(registered_names)} registered photos of {len(names)} {reason}")
    if best.is_dense:
        graph = MatchGraph.from_database(pycolmap, database, source / IMAGES)
    if min_track_length == TWO_VIEWS:
        models[0] = triangulate_pairs(models[0], database, out, threads)
    result = {**_write_best(models, out, names), "attempt": best.label, "denser_tried": (out / DENSE).exists()}
    result["reasons"] = explain_unregistered(graph, [_registered_names(model) for model in models])
    _remove_hidden(out)
    log_warnings(result)
    return result


def _retries(pycolmap: ModuleType, database: Path) -> list[Attempt]:
    """Return the attempts after the first that differ from it for photographs of these sizes."""
    has_small = read_min_long_side(pycolmap, database) < SMALL
    return [attempt for attempt in RETRIES if has_small or not attempt.is_enlarged]


def _remove_hidden(folder: Path) -> None:
    for path in folder.glob(".*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def _run_attempt(
    source: Path, out: Path, attempt: Attempt, threads: int, previous: Sequence[Any], pairs: Sequence[tuple[str, str]]
) -> list[Any]:
    """Run an attempt and return its models, the largest first.

    An attempt with looser settings and the same features extends the first of the previous models.
    """
    pycolmap = require_pycolmap()
    database, work_folder = _fill_database(source, out, attempt, pairs), out / ".models"
    if not read_verified_pairs(pycolmap, database):
        return []
    shutil.rmtree(work_folder, ignore_errors=True)
    work_folder.mkdir()
    is_global = attempt.mapper == "global"
    options = pycolmap.GlobalPipelineOptions() if is_global else pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = 0
    options.min_model_size = MIN_PHOTOGRAPHS
    if attempt.is_loose:
        options.mapper.mergedict(LOOSE)
    pycolmap.set_random_seed(0)
    with raising_data_error(source / IMAGES, "register the photos"):
        run_mapper = pycolmap.global_mapping if is_global else pycolmap.incremental_mapping
        counter = ItemCounter("photos registered", len(read_image_names(pycolmap, database)))

        def on_registered() -> None:
            counter.reach(min(max(2, counter.done) + 1, counter.total))

        arguments: dict[str, Any] = {} if is_global else {"next_image_callback": on_registered}
        if attempt.is_loose and not attempt.is_dense and previous:
            (out / ".before").mkdir(exist_ok=True)
            previous[0].write(str(out / ".before"))
            arguments["input_path"] = str(out / ".before")
            counter.reach(previous[0].num_reg_images())
        results = run_mapper(str(database), str(out / IMAGES), str(work_folder), options=options, **arguments).values()
    models = [model for model in results if model.num_reg_images() >= MIN_PHOTOGRAPHS and model.num_points3D()]
    return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _fill_database(source: Path, out: Path, attempt: Attempt, pairs: Sequence[tuple[str, str]]) -> Path:
    """Write the features and matches of an attempt to its database; return the path.

    Continues an interrupted call: the pairs depend only on the first database and the previous model, so they are
    still the same.
    """
    database, pairing = attempt.database_path(source, out), Pairing.read(source)
    if not database.exists():
        partial = database.with_name(f".half.{DATABASE}")
        shutil.copyfile(source / DATABASE, partial)
        if attempt.is_dense:
            clear_features(require_pycolmap(), partial)
        partial.replace(database)
    if attempt.is_dense:
        add_features(source / IMAGES, database, replace(DENSER, min_side=SMALL if attempt.is_enlarged else 0))
        match_database(database, pairing)
    if attempt.is_dense or attempt.has_more_pairs:
        match_pairs(database, pairs, pairing.threads)
    return database


def _write_best(models: Sequence[Any], out: Path, names: Sequence[str]) -> dict[str, Any]:
    """Write the first model to sparse/0; return its statistics, and the number of photographs that each model adds."""
    best = models[0]
    (out / MODEL / "0").mkdir(parents=True, exist_ok=True)
    best.write(str(out / MODEL / "0"))
    registered_names, new_counts, covered_names = _registered_names(best), list[int](), set[str]()
    for model in models:
        new_counts.append(len(_registered_names(model) - covered_names))
        covered_names |= _registered_names(model)
    return {
        "registered": len(registered_names),
        "not_registered": [name for name in names if name not in registered_names],
        "other_models": [count for count in new_counts[1:] if count],  # photographs that are in no larger model
        "points": best.num_points3D(),
        "error_px": round(best.compute_mean_reprojection_error(), 3),
    }


def _registered_names(*models: Any) -> set[str]:
    return {model.images[image_id].name for model in models for image_id in model.reg_image_ids()}


def triangulate_pairs(model: Any, database: Path, out: Path, threads: int = 1) -> Any:
    """Triangulate the points of a model again, including points visible in only two photographs; keep its cameras.

    database: contains the features and matches of the model.  out: contains the folder of the images.
    """
    pycolmap = require_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = 0
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = PAIR_ANGLE
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory(dir=out) as folder, raising_data_error(out / IMAGES, "triangulate the points"):
        new_model = pycolmap.triangulate_points(
            model, str(database), str(out / IMAGES), folder, clear_points=True, options=options
        )
    inaccurate_ids = [
        i for i, p in new_model.points3D.items() if p.track.length() == TWO_VIEWS and p.error > PAIR_ERROR
    ]
    for point_id in inaccurate_ids:
        new_model.delete_point3D(point_id)
    return new_model
