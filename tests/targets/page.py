"""The generated part of docs/results/compilers.md."""

from collections.abc import Iterable, Mapping
from itertools import zip_longest

from tests.targets import accepted
from tests.targets.builds import KERNELS
from tests.targets.figures import MAX_GROUP, MAX_LOCAL, Figures, Place, Table

PAGE = KERNELS.parent / "docs" / "results" / "compilers.md"
BEGIN, END = "<!-- figures: begin (python -m tests.targets --write) -->", "<!-- figures: end -->"
TITLES = {"amd": "AMD", "nvidia": "NVIDIA", "intel": "Intel"}
CELLS = {
    "amd": "vector registers of a lane, and the share of a SIMD's waves that fit, both from clang",
    "nvidia": "registers of a lane from ptxas, and the share of a multiprocessor's warps that fit, by CUDA's guide",
    "intel": "lanes of a thread from ocloc, and the share of a subslice's threads that fit, by Intel's runtime",
}
NAMES = {
    "gfx900": "Vega", "gfx90a": "MI200", "gfx1030": "RX 6800", "gfx1100": "RX 7900",
    "sm_75": "RTX 20", "sm_86": "RTX 30", "sm_90": "H100",
    "skl": "Gen9", "tgllp": "Tiger Lake", "dg2": "Arc A", "pvc": "Max",
}  # fmt: skip
COUNTED = ("blend_forward", "blend_backward", "sum_records")
COUNTS = ("global loads", "global stores", "local loads", "local stores")
SPACE = "\N{NO-BREAK SPACE}"
DOT, PER_CENT = f"{SPACE}·{SPACE}", f"{SPACE}%"
Row = tuple[str, str]  # kernel, variant


def write(table: Table, versions: Mapping[str, str], vendor_of: Mapping[str, str]) -> None:
    """Replace the figures of docs/results/compilers.md."""
    PAGE.write_text(_with(text(table, versions, vendor_of)), encoding="utf-8")


def faults(table: Table, versions: Mapping[str, str], vendor_of: Mapping[str, str]) -> list[str]:
    """Return the first line of docs/results/compilers.md that differs from these figures, as a sentence; or nothing."""
    shown, fresh = PAGE.read_text(encoding="utf-8"), _with(text(table, versions, vendor_of))
    if shown == fresh:
        return []
    pairs = zip_longest(shown.splitlines(), fresh.splitlines(), fillvalue="")
    old, new = next((old, new) for old, new in pairs if old != new)
    return [f"{PAGE.name} shows '{old}', expected '{new}': run python -m tests.targets --write"]


def _with(figures: str) -> str:
    """The page with these figures."""
    before, begin, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise SystemExit(f"{PAGE}: expected a line '{BEGIN}' and, after it, '{END}'")
    return f"{before}{BEGIN}\n\n{figures}\n{END}{after}"


def text(table: Table, versions: Mapping[str, str], vendor_of: Mapping[str, str]) -> str:
    """Return the figures as Markdown."""
    simt = {place: of for place, of in table.items() if place.schedule == "simt"}
    rows = _rows(simt)
    parts = [_summary(table, simt), accepted.text()]
    for vendor, title in TITLES.items():
        targets = [target for target, whose in vendor_of.items() if whose == vendor]
        cell = f"A cell: {CELLS[vendor]}."
        parts.append(f"### {title}\n\nCompiled by {versions[vendor]}. {cell}")
        parts.append(_vendor_table(simt, rows, targets, vendor))
    parts.append(_counts(simt))
    return "\n\n".join(parts) + "\n"


