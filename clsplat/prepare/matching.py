"""Match features between photographs and verify the matches, with pycolmap."""

import json
import logging
import shutil
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, pluralize
from clsplat.core.files import write_text
from clsplat.core.progress import ItemCounter, polled
from clsplat.core.reading import read_json
from clsplat.prepare.database import (
    DATABASE,
    IMAGES,
    MATCHING,
    PAIRS,
    count_matched_pairs,
    open_database,
    raising_data_error,
    read_image_names,
    read_verified_pairs,
    require_pycolmap,
)
from clsplat.prepare.gather import link

LOG = logging.getLogger("clsplat")
Matching = Literal["auto", "exhaustive", "sequential", "vocabulary"]
MAX_EXHAUSTIVE = 200  # number of photographs up to which `auto` matches all pairs; the time is quadratic
WORDS = 1024  # visual words in the vocabulary learned from the photographs (Sivic and Zisserman 2003)
SAMPLES = 40  # descriptors per word for k-means
ROUNDS = 10  # iterations of k-means


@dataclass(frozen=True)
class Pairing:
    """Settings of match_features: how it selects the pairs to match, and its number of threads."""

    matching: Matching = "auto"
    neighbors: int = 10
    threads: int = 1

    @classmethod
    def read(cls, folder: Path) -> "Pairing":
        """Read the settings that match_features wrote to a folder.  Raises DataError when they are missing."""
        return cls(**read_json(folder / MATCHING, "how photos were matched"))


def match_features(
    source: Path, out: Path, matching: Matching = "auto", neighbors: int = 10, threads: int = 1
) -> dict[str, Any]:
    """Match the pairs of photographs that `matching` selects, and write a database to the folder `out`.

    `exhaustive` selects all pairs, `sequential` each photograph and the next `neighbors` by name, `vocabulary` each
    photograph and the 2 `neighbors` most similar ones.  `auto` is exhaustive for up to 200 photographs, and otherwise
    vocabulary.  Returns the method that was used, and the number of pairs that match.  More than one thread is faster
    but not bit-identical: in about one in a hundred calls of pycolmap 4.2, two pairs get different matches.
    """
    pycolmap = require_pycolmap()
    link(source / IMAGES, out / IMAGES)
    database = out / DATABASE
    if not database.exists():  # pairs in an existing database are not matched again
        partial = out / f".{DATABASE}"
        shutil.copyfile(source / DATABASE, partial)
        partial.replace(database)
    pairing = Pairing(matching, neighbors, threads)
    write_text(out / MATCHING, json.dumps(asdict(pairing)) + "\n")
    method = match_database(database, pairing)
    return {"matching": method, "pairs": len(read_verified_pairs(pycolmap, database))}


def max_pair_count(photographs: int, matching: Matching, neighbors: int) -> int:
    """Return an upper bound on the number of pairs that match_features matches, given the number of photographs."""
    all_pairs = photographs * (photographs - 1) // 2
    is_exhaustive = matching == "exhaustive" or (matching == "auto" and photographs <= MAX_EXHAUSTIVE)
    return all_pairs if is_exhaustive else min(all_pairs, 2 * neighbors * photographs)


