"""Offline builds for GPUs: options, compiler statistics, and planted faults."""

import ast
import os
import re
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from clsplat.opencl.device import BUILD_OPTIONS, parse_kernels
from clsplat.opencl.discovery import tuning_macros
from tests.targets import accepted, amd, figures, intel, nvidia, page
from tests.targets.__main__ import VENDOR_OF, VENDORS, compile_all, compile_one, versions_of
from tests.targets.builds import GPU, KERNELS, PASSED, Build, builds
from tests.targets.compilers import CompileError
from tests.targets.figures import Figures, Place

ROOT = Path(__file__).parents[2]
QUICK = ["adam.cl", "blend_simt.cl", "loss.cl", "project.cl", "sort_bitonic.cl", "ssim.cl"]  # the most demanding
HEAD = "__kernel __attribute__((reqd_work_group_size({group}, 1, 1)))\nvoid planted("
SPILLING = (
    HEAD.format(group=64)
    + """__global float *restrict values, const uint rounds)
{
    __global float *own = values + get_global_id(0) * 288;
    float held[288], sum = 0.0f;
#pragma unroll
    for (uint i = 0; i < 288; i++)
        held[i] = own[i];
    for (uint round = 0; round < rounds; round++)
#pragma unroll
        for (uint i = 0; i < 288; i++)
            sum += held[i] = held[i] * held[(i + 7) % 288] + sum;
#pragma unroll
    for (uint i = 0; i < 288; i++)
        own[i] = held[i];
}
"""
)
LOCAL = (
    HEAD
    + """__global float *restrict values, const uint count)
{{
    __local float kept[{floats}];
    for (uint i = get_local_id(0); i < {floats}; i += {group})
        kept[i] = values[i];
    barrier(CLK_LOCAL_MEM_FENCE);
    values[get_global_id(0)] = kept[(get_local_id(0) * 7 + count) % {floats}];
}}
"""
)
vendors = pytest.mark.parametrize(
    ("vendor", "target"), [("amd", "gfx1030"), ("nvidia", "sm_86"), ("intel", "tgllp")], ids=["amd", "nvidia", "intel"]
)


def require_compiler(vendor: str) -> None:
    _, missing = versions_of([vendor])
    if missing:
        pytest.skip(missing[vendor])


def planted(folder: Path, source: str) -> Build:
    path = folder / "planted.cl"
    path.write_text(source)
    return Build(path, "simt", ())


def test_builds_use_the_options_of_the_device():
    wanted = [*BUILD_OPTIONS, *(f"-D{name}={value}" for name, value in sorted(tuning_macros(GPU, "simt").items()))]
    assert [build.options for build in builds(["simt"], ["fill.cl"])] == [wanted]
    (wide,) = builds(["wide"], ["fill.cl"])
    assert "-DLANES=8" in wide.options


def test_every_kernel_is_built_in_both_schedules():
    for schedule in ("simt", "wide"):
        names = {name for build in builds([schedule]) for name in build.kernels}
        assert names == {name for path in KERNELS.glob("*.cl") for name in parse_kernels(path.read_text())}


def test_different_builds_are_distinguished():
    variants = [build.variant for build in builds(["simt"], ["blend_simt.cl"])]
    assert variants[0] == ""
    assert {"TILE 16", "PIXEL_SUMS 11", "PIXEL_SUMS 13", "PIXEL_SUMS 13, TILE 16"} <= set(variants)
    assert [build.variant for build in builds(["simt"], ["check.cl"])] == [""]


def test_every_call_with_extra_defines_is_listed():
    actual = set()
    for text in map(Path.read_text, (ROOT / "clsplat").rglob("*.py")):
        for node in ast.walk(ast.parse(text)) if ".program" in text else ():
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "program" and node.keywords:
                name = ast.unparse(node.args[0]).lstrip("f").strip("'")
                actual |= {file.name for file in KERNELS.glob(re.sub(r"\{.*?\}", "*", name))}
    assert actual == PASSED.keys()