def _summary(table: Table, simt: Table) -> str:
    kernels, targets = {place.kernel for place in table}, {place.target for place in table}
    spilling = {place.kernel for place, of in table.items() if place.schedule == "wide" and of.spills}
    scalar = sorted({f"`{p.kernel}` on {p.target}" for p, of in simt.items() if of.counts.get("scalar spills")})
    group, local = max(of.group for of in simt.values()), max(of.local for of in simt.values())
    lines = [
        f"All {len(kernels)} kernels compile for all {len(targets)} GPUs, in both schedules, except for known faults",
        "below. In *simt*, the schedule of GPUs, no vector register spills into memory, a group has at most",
        f"{group} items ({MAX_GROUP} are allowed) and {local} bytes of local memory ({MAX_LOCAL} are allowed).",
        f"*wide*, which no GPU uses by default, spills in {len(spilling)} of them." if spilling else "",
        f"AMD's scalar registers overflow into vector registers in {', '.join(scalar)}." if scalar else "",
    ]
    return "\n".join(filter(None, lines))


def _rows(simt: Table) -> list[Row]:
    """The kernels that ask for much on some target: local or private memory, or fewer than half of the waves."""
    asking = {
        (place.kernel, place.variant)
        for place, of in simt.items()
        if of.scratch or of.local >= 1024 or 2 * of.waves < of.most_waves
    }
    kept = {row for row in asking if "," not in row[1] and not _as_without(simt, row)}
    return sorted(kept)


def _as_without(simt: Table, row: Row) -> bool:
    """Whether a variant has the figures of the kernel without it, on every target."""
    kernel, variant = row
    own = {place: of for place, of in simt.items() if (place.kernel, place.variant) == row}
    base = [simt.get(Place(place.target, place.schedule, kernel)) for place in own]
    return bool(variant) and base == list(own.values())


def _vendor_table(simt: Table, rows: list[Row], targets: list[str], vendor: str) -> str:
    head = ["kernel", "items", "local bytes", "private bytes", *(f"{target}, {NAMES[target]}" for target in targets)]
    lines = [_line(head), _line("---" for _ in head)]
    for kernel, variant in rows:
        actual = [simt[Place(target, "simt", kernel, variant)] for target in targets]
        facts = [
            _range(of.group for of in actual),
            _range(of.local for of in actual),
            _range(of.scratch for of in actual),
        ]
        lines.append(_line([f"`{kernel}`" + f" {variant}".rstrip(), *facts, *(_cell(of, vendor) for of in actual)]))
    others = {place: of for place, of in simt.items() if (place.kernel, "") not in rows and not place.variant}
    count = len({place.kernel for place in others})
    worst = [_others([of for place, of in others.items() if place.target == target], vendor) for target in targets]
    own = [of for place, of in others.items() if place.target in targets]
    facts = [f"≤ {max(values)}" for values in ([of.group for of in own], [of.local for of in own])]
    lines.append(_line([f"the {count} others", *facts, "0", *worst]))
    return "\n".join(lines)


def _cell(of: Figures, vendor: str) -> str:
    return f"{of.width if vendor == 'intel' else of.registers}{DOT}{of.occupancy}{PER_CENT}"


def _others(figures: list[Figures], vendor: str) -> str:
    size = f"≥ {min(of.width for of in figures)}" if vendor == "intel" else f"≤ {max(of.registers for of in figures)}"
    return f"{size.replace(' ', SPACE)} ·{SPACE}≥{SPACE}{min(of.occupancy for of in figures)}{PER_CENT}"


def _counts(simt: Table) -> str:
    """Instructions that reach memory, in the code of one target of each vendor whose assembly can be read."""
    head = ["kernel", "target", *COUNTS]
    lines = [_line(head), _line("---" for _ in head)]
    for kernel in COUNTED:
        for target in ("gfx1030", "sm_86"):
            of = simt[Place(target, "simt", kernel)]
            lines.append(_line([f"`{kernel}`", target, *(str(of.counts[name]) for name in COUNTS)]))
    title = (
        "### Loads and stores\n\nInstructions in the code of the kernels that move most data: AMD's in machine code,"
    )
    return f"{title}\nNVIDIA's in PTX.\n\n" + "\n".join(lines)


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _range(values: Iterable[int]) -> str:
    known = sorted({*values})
    return str(known[0]) if len(known) == 1 else f"{known[0]} to {known[-1]}"
