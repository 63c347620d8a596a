"""The house style of cl_kernels/, checked mechanically."""

import re
from pathlib import Path

import pytest

from clsplat.opencl.device import Device, Program, parse_kernels
from clsplat.opencl.discovery import choose_device

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "cl_kernels").glob("*.[ch]*"))
KERNEL_FILES = [path for path in FILES if path.suffix == ".cl"]
FORBIDDEN = r"\b(warp|thread|block_idx|shared memory|CUDA|SM|nvidia|amd|intel|printf|half|double|image2d_t)\b"
COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
BARE = re.compile(r"(?<![\w.])(\d+\.\d*|\d*\.\d+|\d+)([eE][-+]?\d+)?(?![\w.])")


def code(path: Path) -> str:
    """The text without comments; line numbers stay."""
    return COMMENT.sub(lambda m: "\n" * m[0].count("\n"), path.read_text())


def kernels(path: Path) -> list[tuple[str, str, str]]:
    """(name, parameters with comments, body) of every kernel."""
    text = path.read_text()
    results = []
    for match in re.finditer(r"__kernel[^{]*?void\s+(\w+)\(\n(.*?\)[^\n]*)\n\{\n(.*?)\n\}\n", text, re.DOTALL):
        results.append((match[1], match[2], match[3]))
    return results


def test_kernel_lines_are_short_and_clean():
    faults = []
    for path in FILES:
        lines = path.read_text().splitlines()
        faults += [f"{path.name}: {len(lines)} lines; divide it"] if len(lines) > 300 else []
        for number, line in enumerate(lines, 1):
            wrong = {
                "a tab": "\t" in line,
                f"{len(line)} columns": len(line) > 120,
                "blanks at its end": line != line.rstrip(),
            }
            faults += [f"{path.name}:{number}: {what}" for what, is_wrong in wrong.items() if is_wrong]
    assert not faults, "\n".join(faults)


def test_header_describes_the_computation():
    texts = {path.name: path.read_text() for path in FILES}
    faults = [name for name, text in texts.items() if not text.startswith("/* ") or text.index("*/") <= 120]
    assert not faults, f"say what the files compute: {faults}"


def test_kernels_contain_no_forbidden_words():
    actual = {path.name: re.findall(FORBIDDEN, path.read_text()) for path in FILES}
    assert not any(actual.values()), "\n".join(f"{name}: {words}" for name, words in actual.items() if words)


def test_float_literals_have_a_suffix():
    faults = [
        f"{path.name}:{number}: {bare[0]} is a double"
        for path in FILES
        for number, line in enumerate(code(path).splitlines(), 1)
        for bare in BARE.finditer(line)
        if "." in bare[1] or bare[2]
    ]
    assert not faults, "\n".join(faults)


def test_pointers_of_kernels_are_restrict_and_have_a_shape():
    faults = []
    for path in KERNEL_FILES:
        result = kernels(path)
        if {name for name, *_ in result} != set(parse_kernels(path.read_text())):
            faults.append(f"{path.name}: layout of a kernel is not recognized")
        for name, parameters, _ in result:
            for line in parameters.splitlines():
                if "*" in line.split("//")[0] and not ("restrict" in line and re.search(r"//.*\[", line)):
                    faults.append(f"{path.name}: {name}: no restrict or no shape: {line.strip()}")
    assert not faults, "\n".join(faults)


def test_kernels_have_a_comment_and_fit_a_screen():
    faults = []
    for path in KERNEL_FILES:
        for match in re.finditer(r"\n(.*)\n__kernel.*\nvoid (\w+)", path.read_text()):
            if not match[1].endswith("*/"):
                faults.append(f"{path.name}: {match[2]} has no comment")
        for name, _, body in kernels(path):
            if len(body.splitlines()) > 80:
                faults.append(f"{path.name}: {name} is {len(body.splitlines())} lines")
    assert not faults, "\n".join(faults)


def test_no_return_in_a_kernel_with_a_barrier():
    faults = [
        f"{path.name}: {name}"
        for path in KERNEL_FILES
        for name, _, body in kernels(path)
        if "barrier(" in body and re.search(r"\breturn\b", body)
    ]
    assert not faults, "\n".join(faults)


def test_includes_are_local():
    actual = [(path, include) for path in FILES for include in re.findall(r"#include\s+(\S+)", path.read_text())]
    faults = [
        f"{path.name}: {include}"
        for path, include in actual
        if not (include.startswith('"') and (path.parent / include.strip('"')).is_file())
    ]
    assert not faults, "\n".join(faults)


def test_every_define_from_the_host_is_declared_in_common():
    declared = set(re.findall(r"#ifndef (\w+)\n#define \1", (ROOT / "cl_kernels" / "common.h").read_text()))
    device = Device(choose_device())
    simt = Device(choose_device(), "simt")
    assert set(device.tuning) | set(simt.tuning) <= declared


def test_every_kernel_is_called():
    python = "\n".join(path.read_text() for path in (ROOT / "clsplat").rglob("*.py"))
    called = set(re.findall(r"\.(\w+)\(", python))
    faults = [name for path in KERNEL_FILES for name in parse_kernels(path.read_text()) if name not in called]
    assert not faults, f"called nowhere: {faults}"


@pytest.mark.parametrize("lanes", [16, 8, 1])
def test_every_file_builds_alone(lanes):
    schedule = "simt" if lanes == 1 else "wide"
    device = Device(choose_device(), schedule)
    device.tuning["LANES"] = lanes
    faults = []
    for path in KERNEL_FILES:
        if path.stem.startswith("blend_") and not path.stem.endswith(schedule):
            continue  # of the other schedule
        try:
            assert Program(device, path.name, device.tuning).kernels
        except Exception as error:  # all that do not build are shown at once
            faults.append(f"{path.name}: {error}")
    assert not faults, "\n".join(faults)
