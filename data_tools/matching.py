"""Which features of two photographs show the same point: found and verified by pycolmap, kept in its database."""

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from clsplat.errors import DataError
from clsplat.files import write_text
from clsplat.progress import Count, watched
from clsplat.reading import read_json
from data_tools.database import explained, image_names, opened, pairs_done, verified
from data_tools.gather import link
from data_tools.names import DATABASE, IMAGES, MATCHING, PAIRS
from data_tools.pycolmap_import import require_pycolmap
from data_tools.vocabulary import alike

LOG = logging.getLogger("clsplat")
Matching = Literal["auto", "exhaustive", "sequential", "vocabulary"]
MAX_EXHAUSTIVE = 200  # photographs whose pairs are all matched: the time grows with the square of their number


@dataclass(frozen=True)
class Pairing:
    """Which pairs are matched, and by how many threads: see match_features."""

    matching: Matching = "auto"
    neighbours: int = 10
    threads: int = 1

    @classmethod
    def beside(cls, folder: Path) -> "Pairing":
        """Return the one by which match_features made a folder; the usual one of a folder of an earlier version."""
        path = folder / MATCHING
        return cls(**read_json(path, "how photographs were matched")) if path.is_file() else cls()


def match_features(
    source: Path, out: Path, matching: Matching = "auto", neighbours: int = 10, threads: int = 1
) -> dict[str, Any]:
    """Match features between photographs: all pairs, each with the `neighbours` next ones by name, or similar ones.

    `auto` matches all pairs of up to 200 photographs; of more, each with the most similar ones.  More than one thread
    is faster and not repeatable to the bit: in one call of a hundred, pycolmap 4.2 finds other matches of two pairs.
    """
    pycolmap = require_pycolmap()
    link(source / IMAGES, out / IMAGES)
    database = out / DATABASE
    if not database.exists():  # pairs that it holds are not matched again
        half = out / f".{DATABASE}"
        shutil.copyfile(source / DATABASE, half)
        half.replace(database)
    pairing = Pairing(matching, neighbours, threads)
    write_text(out / MATCHING, json.dumps(asdict(pairing)) + "\n")
    chosen = match_within(database, pairing)
    return {"matching": chosen, "pairs": len(verified(pycolmap, database))}


def most_pairs(photographs: int, matching: Matching, neighbours: int) -> int:
    """Return the largest number of pairs that match_features looks at."""
    every = photographs * (photographs - 1) // 2
    is_each = matching == "exhaustive" or (matching == "auto" and photographs <= MAX_EXHAUSTIVE)
    return every if is_each else min(every, 2 * neighbours * photographs)


def match_within(database: Path, how: Pairing) -> Matching:
    """Match the photographs of a database as match_features does, but for pairs that it holds; return how.

    Raises DataError.
    """
    pycolmap = require_pycolmap()
    count, matching, neighbours = len(image_names(pycolmap, database)), how.matching, how.neighbours
    chosen = ("exhaustive" if count <= MAX_EXHAUSTIVE else "vocabulary") if matching == "auto" else matching
    options, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.use_gpu, options.num_threads, verification.ransac.random_seed = False, how.threads, 0
    common = {
        "matching_options": options,
        "verification_options": verification,
        "device": pycolmap.Device.cpu,
    }
    LOG.info("matching %d photographs, %s", count, chosen)
    with explained(database, "match photographs"):
        if chosen == "sequential":
            pairing = pycolmap.SequentialPairingOptions()
            pairing.overlap, pairing.quadratic_overlap = neighbours, True
            steps = {*range(1, neighbours + 1), *(1 << power for power in range(neighbours))}
            with _counted(database, sum(max(0, count - step) for step in steps)):
                pycolmap.match_sequential(str(database), pairing_options=pairing, **common)
        elif chosen == "vocabulary":
            pairs = _alike_pairs(pycolmap, database, 2 * neighbours)
            listed = database.with_name(PAIRS)
            write_text(listed, "".join(f"{a} {b}\n" for a, b in pairs))
            imported = pycolmap.ImportedPairingOptions()
            imported.match_list_path = listed
            with _counted(database, len(pairs)):
                pycolmap.match_image_pairs(str(database), pairing_options=imported, **common)
        else:
            with _counted(database, count * (count - 1) // 2):
                pycolmap.match_exhaustive(str(database), **common)
    return chosen


def _alike_pairs(pycolmap: ModuleType, database: Path, neighbours: int) -> list[tuple[str, str]]:
    with opened(pycolmap, database) as rows:
        images = sorted(rows.read_all_images(), key=lambda image: image.name)
        tables = [np.asarray(rows.read_descriptors(image.image_id).data, np.float32) for image in images]
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
