"""Why photographs could not be placed: what their features and matches tell."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import median
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import first_few, pluralize
from clsplat.prepare.database import feature_counts, verified
from clsplat.prepare.gather import MIN_PHOTOGRAPHS
from clsplat.scene.quality import is_blurred, sharpness_of

FEW_FEATURES = 300  # of a photograph: a wall of one color has tens, a garden thousands
TEXTURED = 1000  # features: photographs with as many are not weakly textured; three times FEW_FEATURES
FEW_MATCHES = 30  # of a photograph with the points of a model: COLMAP places none with fewer
SHARPNESS_OF = 15  # placed photographs that the others are compared with


@dataclass
class MatchGraph:
    """The photographs with their features, and the pairs that match."""

    images: Path
    features: dict[str, int]
    pairs: dict[tuple[str, str], int]  # matches that pass verification
    sharpness: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    @classmethod
    def from_database(cls, pycolmap: ModuleType, database: Path, images: Path) -> "MatchGraph":
        """Read them from COLMAP's database."""
        return cls(images, feature_counts(pycolmap, database), verified(pycolmap, database))

    @cached_property
    def matches(self) -> dict[str, dict[str, int]]:
        """The number of verified matches of each photograph with others."""
        found: dict[str, dict[str, int]] = {name: {} for name in self.features}
        for (a, b), count in self.pairs.items():
            found[a][b] = found[b][a] = count
        return found

    def groups(self, fewest: int) -> list[list[str]]:
        """The photographs that pairs with so many matches join, each group sorted, the largest first."""
        return connected_groups(self.features, [pair for pair, count in self.pairs.items() if count >= fewest])

    def have_nothing_in_common(self) -> bool:
        """Whether denser features are without a chance: most photographs are in no group of pairs, however few matches
        these have, although there are features enough.

        Photographs of one scene match here and there, by fewer than a camera needs; photographs of plain surfaces have
        no features, until more are looked for.
        """
        is_textured = median(self.features.values()) >= TEXTURED
        return is_textured and len(self.groups(1)[0]) < len(self.features) / 2

    def sharpness_of(self, name: str) -> NDArray[np.float64]:
        """Both sharpnesses of a photograph, measured once."""
        if name not in self.sharpness:
            self.sharpness[name] = sharpness_of(self.images / name)
        return self.sharpness[name]


def connected_groups(names: Iterable[str], pairs: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Return the groups of names that pairs join, each sorted, the largest first."""
    group_of = {name: {name} for name in names}
    for a, b in pairs:
        if group_of[a] is not group_of[b]:
            group_of[a] |= group_of[b]
            group_of.update(dict.fromkeys(group_of[b], group_of[a]))
    groups = {id(group): sorted(group) for group in group_of.values()}
    return sorted(groups.values(), key=lambda group: (-len(group), group))


def diagnose(matched: MatchGraph) -> str:
    """Return the likely reason why photographs give no model, with a remedy."""
    middle = round(median(matched.features.values()))
    if middle < FEW_FEATURES:
        few = f"half of them have {f'at most {middle}' if middle else 'no'} features"
        return (
            f"{few if any(matched.features.values()) else 'none has features'}, where thousands are usual: they are "
            "blurred, dark, or show plain surfaces; take sharp ones, of things with texture"
        )
    if not matched.pairs:
        return "no two of them show the same features; take some with more overlap, of a scene in which nothing moves"
    groups = matched.groups(FEW_MATCHES)
    if len(groups[0]) < max(MIN_PHOTOGRAPHS, len(matched.features) / 2):
        return f"{_parts(matched, groups)}; take photographs of one scene, with more overlap"
    return "take more sharp ones, from places a step apart, of a textured scene in which nothing moves"


def _parts(matched: MatchGraph, groups: Sequence[list[str]]) -> str:
    """Which photographs belong together, and which do not, in words."""
    alone = [name for group in groups if len(group) == 1 for name in group]
    count = len(groups) - len(alone)
    if not count:
        return f"no two of them show enough of the same: {max(matched.pairs.values())} matches at most"
    others = f", and {len(alone)} without a good match ({first_few(alone)})" if alone else ""
    largest = f"{len(groups[0])} ({first_few(groups[0])})"
    return f"they do not belong together: {pluralize(count, 'group')} of good matches, the largest of {largest}{others}"


def explain_unplaced(matched: MatchGraph, models: Sequence[set[str]]) -> dict[str, str]:
    """Return the likely reason of each photograph that is not in the first of the models."""
    placed = models[0]
    compared = sorted(placed)[:: max(1, len(placed) // SHARPNESS_OF)]
    middle = np.median([matched.sharpness_of(name) for name in compared], axis=0)
    found = {}
    for name in sorted(set(matched.features) - placed):
        other = next((model for model in models[1:] if name in model), None)
        found[name] = (
            f"in another model, with {first_few(sorted(other - {name}))}"
            if other
            else _reason(matched, name, placed, middle)
        )
    return found


def _reason(matched: MatchGraph, name: str, placed: set[str], middle: NDArray[np.float64]) -> str:
    matches = matched.matches[name]
    among = {other: count for other, count in matches.items() if other in placed}
    if matched.features[name] < FEW_FEATURES:
        return f"only {pluralize(matched.features[name], 'feature')}: blurred, dark, or of a plain surface"
    is_soft = is_blurred(matched.sharpness_of(name), middle)
    may_be = "; it may be blurred" if is_soft else ""
    if not matches:  # no more is known: one of broad shapes is as soft as a blurred one
        return f"shows nothing that another photograph shows{may_be}"
    best = max(matches, key=lambda other: (matches[other], other))
    if not among:
        return f"matches {best} alone, which is not placed either"
    if max(among.values()) < FEW_MATCHES:
        return f"few matches, at most {max(among.values())}, with {max(among, key=lambda o: (among[o], o))}{may_be}"
    return "blurred" if is_soft else f"{matches[best]} matches with {best}, but too few on points of the model"
