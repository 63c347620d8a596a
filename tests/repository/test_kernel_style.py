"""The house style of cl_kernels/, checked mechanically."""

import re
from pathlib import Path

import pytest

from clsplat.opencl.device import Device, Program, parse_kernels
from clsplat.opencl.discovery import choose

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "cl_kernels").glob("*.[ch]*"))
KERNEL_FILES = [path for path in FILES if path.suffix == ".cl"]
FORBIDDEN = r"\b(warp|thread|block_idx|shared memory|CUDA|SM|nvidia|amd|intel|printf|half|double|image2d_t)\b"
COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
names = pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
kernel_names = pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda p: p.name)


def code(path: Path) -> str:
    """The text without comments; line numbers stay."""
    return COMMENT.sub(lambda m: "\n" * m[0].count("\n"), path.read_text())


def kernels(path: Path) -> list[tuple[str, str, str]]:
    """(name, parameters with comments, body) of every kernel."""
    text = path.read_text()
    found = []
    for match in re.finditer(r"__kernel[^{]*?void\s+(\w+)\(\n(.*?\)[^\n]*)\n\{\n(.*?)\n\}\n", text, re.DOTALL):
        found.append((match[1], match[2], match[3]))
    return found


@names
def test_lines(path):
    for number, line in enumerate(path.read_text().splitlines(), 1):
        assert "\t" not in line, f"{path.name}:{number}: tab"
        assert len(line) <= 120, f"{path.name}:{number}: {len(line)} columns"
        assert line == line.rstrip(), f"{path.name}:{number}: trailing blanks"
    assert len(path.read_text().splitlines()) <= 300


@names
def test_header_says_what_it_computes(path):
    text = path.read_text()
    assert text.startswith("/* "), path.name
    header = text[: text.index("*/")]
    assert len(header) > 120, f"{path.name}: say what the file computes"


@names
def test_words(path):
    match = re.search(FORBIDDEN, path.read_text())
    assert match is None, f"{path.name}: '{match and match[0]}'"


@names
def test_float_literals_have_a_suffix(path):
    for number, line in enumerate(code(path).splitlines(), 1):
        bare = re.search(r"(?<![\w.])(\d+\.\d*|\d*\.\d+|\d+)([eE][-+]?\d+)?(?![\w.])", line)
        while bare:
            if "." in bare[1] or bare[2]:
                raise AssertionError(f"{path.name}:{number}: {bare[0]} is a double")
            bare = re.compile(r"(?<![\w.])(\d+\.\d*|\d*\.\d+|\d+)([eE][-+]?\d+)?(?![\w.])").search(line, bare.end())


@kernel_names
def test_signatures(path):
    found = kernels(path)
    assert {name for name, *_ in found} == set(parse_kernels(path.read_text())), "layout of a kernel is not recognised"
    for name, parameters, _ in found:
        for line in parameters.splitlines():
            if "*" in line.split("//")[0]:
                assert "restrict" in line, f"{path.name}: {name}: {line.strip()}"
                assert re.search(r"//.*\[", line), f"{path.name}: {name}: no shape: {line.strip()}"


@kernel_names
def test_kernels_have_a_comment_and_fit_a_screen(path):
    text = path.read_text()
    for match in re.finditer(r"\n(.*)\n__kernel.*\nvoid (\w+)", text):
        assert match[1].endswith("*/"), f"{path.name}: {match[2]} has no comment"
    for name, _, body in kernels(path):
        assert len(body.splitlines()) <= 80, f"{path.name}: {name} is {len(body.splitlines())} lines"


@kernel_names
def test_no_return_in_a_kernel_with_a_barrier(path):
    for name, _, body in kernels(path):
        assert not ("barrier(" in body and re.search(r"\breturn\b", body)), f"{path.name}: {name}"


@names
def test_includes_are_local(path):
    for include in re.findall(r"#include\s+(\S+)", path.read_text()):
        assert include.startswith('"'), f"{path.name}: {include}"
        assert (path.parent / include.strip('"')).is_file()


def test_every_define_from_the_host_is_declared_in_common():
    declared = set(re.findall(r"#ifndef (\w+)\n#define \1", (ROOT / "cl_kernels" / "common.h").read_text()))
    device = Device(choose())
    simt = Device(choose(), "simt")
    assert set(device.tuning) | set(simt.tuning) <= declared


@kernel_names
def test_every_kernel_is_called_and_tested(path):
    python = "\n".join(p.read_text() for p in (ROOT / "clsplat").rglob("*.py"))
    for name in parse_kernels(path.read_text()):
        assert re.search(rf"\.{name}\(", python), f"{name} is called nowhere"


@kernel_names
@pytest.mark.parametrize("lanes", [16, 8, 1])
def test_every_file_builds_alone(path, lanes):
    schedule = "simt" if lanes == 1 else "wide"
    if path.stem.startswith("blend_") and not path.stem.endswith(schedule):
        pytest.skip("belongs to the other schedule")
    device = Device(choose(), schedule)
    device.tuning["LANES"] = lanes
    assert Program(device, path.name, device.tuning).kernels
