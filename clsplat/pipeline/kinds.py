"""Which classes of settings a pipeline has."""

from clsplat.density.edit import Rule
from clsplat.density.statistics import Statistic
from clsplat.settings import Settings, variants


def kinds_of(value: object) -> set[type]:
    """Return the classes of all settings inside settings, and of the statistics that their rules read."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return {kind for inner in value for kind in kinds_of(inner)}
    if not isinstance(value, Settings):
        return set()
    kinds = {type(value), *kinds_of([getattr(value, name) for name in type(value).model_fields])}
    if isinstance(value, Rule):
        known = variants(Statistic)
        read = {known[name] for name in value.statistics if name in known}
        kinds |= read | {known[kind.divisor] for kind in read if kind.divisor in known}
    return kinds
