"""Explain why photographs could not be registered, from their features and matches."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import median
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import first_few, pluralize
from clsplat.prepare.database import read_feature_counts, read_verified_pairs
from clsplat.prepare.gather import MIN_PHOTOGRAPHS
from clsplat.scene.quality import is_blurred, measure_sharpness

FEW_FEATURES = 300  # per photograph: a plain wall has tens, a garden thousands
MIN_TEXTURED = 1000  # features of a photograph with enough texture
FEW_MATCHES = 30  # matches with the points of a model; COLMAP does not register a photograph with fewer
MAX_COMPARED = 15  # number of registered photographs from which the typical sharpness is computed


@dataclass
class MatchGraph:
    """A graph of photographs: the number of features of each photograph, and the pairs that match."""

    images: Path
    features: dict[str, int]
    pairs: dict[tuple[str, str], int]  # geometrically verified matches
    sharpness: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    @classmethod
    def from_database(cls, pycolmap: ModuleType, database: Path, images: Path) -> "MatchGraph":
        """Read the graph from COLMAP's database."""
        return cls(images, read_feature_counts(pycolmap, database), read_verified_pairs(pycolmap, database))

    @cached_property
    def matches(self) -> dict[str, dict[str, int]]:
        """The number of verified matches between each photograph and each of the others."""
        matches: dict[str, dict[str, int]] = {name: {} for name in self.features}
        for (a, b), count in self.pairs.items():
            matches[a][b] = matches[b][a] = count
        return matches

    def groups(self, min_matches: int) -> list[list[str]]:
        """Return the groups connected by pairs with at least `min_matches` matches, each sorted, the largest first."""
        return connected_groups(self.features, [pair for pair, count in self.pairs.items() if count >= min_matches])

    def has_unrelated_photographs(self) -> bool:
        """Return whether most photographs match no other photograph, although they have many features.

        If so, denser features do not help: photographs of one scene have at least some matches, even if too few to
        register a camera.  Photographs of plain surfaces have few features, and denser features may help.
        """
        is_textured = median(self.features.values()) >= MIN_TEXTURED
        return is_textured and len(self.groups(1)[0]) < len(self.features) / 2

    def measure_sharpness(self, name: str) -> NDArray[np.float64]:
        """Return both sharpness values of a photograph, [2], from the cache if possible."""
        if name not in self.sharpness:
            self.sharpness[name] = measure_sharpness(self.images / name)
        return self.sharpness[name]


def connected_groups(names: Iterable[str], pairs: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Return the groups of names connected by pairs, each sorted, the largest first."""
    group_by_name = {name: {name} for name in names}
    for a, b in pairs:
        if group_by_name[a] is not group_by_name[b]:
            group_by_name[a] |= group_by_name[b]
            group_by_name.update(dict.fromkeys(group_by_name[b], group_by_name[a]))
    groups = {id(group): sorted(group) for group in group_by_name.values()}
    return sorted(groups.values(), key=lambda group: (-len(group), group))


def diagnose(graph: MatchGraph) -> str:
    """Return the likely reason why no photograph could be registered, and a remedy."""
    count = round(median(graph.features.values()))
    if count < FEW_FEATURES:
        problem = f"half of them have {f'at most {count}' if count else 'no'} features"
        return (
            f"{problem if any(graph.features.values()) else 'none has features'}, where thousands are usual: they are "
            "blurred, dark, or show plain surfaces; take sharp photos of textured objects"
        )
    if not graph.pairs:
        return "no two of them show the same features; take photos with more overlap, of a static scene"
    groups = graph.groups(FEW_MATCHES)
    if len(groups[0]) < max(MIN_PHOTOGRAPHS, len(graph.features) / 2):
        return f"{_describe_groups(graph, groups)}; take photos of one scene, with more overlap"
    return "take more photos, sharp and a step apart, of a textured, static scene"


def _describe_groups(graph: MatchGraph, groups: Sequence[list[str]]) -> str:
    """Describe which photographs match each other, and which do not match any other photograph."""
    single_names = [name for group in groups if len(group) == 1 for name in group]
    count = len(groups) - len(single_names)
    if not count:
        return f"no two of them overlap enough: at most {max(graph.pairs.values())} features match"
    suffix = f", and {len(single_names)} without a good match ({first_few(single_names)})" if single_names else ""
    first_group = f"{len(groups[0])} ({first_few(groups[0])})"
    return f"they do not connect: {pluralize(count, 'group')} with good matches, the largest with {first_group}{suffix}"


def explain_unregistered(graph: MatchGraph, models: Sequence[set[str]]) -> dict[str, str]:
    """Return the likely reason why each photograph is missing from the first model, by the name of the photograph.

    models: the names of the photographs in each model, the largest model first.
    """
    main_model = models[0]
    sample = sorted(main_model)[:: max(1, len(main_model) // MAX_COMPARED)]
    typical_sharpness = np.median([graph.measure_sharpness(name) for name in sample], axis=0)
    reasons = {}
    for name in sorted(set(graph.features) - main_model):
        model = next((model for model in models[1:] if name in model), None)
        reasons[name] = (
            f"in a separate reconstruction, with {first_few(sorted(model - {name}))}"
            if model
            else _explain(graph, name, main_model, typical_sharpness)
        )
    return reasons


def _explain(graph: MatchGraph, name: str, registered_names: set[str], typical_sharpness: NDArray[np.float64]) -> str:
    matches = graph.matches[name]
    counts = {other: count for other, count in matches.items() if other in registered_names}
    if graph.features[name] < FEW_FEATURES:
        return f"only {pluralize(graph.features[name], 'feature')}: blurred, dark, or a plain surface"
    is_blurry = is_blurred(graph.measure_sharpness(name), typical_sharpness)
    note = "; it may be blurred" if is_blurry else ""
    if not matches:  # only a guess: a photograph without fine detail measures like a blurred one
        return f"matches no other photo{note}"
    best = max(matches, key=lambda other: (matches[other], other))
    if not counts:
        return f"matches only {best}, which is not registered either"
    if max(counts.values()) < FEW_MATCHES:
        return f"few matches, at most {max(counts.values())}, with {max(counts, key=lambda o: (counts[o], o))}{note}"
    return "blurred" if is_blurry else f"{matches[best]} matches with {best}, but too few on points of the model"