AMD_SAMPLE = """\
scale:                                  ; @scale
; %bb.0:
	s_load_dwordx2 s[0:1], s[4:5], 0x0
	global_load_dwordx4 v[1:4], v0, s[0:1]
	ds_write2_b32 v1, v2, v3 offset1:1
	ds_read_b32 v5, v6
	global_store_dword v0, v1, s[0:1]
	scratch_store_dword off, v7, s32
	s_endpgm
.Lfunc_end0:
; Occupancy: 14
	.amdgpu_metadata
---
amdhsa.kernels:
  - .group_segment_fixed_size: 4100
    .max_flat_workgroup_size: 64
    .name:           scale
    .private_segment_fixed_size: 12
    .sgpr_count:     36
    .sgpr_spill_count: 2
    .vgpr_count:     29
    .vgpr_spill_count: 3
    .wavefront_size: 32
...
	.end_amdgpu_metadata
"""


def test_statistics_are_read_from_amd_assembly():
    (of,) = amd.parse(AMD_SAMPLE, "gfx1030").values()
    assert (of.registers, of.spills, of.scratch, of.local, of.group, of.width) == (29, 3, 12, 4100, 64, 32)
    assert (of.waves, of.most_waves, of.occupancy) == (14, 16, 88)
    assert of.counts == {
        "global loads": 1, "global stores": 1, "local loads": 1, "local stores": 1, "scratch loads and stores": 1,
        "scalar loads": 1, "scalar registers": 36, "scalar spills": 2,
    }  # fmt: skip


PTX_SAMPLE = """\
.visible .entry scale(
	.param .u64 scale_param_0
)
{
	ld.global.nc.f32 	%f1, [%rd1];
	ld.shared.f32 	%f2, [%rd2];
	st.shared.v4.f32 	[%rd2], {%f1, %f1, %f1, %f1};
	st.global.f32 	[%rd1], %f2;
}
.visible .entry other(
)
{
	ld.global.f32 	%f1, [%rd1];
}
"""
PTXAS_SAMPLE = """\
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'scale' for 'sm_86'
ptxas info    : Function properties for scale
    200 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads
ptxas info    : Used 38 registers, used 1 barriers, 16388 bytes smem, 428 bytes cmem[0]
ptxas info    : Compile time = 16.554 ms
ptxas info    : Compiling entry function 'other' for 'sm_86'
ptxas info    : Function properties for other
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 12 registers, used 0 barriers
"""
TEXT_SAMPLE = """\
__kernel __attribute__((reqd_work_group_size((16 * 16), 1, 1)))
void scale(__global float *restrict values) {}
__kernel __attribute__((reqd_work_group_size(64, 1, 1))) void other() {}
"""


def test_statistics_are_read_from_ptx_and_ptxas():
    result = nvidia.parse(TEXT_SAMPLE, PTX_SAMPLE, PTXAS_SAMPLE, "sm_86")
    of = result["scale"]
    assert (of.registers, of.spills, of.scratch, of.local, of.group) == (38, 8, 200, 16388, 256)
    assert [of.counts[name] for name in page.COUNTS] == [1, 1, 1, 1]
    assert (result["other"].registers, result["other"].local, result["other"].group) == (12, 0, 64)
    with pytest.raises(CompileError, match="names no kernel"):
        nvidia.parse(TEXT_SAMPLE, PTX_SAMPLE, "", "sm_86")


@pytest.mark.parametrize(
    ("target", "registers", "local", "group", "warps"),
    [
        ("sm_75", 32, 0, 256, 32),  # all that there are
        ("sm_75", 32, 16388, 256, 24),  # three times 16 640 bytes of 64 KiB
        ("sm_86", 64, 0, 256, 32),  # 64 registers of 32 lanes: 65536 / 2048
        ("sm_86", 65, 0, 64, 28),  # 72 registers of 32 lanes: 28 warps
        ("sm_86", 100, 0, 64, 16),  # 19 warps by registers, shared out in fours
        ("sm_86", 16, 16384, 64, 10),  # five times 17 KiB of 100 KiB: 1 KiB is the system's
        ("sm_86", 16, 0, 32, 16),  # groups of one warp: 16 at most
        ("sm_90", 28, 16388, 256, 64),
    ],
)
def test_warps_are_limited_by_registers_local_memory_and_groups(target, registers, local, group, warps):
    assert nvidia.TARGETS[target].resident(registers, local, group) == warps


ZE_INFO = """\
version: '1.20'
kernels:
  - name: scale
    execution_env:
      grf_count: 128
      required_work_group_size: [ 64, 2, 1 ]
      simd_size: 16
      slm_size: 4128
    per_thread_memory_buffers:
      - type: scratch
        usage: single_space
        size: 2048
  - name: own_of_the_compiler
    execution_env:
      grf_count: 128
      simd_size: 8
"""


