"""AMD GPUs: clang's assembly, with its notes on registers, memory, and occupancy."""

import re
from functools import cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from tests.targets.builds import Build
from tests.targets.compilers import Clang, find_clang, first
from tests.targets.figures import Figures

TARGETS = {"gfx900": 10, "gfx90a": 8, "gfx1030": 16, "gfx1100": 16}  # waves that a SIMD holds at most
COUNTS = {
    "global loads": r"(?:global|flat|buffer)_load",
    "global stores": r"(?:global|flat|buffer)_store",
    "local loads": r"ds_(?:read|load)",
    "local stores": r"ds_(?:write|store)",
    "scratch loads and stores": r"scratch_(?:load|store)",
    "scalar loads": r"s_(?:buffer_)?load",
}


@cache
def compiler() -> Clang:
    """Return clang with its library for AMD.  Raises Missing."""
    return find_clang("amdgcn--amdhsa.bc")


def version() -> str:
    """Return the compiler's name and version.  Raises Missing."""
    return f"clang {compiler().version} with libclc"


def compile_kernels(build: Build, target: str, folder: Path) -> dict[str, Figures]:
    """Compile a build for `target`; the files go into `folder`.  Raises CompileError."""
    source, assembly = folder / "kernels.cl", folder / "kernels.s"
    source.write_text(build.source)
    compiler().compile(source, [*build.options, f"-mcpu={target}"], "amdgcn--amdhsa", assembly)
    return parse(assembly.read_text(), target)


def parse(assembly: str, target: str) -> dict[str, Figures]:
    """Return the figures of each kernel in the assembly.  Raises CompileError."""
    notes = first(r"\.amdgpu_metadata\n(?:---\n)?((?:.*\n)*?)(?:\.\.\.\n)?\s*\.end_amdgpu_metadata", assembly)
    return {of[".name"]: _figures(of, assembly, target) for of in YAML(typ="safe").load(notes)["amdhsa.kernels"]}


def _figures(of: dict[str, Any], assembly: str, target: str) -> Figures:
    name = of[".name"]
    code, _, remarks = first(rf"^({name}:[^\0]*?^; Occupancy: \d+)$", assembly).partition(".Lfunc_end")
    counts = {kind: len(re.findall(rf"^\s+{word}\w*\s", code, re.MULTILINE)) for kind, word in COUNTS.items()}
    return Figures(
        registers=of[".vgpr_count"],
        spills=of[".vgpr_spill_count"],
        scratch=of[".private_segment_fixed_size"],
        local=of[".group_segment_fixed_size"],
        group=of[".max_flat_workgroup_size"],
        width=of[".wavefront_size"],
        waves=int(first(r"^; Occupancy: (\d+)$", remarks)),
        most_waves=TARGETS[target],
        counts=counts | {"scalar registers": of[".sgpr_count"], "scalar spills": of[".sgpr_spill_count"]},
    )
