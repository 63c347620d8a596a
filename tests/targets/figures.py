"""Compiler statistics of a kernel, their limits, and comparisons of two sets."""

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

MAX_LOCAL = 32 * 1024  # bytes; docs/devices.md promises that no more is needed
MAX_GROUP = 256  # items


@dataclass(frozen=True)
class Figures:
    """One kernel on one target."""

    registers: int  # a lane: VGPRs (AMD), registers (NVIDIA); those of a hardware thread on Intel
    spills: int  # vector registers kept in memory: registers on AMD and Intel, bytes stored on NVIDIA
    scratch: int  # bytes of private memory: a lane on AMD and NVIDIA, a hardware thread on Intel
    local: int  # bytes a group
    group: int  # items
    width: int  # items of a wave, a warp or a hardware thread
    waves: int  # that fit at once: on a SIMD (AMD), a multiprocessor (NVIDIA), a subslice (Intel)
    most_waves: int  # the hardware's limit of them
    counts: dict[str, int] = field(default_factory=dict)  # instructions, and scalar registers, where the compiler says

    @property
    def occupancy(self) -> int:
        """Waves of the most possible, per cent."""
        return round(100 * self.waves / self.most_waves)


@dataclass(frozen=True, order=True)
class Place:
    """Which kernel of which build on which target."""

    target: str
    schedule: str
    kernel: str
    variant: str = ""

    @property
    def text(self) -> str:
        notes = ", ".join(filter(None, [self.schedule if self.schedule == "wide" else "", self.variant]))
        return f"{self.target} {self.kernel}" + (f" ({notes})" if notes else "")


Table = dict[Place, Figures]


def faults(table: Table) -> list[str]:
    """Return a sentence about each limit that a kernel breaks; the wide schedule may spill: it is for CPUs."""
    results = []
    for place, of in sorted(table.items()):
        if of.spills and place.schedule == "simt":
            results.append(f"{place.text} spills registers ({of.spills})")
        if of.local > MAX_LOCAL:
            results.append(f"{place.text} takes {of.local} bytes of local memory; at most {MAX_LOCAL} are allowed")
        if of.group > MAX_GROUP:
            results.append(f"{place.text} has groups of {of.group} items; at most {MAX_GROUP} are allowed")
    return results


def save(table: Table, file: Path) -> None:
    """Write the figures as JSON, a record for each kernel and target."""
    file.write_text(json.dumps([asdict(place) | asdict(of) for place, of in sorted(table.items())], indent=1) + "\n")


def load(file: Path) -> Table:
    """Read what `save` wrote."""
    names = {item.name for item in fields(Place)}
    table = {}
    for record in json.loads(file.read_text()):
        place = Place(**{name: record.pop(name) for name in names})
        table[place] = Figures(**record)
    return table


def differences(before: Table, after: Table) -> list[str]:
    """Return a line for each kernel whose figures changed, came or went, on targets that both tables hold."""
    both = {(place.target, place.schedule) for place in before} & {(place.target, place.schedule) for place in after}
    lines = []
    for place in sorted(before.keys() | after.keys()):
        if (place.target, place.schedule) not in both:
            continue
        if place not in before or place not in after:
            lines.append(f"{place.text}: {'new' if place in after else 'gone'}")
            continue
        old, new = _flat(before[place]), _flat(after[place])
        changed = [f"{k} {old.get(k, 0)} → {new.get(k, 0)}" for k in old | new if old.get(k, 0) != new.get(k, 0)]
        if changed:
            lines.append(f"{place.text}: {', '.join(changed)}")
    return lines


def _flat(of: Figures) -> dict[str, int]:
    values = asdict(of)
    counts: dict[str, int] = values.pop("counts")
    return values | counts
