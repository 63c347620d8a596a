"""Match features between photographs, and verify the matches, with pycolmap in its database."""

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
from clsplat.core.progress import Count, polled
from clsplat.core.reading import read_json
from clsplat.prepare.database import (
    DATABASE,
    IMAGES,
    MATCHING,
    PAIRS,
    count_matched_pairs,
    image_names,
    open_database,
    raising_data_error,
    require_pycolmap,
    verified_pairs,
)
from clsplat.prepare.gather import link

LOG = logging.getLogger("clsplat")
Matching = Literal["auto", "exhaustive", "sequential", "vocabulary"]
MAX_EXHAUSTIVE = 200  # photographs up to which `auto` matches all pairs: the time grows with the square
WORDS = 1024  # in the vocabulary learned from the photographs (Sivic and Zisserman 2003)
SAMPLES = 40  # descriptors per word for k-means
ROUNDS = 10  # iterations of k-means


@dataclass(frozen=True)
class Pairing:
    """Selection of the pairs to match, and the number of threads; see match_features."""

    matching: Matching = "auto"
    neighbors: int = 10
    threads: int = 1

    @classmethod
    def read(cls, folder: Path) -> "Pairing":
        """Read the pairing that match_features used for a folder.  Raises DataError when it is missing."""
        return cls(**read_json(folder / MATCHING, "how photographs were matched"))