def binary(notes: str, kind: int = intel.ZE_INFO) -> bytes:
    """An ELF file of 64 bits with a section of another kind and the notes."""
    head = struct.pack("<16s24xQ10xHH2x", b"\x7fELF", 64, 64, 2).ljust(64, b"\0")
    sections = [(1, b"text"), (kind, notes.encode())]
    offset, table, contents = 64 + 64 * len(sections), b"", b""
    for number, content in sections:
        table += struct.pack("<4xIQQQQ", number, 0, 0, offset + len(contents), len(content)).ljust(64, b"\0")
        contents += content
    return head + table + contents + b"what follows"


def test_statistics_are_read_from_intel_compiler_notes():
    report = "\nwarning: kernel scale  compiled SIMD16 allocated 128 regs and spilled around 681\nBuild succeeded.\n"
    assert intel.parse(binary(ZE_INFO), report, "skl").keys() == {"scale"}
    of = intel.parse(binary(ZE_INFO), report, "skl")["scale"]
    assert (of.registers, of.spills, of.scratch, of.local, of.group, of.width) == (128, 681, 2048, 4128, 128, 16)
    assert intel.parse(binary(ZE_INFO), "Build succeeded.", "skl")["scale"].spills == 0
    with pytest.raises(CompileError, match=r"no \.ze_info"):
        intel.parse(binary(ZE_INFO, kind=1), report, "skl")


@pytest.mark.parametrize(
    ("target", "registers", "local", "group", "width", "threads"),
    [
        ("skl", 128, 0, 64, 32, 56),  # all that there are
        ("skl", 128, 16384, 256, 32, 32),  # four groups of eight threads
        ("skl", 128, 16416, 256, 32, 16),  # local memory is given out in powers of two
        ("pvc", 128, 16416, 256, 32, 40),  # and in 24 KiB here: five groups
        ("pvc", 256, 0, 64, 32, 32),  # twice the registers: half of the threads
        ("dg2", 128, 64, 64, 32, 64),  # 32 groups with barriers, of two threads
    ],
)
def test_threads_are_limited_by_registers_memory_and_barriers(target, registers, local, group, width, threads):
    assert intel.TARGETS[target].resident(registers, local, group, width) == threads


FINE = Figures(registers=40, spills=0, scratch=0, local=4096, group=64, width=32, waves=8, most_waves=16)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"spills": 3}, "gfx900 scale (TILE 8) spills registers (3)"),
        ({"local": 32772}, "gfx900 scale (TILE 8) takes 32772 bytes of local memory; at most 32768 are allowed"),
        ({"group": 257}, "gfx900 scale (TILE 8) has groups of 257 items; at most 256 are allowed"),
    ],
)
def test_kernel_beyond_the_limits_is_named(change, sentence):
    table = {
        Place("gfx900", "simt", "scale", "TILE 8"): Figures(**(vars(FINE) | change)),
        Place("a", "simt", "b"): FINE,
    }
    assert figures.faults(table) == [sentence]


def test_schedule_of_cpus_may_spill_on_a_gpu():
    assert figures.faults({Place("gfx900", "wide", "scale"): Figures(**(vars(FINE) | {"spills": 3}))}) == []


def test_statistics_of_two_commits_are_compared(tmp_path):
    before = {Place("gfx900", "simt", name): FINE for name in ("same", "changed", "gone")}
    changed = Figures(**(vars(FINE) | {"registers": 32, "counts": {"global loads": 4}}))
    after = {
        Place("gfx900", "simt", "same"): FINE,
        Place("gfx900", "simt", "changed"): changed,
        Place("gfx900", "simt", "added"): FINE,
        Place("sm_75", "simt", "same"): FINE,  # a target that was not compiled before
    }
    figures.save(before, tmp_path / "before.json")
    assert figures.load(tmp_path / "before.json") == before
    assert figures.differences(figures.load(tmp_path / "before.json"), after) == [
        "gfx900 added: new",
        "gfx900 changed: registers 40 → 32, global loads 0 → 4",
        "gfx900 gone: gone",
    ]


