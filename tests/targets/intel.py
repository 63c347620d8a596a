"""Intel's GPUs: the notes that ocloc writes into its binaries, and its warnings about spills."""

import re
import struct
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from tests.targets.builds import Build
from tests.targets.compilers import CompileError, find_ocloc, first, run
from tests.targets.figures import Figures

REGISTERS = 128  # of a hardware thread; with twice as many, half of the threads fit
ZE_INFO = 0xFF000011  # type of the section of notes
BARRIERS = 32  # groups with barriers that a subslice holds
POWERS = (1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True)
class Subslice:
    """What shares local memory (a subslice, dual subslice or Xe core), by Intel's GPU Occupancy Calculator.

    https://github.com/oneapi-src/oneAPI-samples/tree/master/Tools/GPU-Occupancy-Calculator
    """

    threads: int  # hardware threads
    local: int  # KiB
    sizes: tuple[int, ...] = POWERS  # KiB that a group can be given

    def resident(self, registers: int, local: int, group: int, width: int) -> int:
        """Return how many threads are filled, as Intel's compute runtime counts groups (kernel_helpers.cpp there)."""
        threads = -(-group // width)
        groups = self.threads * REGISTERS // max(registers, REGISTERS) // threads
        if local:
            given = next(size for size in self.sizes if local <= 1024 * size)
            groups = min(groups, BARRIERS, self.local // given)
        return groups * threads


TARGETS = {
    "skl": Subslice(threads=56, local=64),
    "tgllp": Subslice(threads=112, local=64),
    "dg2": Subslice(threads=128, local=128),
    "pvc": Subslice(threads=64, local=128, sizes=(1, 2, 4, 8, 16, 24, 32, 48, 64, 96, 128)),
}


@cache
def compiler() -> str:
    """Return ocloc.  Raises Missing."""
    return find_ocloc()


def version() -> str:
    """Return the compiler's name and version.  Raises Missing."""
    with tempfile.TemporaryDirectory(prefix="targets-") as folder:
        run(compiler(), "query", "OCL_DRIVER_VERSION", folder=Path(folder))  # writes a file of this name
        text = (Path(folder) / "OCL_DRIVER_VERSION").read_text()
    return f"ocloc {first(r'([0-9.]+)', text)}"


def compile_kernels(build: Build, target: str, folder: Path) -> dict[str, Figures]:
    """Compile a build for `target`; the files go into `folder`.  Raises CompileError."""
    source = folder / "kernels.cl"
    source.write_text(build.source)
    options = ["-options", " ".join(build.options), "--format", "zebin", "-output_no_suffix"]
    report = run(
        compiler(), "compile", "-file", source, "-device", target, *options, "-out_dir", folder, "-output", "kernels"
    )
    return parse((folder / "kernels").read_bytes(), report, target)


def parse(binary: bytes, report: str, target: str) -> dict[str, Figures]:
    """Return the figures of each kernel from the binary's section .ze_info and the report.  Raises CompileError."""
    kernels = YAML(typ="safe").load(_notes(binary))["kernels"]
    own = [of for of in kernels if "required_work_group_size" in of["execution_env"]]  # the compiler may add others
    return {of["name"]: _figures(of, report, target) for of in own}


def _notes(binary: bytes) -> str:
    """Return the section .ze_info of a 64-bit ELF file."""
    (headers,) = struct.unpack_from("<Q", binary, 40)
    size, count = struct.unpack_from("<HH", binary, 58)
    for place in range(headers, headers + size * count, size):
        kind, _, _, offset, length = struct.unpack_from("<4xIQQQQ", binary, place)
        if kind == ZE_INFO:
            return binary[offset : offset + length].rstrip(b"\0").decode()
    raise CompileError("the binary holds no .ze_info")


def _figures(of: dict[str, Any], report: str, target: str) -> Figures:
    name, run_with = of["name"], of["execution_env"]
    local, registers, width = run_with.get("slm_size", 0), run_with["grf_count"], run_with["simd_size"]
    x, y, z = run_with["required_work_group_size"]
    spilled = re.search(rf"kernel {name} .*spilled around (\d+)", report)
    return Figures(
        registers=registers,
        spills=int(spilled[1]) if spilled else run_with.get("spill_size", 0),
        scratch=sum(item["size"] for item in of.get("per_thread_memory_buffers", [])),
        local=local,
        group=x * y * z,
        width=width,
        waves=TARGETS[target].resident(registers, local, x * y * z, width),
        most_waves=TARGETS[target].threads,
    )