def match_features(
    source: Path, out: Path, matching: Matching = "auto", neighbors: int = 10, threads: int = 1
) -> dict[str, Any]:
    """Match features between photographs: of all pairs, or of each with its next `neighbors` by name or similarity.

    `auto` matches all pairs of up to 200 photographs, and otherwise each photograph with the most similar ones.  More
    than one thread is faster but not bit-identical: in about one of a hundred calls of pycolmap 4.2, two pairs get
    different matches.
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
    chosen = match_database(database, pairing)
    return {"matching": chosen, "pairs": len(verified_pairs(pycolmap, database))}


def max_pair_count(photographs: int, matching: Matching, neighbors: int) -> int:
    """Return the largest number of pairs that match_features matches."""
    all_pairs = photographs * (photographs - 1) // 2
    is_exhaustive = matching == "exhaustive" or (matching == "auto" and photographs <= MAX_EXHAUSTIVE)
    return all_pairs if is_exhaustive else min(all_pairs, 2 * neighbors * photographs)


def match_database(database: Path, pairing: Pairing) -> Matching:
    """Match the pairs of a database that are not matched yet, as match_features does; return the matching used.

    Raises DataError when pycolmap fails.
    """
    pycolmap = require_pycolmap()
    count, matching, neighbors = len(image_names(pycolmap, database)), pairing.matching, pairing.neighbors
    chosen = ("exhaustive" if count <= MAX_EXHAUSTIVE else "vocabulary") if matching == "auto" else matching
    common = _options(pycolmap, pairing.threads)
    with raising_data_error(database, "match photographs"):
        if chosen == "sequential":
            options = pycolmap.SequentialPairingOptions()
            options.overlap, options.quadratic_overlap = neighbors, True
            LOG.info("matching %d photographs, each with the next %d by name", count, neighbors)
            steps = {*range(1, neighbors + 1), *(1 << power for power in range(neighbors))}
            with _count_pairs(database, sum(max(0, count - step) for step in steps)):
                pycolmap.match_sequential(str(database), pairing_options=options, **common)
        elif chosen == "vocabulary":
            LOG.info("matching %d photographs, each with the %d most similar", count, 2 * neighbors)
            pairs = _find_similar_pairs(pycolmap, database, 2 * neighbors)
            with _count_pairs(database, len(pairs)):
                _match_listed(database, pairs, common)
        else:
            LOG.info("matching all pairs of %d photographs", count)
            with _count_pairs(database, count * (count - 1) // 2):
                pycolmap.match_exhaustive(str(database), **common)
    return chosen


def match_pairs(database: Path, pairs: Sequence[tuple[str, str]], threads: int) -> None:
    """Match those of the given pairs that are not matched yet.  Raises DataError when pycolmap fails."""
    pycolmap = require_pycolmap()
    with open_database(pycolmap, database) as rows:
        numbers = {image.name: image.image_id for image in rows.read_all_images()}
        missing = [(a, b) for a, b in pairs if not rows.exists_two_view_geometry(numbers[a], numbers[b])]
        done = rows.num_matched_image_pairs()
    if not missing:
        return
    LOG.info("matching %s of photographs that are not placed yet", pluralize(len(missing), "more pair"))
    with raising_data_error(database, "match photographs"), _count_pairs(database, done + len(missing)):
        _match_listed(database, missing, _options(pycolmap, threads))


def expand_pairs(database: Path, unplaced: Set[str]) -> list[tuple[str, str]]:
    """Return pairs with at least one `unplaced` photograph that `match_database` has not matched.

    They at most double the number of matched pairs: when there are more candidates, each unplaced photograph is paired
    only with the most similar ones, at least one.
    """
    pycolmap = require_pycolmap()
    with open_database(pycolmap, database) as rows:
        images = sorted(rows.read_all_images(), key=lambda image: image.name)
        max_pairs = rows.num_matched_image_pairs()
        if max_pairs == len(images) * (len(images) - 1) // 2:
            return []
        if invalid := [image.name for image in images if _has_space(image.name)]:
            LOG.warning(
                "'%s': COLMAP's lists of pairs allow no spaces in names, so no further pairs are matched", invalid[0]
            )
            images = [image for image in images if not _has_space(image.name)]
        targets = [image.name in unplaced for image in images]
        candidates = [
            (i, j)
            for i, j in combinations(range(len(images)), 2)
            if (targets[i] or targets[j]) and not rows.exists_two_view_geometry(images[i].image_id, images[j].image_id)
        ]
        if len(candidates) > max_pairs:
            similarities = similarity(_descriptors(rows, images))
            candidates = _closest(candidates, similarities, targets, max(1, max_pairs // sum(targets)))
    return [(images[i].name, images[j].name) for i, j in candidates]


def _closest(
    pairs: Sequence[tuple[int, int]], similarities: NDArray[np.float64], unplaced: Sequence[bool], count: int
) -> list[tuple[int, int]]:
    """Return the pairs of each unplaced photograph with the `count` photographs most similar to it."""
    counts, chosen = [0] * len(unplaced), []
    for i, j in sorted(pairs, key=lambda pair: -similarities[pair]):
        if any(unplaced[k] and counts[k] < count for k in (i, j)):
            chosen.append((i, j))
            counts[i] += 1
            counts[j] += 1
    return sorted(chosen)


def _options(pycolmap: ModuleType, threads: int) -> dict[str, Any]:
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.use_gpu, matching.num_threads, verification.ransac.random_seed = False, threads, 0
    return {"matching_options": matching, "verification_options": verification, "device": pycolmap.Device.cpu}


def _match_listed(database: Path, pairs: Sequence[tuple[str, str]], options: dict[str, Any]) -> None:
    pycolmap = require_pycolmap()
    list_file = database.with_name(PAIRS)
    write_text(list_file, "".join(f"{a} {b}\n" for a, b in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = list_file
    pycolmap.match_image_pairs(str(database), pairing_options=pairing, **options)


def _find_similar_pairs(pycolmap: ModuleType, database: Path, neighbors: int) -> list[tuple[str, str]]:
    with open_database(pycolmap, database) as rows:
        images = sorted(rows.read_all_images(), key=lambda image: image.name)
        tables = _descriptors(rows, images)
    if invalid := [image.name for image in images if _has_space(image.name)]:
        raise DataError(
            f"'{invalid[0]}': COLMAP's lists of pairs allow no spaces in names; rename it, or match all pairs"
        )
    return [(images[i].name, images[j].name) for i, j in similar_pairs(tables, neighbors)]


def _descriptors(rows: Any, images: Sequence[Any]) -> list[NDArray[np.float32]]:
    return [np.asarray(rows.read_descriptors(image.image_id).data, np.float32) for image in images]


def _has_space(name: str) -> bool:
    return len(name.split()) > 1


@contextmanager
def _count_pairs(database: Path, pairs: int) -> Iterator[None]:
    """Count the pairs that pycolmap matches in the block."""
    count = Count("pairs matched", pairs)
    with polled(count, lambda: count_matched_pairs(database)):
        yield
    count.reach(pairs)


def similar_pairs(tables: Sequence[NDArray[np.float32]], neighbors: int) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of each photograph with the `neighbors` most similar ones."""
    similarities = similarity(tables)
    np.fill_diagonal(similarities, -1)
    nearest = np.argsort(-similarities, axis=1, kind="stable")[:, : min(neighbors, len(tables) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(nearest) for j in row})


def similarity(tables: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return the similarity of photographs, [N, N], from 0 to 1.

    tables: descriptors [M, 128] of each photograph.  Words are the cells of k-means over a sample of the descriptors
    (Sivic and Zisserman 2003), and the similarity is the cosine of TF-IDF vectors.  It is 0 without descriptors.
    """
    rng = np.random.default_rng(0)
    sample = np.concatenate(
        [table[rng.permutation(len(table))[: SAMPLES * WORDS // len(tables) + 1]] for table in tables]
    )
    if not len(sample):
        return np.zeros((len(tables), len(tables)))
    counts = np.zeros((len(tables), WORDS))
    words = _words(sample)
    for row, table in enumerate(tables):
        if len(table):
            distance = (words**2).sum(axis=1) - 2 * table @ words.T
            counts[row] += np.bincount(distance.argmin(axis=1), minlength=WORDS)
    rarity = np.log(len(tables) / np.maximum((counts > 0).sum(axis=0), 1))
    vectors = counts * rarity
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return np.asarray(vectors @ vectors.T)


def _words(sample: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the centers of k-means, [at most WORDS, 128]."""
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0)
    count, labels = min(WORDS, len(sample)), np.empty(0, np.int32)
    _, _, words = cv2.kmeans(sample, count, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
    return np.asarray(words, np.float32)