def test_accepted_faults_must_still_occur():
    fault, *rest = accepted.ACCEPTED
    assert accepted.unexpected_failures([*accepted.ACCEPTED, "another"], everything=True) == ["another"]
    assert accepted.unexpected_failures([fault + "0"], everything=False) == [fault + "0"]
    gone = accepted.unexpected_failures([fault], everything=True)
    assert len(gone) == len(rest)
    assert all("is accepted, and was not seen" in item for item in gone)


@vendors
def test_largest_kernels_stay_within_the_limits(vendor, target):
    require_compiler(vendor)
    work = [(build, target) for build in builds(["simt"], QUICK) if not build.variant]
    table, failures = compile_all(work)
    assert failures == []
    assert figures.faults(table) == []
    assert len(table) == sum(len(build.kernels) for build, _ in work)


@pytest.mark.parametrize(
    ("vendor", "target", "source", "words"),
    [
        ("amd", "gfx1030", SPILLING, "planted spills registers"),
        ("nvidia", "sm_86", LOCAL.format(group=64, floats=10240), "takes 40960 bytes of local memory"),
        ("intel", "tgllp", LOCAL.format(group=512, floats=1024), "has groups of 512 items"),
    ],
    ids=["spill", "local", "group"],
)
def test_planted_fault_is_detected(vendor, target, source, words, tmp_path):
    require_compiler(vendor)
    result = compile_one((planted(tmp_path, source), target))
    assert not isinstance(result, str), result
    (fault,) = figures.faults({Place(target, "simt", name): of for name, of in result.items()})
    assert words in fault


@vendors
def test_kernel_build_error_names_kernel_and_line(vendor, target, tmp_path):
    require_compiler(vendor)
    result = compile_one((planted(tmp_path, LOCAL.format(group=64, floats=64) + "int broken(\n"), target))
    assert isinstance(result, str)
    assert result.startswith(f"{target}: planted.cl (simt) does not compile: planted.cl:")
    assert "\n" not in result


def command(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tests.targets", *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_missing_requested_compiler_is_a_fault(tmp_path):
    done = command("amd", PATH=str(tmp_path))
    assert done.returncode == 1
    assert "clang 16 or later is missing: apt-get install clang-19\n" in done.stderr


def test_unknown_target_is_refused():
    done = command("gfx1")
    assert done.returncode == 2
    assert "no target named gfx1; there are amd, nvidia, intel, gfx900" in done.stderr


def all_target_figures() -> figures.Table:
    counts = dict.fromkeys(page.COUNTS, 2)
    small = Figures(**(vars(FINE) | {"local": 0, "counts": counts}))
    kernels = [(small, "scale"), *((Figures(**(vars(FINE) | {"counts": counts})), name) for name in page.COUNTED)]
    return {Place(target, "simt", name): of for target in VENDOR_OF for of, name in kernels}


def test_outdated_page_is_detected(tmp_path, monkeypatch):
    table, versions = all_target_figures(), dict.fromkeys(VENDORS, "a compiler 1.0")
    monkeypatch.setattr(page, "PAGE", tmp_path / "performance.md")
    page.PAGE.write_text(f"before\n{page.BEGIN}\n{page.END}\nafter\n")
    page.write(table, versions, VENDOR_OF)
    assert page.faults(table, versions, VENDOR_OF) == []
    place = Place("sm_86", "simt", "blend_forward")
    table[place] = Figures(**(vars(table[place]) | {"registers": 41}))
    (fault,) = page.faults(table, versions, VENDOR_OF)
    assert re.match(r"performance.md shows '\| `blend_forward` .*40.*', expected '.*41.*': run .* --write", fault)


def test_ci_compares_the_page_with_new_statistics():
    jobs = YAML(typ="safe").load(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]
    assert "-m tests.targets --check" in jobs["targets"]["steps"][-1]["run"]


def test_page_lists_the_existing_kernels():
    shown = page.PAGE.read_text(encoding="utf-8").partition(page.BEGIN)[2].partition(page.END)[0]
    kernels = {name for path in KERNELS.glob("*.cl") for name in parse_kernels(path.read_text())}
    assert set(re.findall(r"^\| `(\w+)`", shown, re.M)) <= kernels
    assert f"All {len(kernels)} kernels compile for all 11 GPUs" in shown
    for target in [*amd.TARGETS, *nvidia.TARGETS, *intel.TARGETS]:
        assert f"| {target}, " in shown
