"""NVIDIA GPUs: clang's PTX, and the report of ptxas."""

import math
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tests.targets.builds import Build
from tests.targets.compilers import Clang, CompileError, find_clang, find_ptxas, first, run
from tests.targets.figures import Figures

TRIPLE = "nvptx64--nvidiacl"
WARP = 32  # items
REGISTERS = 65536  # of a multiprocessor
WARP_REGISTERS = 256  # a warp takes multiples of this
WARPS_TOGETHER = 4  # registers are shared out among four parts of a multiprocessor
COUNTS = {
    f"{kind} {what}": rf"{op}\.{space}"
    for kind, space in (("global", "global"), ("local", "shared"), ("scratch", "local"))
    for what, op in (("loads", "ld"), ("stores", "st"))
}


@dataclass(frozen=True)
class Multiprocessor:
    """Limits of one compute capability, from the technical specifications of the CUDA C++ programming guide."""

    warps: int
    groups: int
    local: int  # bytes of shared memory
    reserved: int  # of them, bytes that the system takes for each group
    unit: int  # bytes; shared memory is given out in multiples

    def resident(self, registers: int, local: int, group: int) -> int:
        """Return how many warps fit at once, as the CUDA occupancy calculator counts them."""
        warps = -(-group // WARP)
        warp_registers = -(-registers * WARP // WARP_REGISTERS) * WARP_REGISTERS
        by_registers = REGISTERS // max(warp_registers, 1) // WARPS_TOGETHER * WARPS_TOGETHER // warps
        taken = -(-(local + self.reserved) // self.unit) * self.unit
        by_local = self.local // taken if taken else self.groups
        return warps * min(self.warps // warps, self.groups, by_registers, by_local)


TARGETS = {
    "sm_75": Multiprocessor(warps=32, groups=16, local=64 * 1024, reserved=0, unit=256),
    "sm_86": Multiprocessor(warps=48, groups=16, local=100 * 1024, reserved=1024, unit=128),
    "sm_90": Multiprocessor(warps=64, groups=32, local=228 * 1024, reserved=1024, unit=128),
}


@cache
def compilers() -> tuple[Clang, str]:
    """Return clang with its library for PTX, and ptxas.  Raises Missing."""
    return find_clang("nvptx64--nvidiacl.bc"), find_ptxas()


def version() -> str:
    """Return the compilers' names and versions.  Raises Missing."""
    clang, ptxas = compilers()
    return f"clang {clang.version} with libclc, ptxas {first(r'V([0-9.]+)', run(ptxas, '--version'))}"


def compile_kernels(build: Build, target: str, folder: Path) -> dict[str, Figures]:
    """Compile a build for `target`; the files go into `folder`.  Raises CompileError."""
    clang, ptxas = compilers()
    source, ptx = folder / "kernels.cl", folder / "kernels.ptx"
    source.write_text(build.source)
    clang.compile(source, [*build.options, "-Xclang", "-target-cpu", "-Xclang", target], TRIPLE, ptx)
    report = run(ptxas, "-v", f"-arch={target}", ptx, "-o", folder / "kernels.cubin")
    return parse(clang.preprocess(source, build.options, TRIPLE), ptx.read_text(), report, target)


def parse(text: str, ptx: str, report: str, target: str) -> dict[str, Figures]:
    """Return the figures of each kernel from its text without macros, its PTX, and ptxas' report.

    PTX of OpenCL's kernels holds no size of a group.  Raises CompileError.
    """
    figures = {}
    for name, notes in re.findall(r"Compiling entry function '(\w+)'((?:.*\n)*?.*Used .*)", report):
        code = first(rf"\.entry {name}\(([^\0]*?)^}}$", ptx)
        sizes = first(rf"reqd_work_group_size\(([^;{{]*?)\)\)\)\s*void {name}\(", text)  # '(16 * 16), 1, 1'
        group = math.prod(map(int, re.findall(r"\d+", sizes)))
        registers, local = int(first(r"Used (\d+) registers", notes)), _number(r"(\d+) bytes smem", notes)
        figures[name] = Figures(
            registers=registers,
            spills=int(first(r"(\d+) bytes spill stores", notes)),
            scratch=int(first(r"(\d+) bytes stack frame", notes)),
            local=local,
            group=group,
            width=WARP,
            waves=TARGETS[target].resident(registers, local, group),
            most_waves=TARGETS[target].warps,
            counts={kind: len(re.findall(rf"\s{word}\.", code)) for kind, word in COUNTS.items()},
        )
    if not figures:
        raise CompileError("ptxas names no kernel")
    return figures


def _number(pattern: str, text: str) -> int:
    match = re.search(pattern, text)
    return int(match[1]) if match else 0