def match_database(database: Path, pairing: Pairing) -> Matching:
    """Match the pairs of a database that are not matched yet, as match_features does.

    Returns the method that was used: never `auto`.  Raises DataError when pycolmap fails.
    """
    pycolmap = require_pycolmap()
    count, matching, neighbors = len(read_image_names(pycolmap, database)), pairing.matching, pairing.neighbors
    method = ("exhaustive" if count <= MAX_EXHAUSTIVE else "vocabulary") if matching == "auto" else matching
    common_options = _make_options(pycolmap, pairing.threads)
    with raising_data_error(database, "match photos"):
        if method == "sequential":
            options = pycolmap.SequentialPairingOptions()
            options.overlap, options.quadratic_overlap = neighbors, True
            LOG.info("matching %d photos, each with the next %d by name", count, neighbors)
            steps = {*range(1, neighbors + 1), *(1 << power for power in range(neighbors))}
            with _count_pairs(database, sum(max(0, count - step) for step in steps)):
                pycolmap.match_sequential(str(database), pairing_options=options, **common_options)
        elif method == "vocabulary":
            LOG.info("matching %d photos, each with the %d most similar", count, 2 * neighbors)
            pairs = _read_similar_pairs(pycolmap, database, 2 * neighbors)
            with _count_pairs(database, len(pairs)):
                _match_pairs(database, pairs, common_options)
        else:
            LOG.info("matching all pairs of %d photos", count)
            with _count_pairs(database, count * (count - 1) // 2):
                pycolmap.match_exhaustive(str(database), **common_options)
    return method


def match_pairs(database: Path, pairs: Sequence[tuple[str, str]], threads: int) -> None:
    """Match pairs of images by name, skipping pairs that are already matched.  Raises DataError if pycolmap fails."""
    pycolmap = require_pycolmap()
    with open_database(pycolmap, database) as db:
        image_ids = {image.name: image.image_id for image in db.read_all_images()}
        new_pairs = [(a, b) for a, b in pairs if not db.exists_two_view_geometry(image_ids[a], image_ids[b])]
        matched_count = db.num_matched_image_pairs()
    if not new_pairs:
        return
    LOG.info("matching %s that include unregistered photos", pluralize(len(new_pairs), "more pair"))
    with raising_data_error(database, "match photos"), _count_pairs(database, matched_count + len(new_pairs)):
        _match_pairs(database, new_pairs, _make_options(pycolmap, threads))


def expand_pairs(database: Path, unregistered: Set[str]) -> list[tuple[str, str]]:
    """Return pairs that contain an `unregistered` photograph and that `match_database` has not matched.

    The pairs at most double the number of matched pairs: if there are more candidates, each unregistered photograph
    is paired only with the most similar photographs, at least one.
    """
    pycolmap = require_pycolmap()
    with open_database(pycolmap, database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        max_pairs = db.num_matched_image_pairs()
        if max_pairs == len(images) * (len(images) - 1) // 2:
            return []
        if bad_names := [image.name for image in images if _has_space(image.name)]:
            LOG.warning(
                "'%s': COLMAP's pair lists do not allow spaces in names, so no more pairs of such photos are matched; "
                "rename them",
                bad_names[0],
            )
            images = [image for image in images if not _has_space(image.name)]
        is_unregistered = [image.name in unregistered for image in images]
        candidates = [
            (i, j)
            for i, j in combinations(range(len(images)), 2)
            if (is_unregistered[i] or is_unregistered[j])
            and not db.exists_two_view_geometry(images[i].image_id, images[j].image_id)
        ]
        if len(candidates) > max_pairs:
            similarities = compute_similarities(_read_descriptors(db, images))
            candidates = _select_closest_pairs(
                candidates, similarities, is_unregistered, max(1, max_pairs // sum(is_unregistered))
            )
    return [(images[i].name, images[j].name) for i, j in candidates]


def _select_closest_pairs(
    pairs: Sequence[tuple[int, int]], similarities: NDArray[np.float64], is_unregistered: Sequence[bool], count: int
) -> list[tuple[int, int]]:
    """Return the pairs of each unregistered photograph with the `count` most similar photographs."""
    counts, closest = [0] * len(is_unregistered), []
    for i, j in sorted(pairs, key=lambda pair: -similarities[pair]):
        if any(is_unregistered[k] and counts[k] < count for k in (i, j)):
            closest.append((i, j))
            counts[i] += 1
            counts[j] += 1
    return sorted(closest)


def _make_options(pycolmap: ModuleType, threads: int) -> dict[str, Any]:
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.use_gpu, matching.num_threads, verification.ransac.random_seed = False, threads, 0
    return {"matching_options": matching, "verification_options": verification, "device": pycolmap.Device.cpu}


def _match_pairs(database: Path, pairs: Sequence[tuple[str, str]], options: dict[str, Any]) -> None:
    pycolmap = require_pycolmap()
    list_file = database.with_name(PAIRS)
    write_text(list_file, "".join(f"{a} {b}\n" for a, b in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = list_file
    pycolmap.match_image_pairs(str(database), pairing_options=pairing, **options)


def _read_similar_pairs(pycolmap: ModuleType, database: Path, neighbors: int) -> list[tuple[str, str]]:
    with open_database(pycolmap, database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        descriptors = _read_descriptors(db, images)
    if bad_names := [image.name for image in images if _has_space(image.name)]:
        raise DataError(
            f"'{bad_names[0]}': COLMAP's pair lists do not allow spaces in names; rename the photo, or use exhaustive "
            "matching (matching: exhaustive)"
        )
    return [(images[i].name, images[j].name) for i, j in find_similar_pairs(descriptors, neighbors)]


def _read_descriptors(db: Any, images: Sequence[Any]) -> list[NDArray[np.float32]]:
    return [np.asarray(db.read_descriptors(image.image_id).data, np.float32) for image in images]


def _has_space(name: str) -> bool:
    return len(name.split()) > 1


@contextmanager
def _count_pairs(database: Path, pairs: int) -> Iterator[None]:
    """While the block runs, report as progress how many pairs pycolmap has matched."""
    counter = ItemCounter("pairs matched", pairs)
    with polled(counter, lambda: count_matched_pairs(database)):
        yield
    counter.reach(pairs)


def find_similar_pairs(descriptors: Sequence[NDArray[np.float32]], neighbors: int) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of each photograph with the `neighbors` most similar ones.

    descriptors: the descriptors of each photograph, [M, 128].
    """
    similarities = compute_similarities(descriptors)
    np.fill_diagonal(similarities, -1)
    nearest = np.argsort(-similarities, axis=1, kind="stable")[:, : min(neighbors, len(descriptors) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(nearest) for j in row})


def compute_similarities(descriptors: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return the similarities between N photographs, [N, N], from 0 to 1.

    descriptors: the descriptors of each photograph, [M, 128].  Visual words are the clusters of k-means over a sample
    of the descriptors (Sivic and Zisserman 2003), and the similarity is the cosine of the TF-IDF vectors of two
    photographs.  It is 0 for a photograph without descriptors.
    """
    rng = np.random.default_rng(0)
    sample = np.concatenate(
        [matrix[rng.permutation(len(matrix))[: SAMPLES * WORDS // len(descriptors) + 1]] for matrix in descriptors]
    )
    if not len(sample):
        return np.zeros((len(descriptors), len(descriptors)))
    counts = np.zeros((len(descriptors), WORDS))
    words = _fit_visual_words(sample)
    for row, matrix in enumerate(descriptors):
        if len(matrix):
            distance = (words**2).sum(axis=1) - 2 * matrix @ words.T
            counts[row] += np.bincount(distance.argmin(axis=1), minlength=WORDS)
    rarity = np.log(len(descriptors) / np.maximum((counts > 0).sum(axis=0), 1))
    vectors = counts * rarity
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return np.asarray(vectors @ vectors.T)


def _fit_visual_words(sample: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the visual words, [at most WORDS, 128]: the centers of k-means over a sample of descriptors, [M, 128]."""
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0)
    count, labels = min(WORDS, len(sample)), np.empty(0, np.int32)
    _, _, words = cv2.kmeans(sample, count, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
    return np.asarray(words, np.float32)
