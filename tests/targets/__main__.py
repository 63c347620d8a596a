"""Compile every kernel for GPUs that are not present, and evaluate the output of the compilers."""

import argparse
import os
import sys
import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from tests.targets import accepted, amd, figures, intel, nvidia, page
from tests.targets.builds import SCHEDULES, Build, builds
from tests.targets.compilers import CompileError, Missing
from tests.targets.figures import Figures, Place, Table


class Vendor(Protocol):
    """What the module of a vendor's compilers holds."""

    @property
    def TARGETS(self) -> Mapping[str, object]: ...

    def version(self) -> str: ...

    def compile_kernels(self, build: Build, target: str, folder: Path) -> dict[str, Figures]: ...


VENDORS: dict[str, Vendor] = {"amd": amd, "nvidia": nvidia, "intel": intel}
VENDOR_OF = {target: vendor for vendor, module in VENDORS.items() for target in module.TARGETS}


def main() -> int:
    asked = arguments()
    versions, missing = versions_of({VENDOR_OF[target] for target in asked.targets})
    for vendor, text in [*versions.items(), *missing.items()]:
        print(f"{vendor}: {text}", file=sys.stderr)
    targets = [target for target in asked.targets if VENDOR_OF[target] in versions]
    work = [
        (build, target) for build in builds(asked.schedule or SCHEDULES, asked.file or ["*.cl"]) for target in targets
    ]
    table, failures = compile_all(work)
    if versions and not work:
        failures.append(f"no kernel file is named {', '.join(asked.file)}")
    failures = accepted.unexpected_failures(failures + figures.faults(table), asked.write or asked.check)
    if asked.required or not versions:
        failures += missing.values()
    if asked.json:
        figures.save(table, asked.json)
    if asked.check and not failures:
        failures += page.faults(table, versions, VENDOR_OF)
    if asked.write and not failures:
        page.write(table, versions, VENDOR_OF)
    if asked.compare:
        before = figures.load(asked.compare)
        if asked.file:
            before = {place: of for place, of in before.items() if place in table}
        print("\n".join(figures.differences(before, table) or ["no figure differs"]))
    for failure in failures:
        print(failure, file=sys.stderr)
    print(f"{len(work)} builds, figures of {len(table)} kernels, {len(failures)} faults", file=sys.stderr)
    return 1 if failures else 0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.targets", description=__doc__)
    names = [*VENDORS, *VENDOR_OF]
    parser.add_argument(
        "targets", nargs="*", metavar="TARGET", help=f"whose compiler must be there: {', '.join(names)}; default: all"
    )
    parser.add_argument("--schedule", choices=SCHEDULES, action="append", help="default: both")
    parser.add_argument("--file", action="append", metavar="NAME.cl", help="default: every kernel file")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="print what differs from figures of --json")
    parser.add_argument(
        "--write", action="store_true", help=f"write the figures into {page.PAGE.name}; takes no others"
    )
    parser.add_argument(
        "--check", action="store_true", help=f"fail where {page.PAGE.name} shows other figures; takes no others"
    )
    asked = parser.parse_args()
    if (asked.write or asked.check) and (asked.targets or asked.schedule or asked.file):
        parser.error("--write and --check take all targets, both schedules and all files")
    if unknown := sorted({*asked.targets} - {*names}):
        parser.error(f"no target named {', '.join(unknown)}; there are {', '.join(names)}")
    asked.required = asked.write or asked.check or bool(asked.targets)
    wanted = {*(asked.targets or names)}
    asked.targets = [target for target, vendor in VENDOR_OF.items() if {target, vendor} & wanted]
    return asked


def versions_of(vendors: Iterable[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the compilers of each vendor, and a sentence for each whose compilers are missing."""
    versions, missing = {}, {}
    for vendor in sorted(vendors):
        try:
            versions[vendor] = VENDORS[vendor].version()
        except Missing as error:
            missing[vendor] = str(error)
    return versions, missing


def compile_all(work: list[tuple[Build, str]]) -> tuple[Table, list[str]]:
    """Compile builds for targets, several at a time; return the figures and a sentence for each failure."""
    table: Table = {}
    failures = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for number, ((build, target), found) in enumerate(zip(work, pool.map(compile_one, work), strict=True), 1):
            if sys.stderr.isatty():
                print(f"{number} of {len(work)} builds", end="\r", file=sys.stderr)
            if isinstance(found, str):
                failures.append(found)
            else:
                table |= {Place(target, build.schedule, name, build.variant): of for name, of in found.items()}
    return table, failures


def compile_one(job: tuple[Build, str]) -> dict[str, Figures] | str:
    build, target = job
    with tempfile.TemporaryDirectory(prefix="targets-") as folder:
        try:
            result = VENDORS[VENDOR_OF[target]].compile_kernels(build, target, Path(folder))
        except CompileError as error:
            return f"{target}: {build.text} does not compile: {error}"
    if lost := sorted({*build.kernels} - result.keys()):
        return f"{target}: {build.text}: the compiler says nothing of {', '.join(lost)}"
    return result


if __name__ == "__main__":
    sys.exit(main())
