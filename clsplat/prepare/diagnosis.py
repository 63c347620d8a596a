"""Explain why photographs could not be placed, from their features and matches."""

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

FEW_FEATURES = 300  # per photograph: a plain wall has tens, a garden thousands
TEXTURED = 1000  # features per photograph, from which it has enough texture
FEW_MATCHES = 30  # matches with the points of a model: COLMAP places no photograph with fewer
SHARPNESS_OF = 15  # placed photographs whose sharpness the others are compared with


@dataclass
class MatchGraph:
    """The photographs, their numbers of features, and the pairs that match."""

    images: Path
    features: dict[str, int]
    pairs: dict[tuple[str, str], int]  # geometrically verified matches
    sharpness: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    @classmethod
    def from_database(cls, pycolmap: ModuleType, database: Path, images: Path) -> "MatchGraph":
        """Read the graph from COLMAP's database."""
        return cls(images, feature_counts(pycolmap, database), verified(pycolmap, database))

    @cached_property
    def matches(self) -> dict[str, dict[str, int]]:
        """The number of verified matches of each photograph with each other one."""
        matches: dict[str, dict[str, int]] = {name: {} for name in self.features}
        for (a, b), count in self.pairs.items():
            matches[a][b] = matches[b][a] = count
        return matches

    def groups(self, min_matches: int) -> list[list[str]]:
        """Return the groups that pairs with at least `min_matches` connect, each sorted, the largest first."""
        return connected_groups(self.features, [pair for pair, count in self.pairs.items() if count >= min_matches])

    def have_nothing_in_common(self) -> bool:
        """Return whether denser features would not help: most photographs match no others in spite of many features.

        Photographs of one scene have at least some matches, even if too few to place a camera; photographs of plain
        surfaces have too few features, and denser ones may help.
        """
        is_textured = median(self.features.values()) >= TEXTURED
        return is_textured and len(self.groups(1)[0]) < len(self.features) / 2

    def sharpness_of(self, name: str) -> NDArray[np.float64]:
        """Return both sharpness values of a photograph, measured once."""
        if name not in self.sharpness:
            self.sharpness[name] = sharpness_of(self.images / name)
        return self.sharpness[name]


def connected_groups(names: Iterable[str], pairs: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Return the groups of names that pairs connect, each sorted, the largest first."""
    group_of = {name: {name} for name in names}
    for a, b in pairs:
        if group_of[a] is not group_of[b]:
            group_of[a] |= group_of[b]
            group_of.update(dict.fromkeys(group_of[b], group_of[a]))
    groups = {id(group): sorted(group) for group in group_of.values()}
    return sorted(groups.values(), key=lambda group: (-len(group), group))


def diagnose(matched: MatchGraph) -> str:
    """Return the likely reason why no photographs could be placed, with a remedy."""
    middle = round(median(matched.features.values()))
    if middle < FEW_FEATURES:
        few = f"half of them have {f'at most {middle}' if middle else 'no'} features"
        return (
            f"{few if any(matched.features.values()) else 'none has features'}, where thousands are usual: they are "
            "blurred, dark, or show plain surfaces; take sharp photographs of textured objects"
        )
    if not matched.pairs:
        return "no two of them show the same features; take photographs with more overlap, of a static scene"
    groups = matched.groups(FEW_MATCHES)
    if len(groups[0]) < max(MIN_PHOTOGRAPHS, len(matched.features) / 2):
        return f"{_parts(matched, groups)}; take photographs of one scene, with more overlap"
    return "take more sharp photographs, a step apart, of a textured, static scene"


def _parts(matched: MatchGraph, groups: Sequence[list[str]]) -> str:
    """Describe which photographs match one another and which match none."""
    single = [name for group in groups if len(group) == 1 for name in group]
    count = len(groups) - len(single)
    if not count:
        return f"no two of them overlap enough: {max(matched.pairs.values())} matches at most"
    others = f", and {len(single)} without a good match ({first_few(single)})" if single else ""
    largest = f"{len(groups[0])} ({first_few(groups[0])})"
    return f"they do not connect: {pluralize(count, 'group')} with good matches, the largest of {largest}{others}"


def explain_unplaced(matched: MatchGraph, models: Sequence[set[str]]) -> dict[str, str]:
    """Return the likely reason why each photograph is not in the first of the models."""
    placed = models[0]
    compared = sorted(placed)[:: max(1, len(placed) // SHARPNESS_OF)]
    middle = np.median([matched.sharpness_of(name) for name in compared], axis=0)
    reasons = {}
    for name in sorted(set(matched.features) - placed):
        other = next((model for model in models[1:] if name in model), None)
        reasons[name] = (
            f"in another model, with {first_few(sorted(other - {name}))}"
            if other
            else _reason(matched, name, placed, middle)
        )
    return reasons


def _reason(matched: MatchGraph, name: str, placed: set[str], middle: NDArray[np.float64]) -> str:
    matches = matched.matches[name]
    among = {other: count for other, count in matches.items() if other in placed}
    if matched.features[name] < FEW_FEATURES:
        return f"only {pluralize(matched.features[name], 'feature')}: blurred, dark, or a plain surface"
    is_soft = is_blurred(matched.sharpness_of(name), middle)
    may_be = "; it may be blurred" if is_soft else ""
    if not matches:  # only a guess: a photograph without fine detail measures like a blurred one
        return f"matches no other photograph{may_be}"
    best = max(matches, key=lambda other: (matches[other], other))
    if not among:
        return f"matches only {best}, which is not placed either"
    if max(among.values()) < FEW_MATCHES:
        return f"few matches, at most {max(among.values())}, with {max(among, key=lambda o: (among[o], o))}{may_be}"
    return "blurred" if is_soft else f"{matches[best]} matches with {best}, but too few on points of the model"
