"""The choice of a device, devices that do not work, and limits of compilers."""

import logging
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from pyopencl import _cl

from clsplat.conformance.scenes import random_case
from clsplat.core.child import ChildResult
from clsplat.core.errors import DeviceError, KernelError, MemoryLimitError
from clsplat.opencl import device as program
from clsplat.opencl import discovery, probe, runtimes
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import DeviceInfo, choose_device
from clsplat.opencl.kernel_caches import kernel_caches
from clsplat.render.rasterizer import Rasterizer

CPU = DeviceInfo("Two Cores", "Runtime A", "CPU", "1", 2, 2**32, 2**31, 2**15, 4096, 16, (0, 0), 3000, True)
INTEGRATED = replace(CPU, name="Small", kind="GPU", units=96, clock=1300, group=256, float_width=1, index=(1, 0))
LARGE = replace(INTEGRATED, name="Large", units=28, clock=1800, unified=False, index=(2, 0))
LARGER = replace(LARGE, name="Larger", units=80, clock=1700, index=(2, 1))

OTHER = replace(CPU, name="Accelerator", kind="other", units=96, group=256, index=(3, 0))


@pytest.fixture
def set_devices(monkeypatch):
    """Set the list of devices; all of them work."""
    monkeypatch.delenv("CLSPLAT_DEVICE", raising=False)
    monkeypatch.setattr(runtimes, "probe_fault", lambda *_: None)
    return lambda *devices: monkeypatch.setattr(discovery, "list_devices", lambda: list(devices))


@pytest.mark.parametrize(
    ("devices", "first"),
    [
        ([CPU], CPU),
        ([CPU, INTEGRATED], INTEGRATED),
        ([CPU, INTEGRATED, LARGE], LARGE),
        ([INTEGRATED, LARGE, LARGER, CPU], LARGER),
        ([INTEGRATED, replace(INTEGRATED, clock=1400), LARGE], LARGE),
        ([CPU, replace(CPU, units=64)], CPU),
        ([OTHER, CPU], CPU),
        ([OTHER, CPU, LARGE], LARGE),
        ([OTHER, replace(OTHER, units=64)], OTHER),
    ],
)
def test_strongest_gpu_or_first_cpu_is_chosen(set_devices, devices, first):
    set_devices(*devices)
    assert choose_device() is first


def test_other_gpus_are_named_in_one_line(set_devices, caplog):
    set_devices(CPU, INTEGRATED, LARGE, LARGER)
    with caplog.at_level(logging.INFO, "clsplat"):
        choose_device()
    assert [record.message for record in caplog.records] == [
        "using Larger (GPU) on Runtime A; other GPUs: Small (GPU) on Runtime A; Large (GPU) on Runtime A; "
        "select one with --device NAME"
    ]
    caplog.clear()
    set_devices(CPU, LARGE)
    choose_device()
    assert not caplog.records


@pytest.mark.parametrize(("info", "least"), [(CPU, 16), (LARGE, 64)])
def test_device_with_small_groups_does_not_work(set_devices, info, least):
    assert replace(info, group=least).fault() is None
    small = replace(info, group=least - 1)
    assert small.fault() == f"its work-groups have at most {least - 1} items; {least} are needed"
    set_devices(small)
    with pytest.raises(DeviceError, match="work-groups have at most"):
        choose_device()


def test_damaged_cache_is_reported_as_the_cause(monkeypatch, tmp_path):
    """Its second try has an empty folder for kernels; of a device that fails there, too, the first fault is told."""
    broken, folders = False, []

    def probe(*words, seconds, variables):
        folder = variables.get("POCL_CACHE_DIR") if "PYOPENCL_NO_CACHE" in variables else None
        folders.append(folder)
        assert folder is None or not os.listdir(folder)
        return ChildResult(int(broken or folder is None), f"error: fault {len(folders)}")

    monkeypatch.delenv("PYOPENCL_NO_CACHE", raising=False)
    monkeypatch.setattr(runtimes, "run_module", probe)
    monkeypatch.setattr(runtimes, "cache_folder", lambda: tmp_path)
    fault = CPU.fault()
    assert fault == f"its cache of built kernels is damaged: remove {kernel_caches()}"
    assert (len(folders), folders[0], os.path.exists(folders[1])) == (2, None, False)
    assert list(tmp_path.iterdir()) == [], "it is tried again"
    broken = True
    assert CPU.fault() == "error: fault 3"


def test_runtime_that_does_not_know_the_cpu_is_reported(monkeypatch, tmp_path):
    """PoCL 3.0 builds kernels for a newer processor without an error, and then has none that takes whole roots."""
    said = "error: a test kernel fails (clCreateKernel failed: INVALID_KERNEL_NAME)"
    monkeypatch.setattr(runtimes, "run_module", lambda *_, **__: ChildResult(1, f"{said}\nreferences to IRs"))
    monkeypatch.setattr(runtimes, "cache_folder", lambda: tmp_path)
    assert CPU.fault().startswith(f"{said}; this runtime may not support the processor: apt install pocl-opencl-icd")


@pytest.mark.parametrize(("width", "lanes"), [(16, 16), (8, 8), (4, 4), (1, 4)])
def test_kernels_without_vector_units_are_not_built(monkeypatch, width, lanes):
    """PoCL 3.0 on a newer processor may take minutes to make one; the warning is in the log of the build."""
    warning = f"'float{lanes}' (vector of {lanes} 'float' values) without 'avx512f' enabled changes the ABI"
    built = []

    class Program:
        def __init__(self, context, source):
            built.append(source)

        def build(self, options):
            return self

        def get_build_info(self, device, what):
            return f"1 warning generated: {warning}"

    chosen = SimpleNamespace(native_vector_width_float=width)
    monkeypatch.setattr(probe.cl, "get_platforms", lambda: [SimpleNamespace(get_devices=lambda: [chosen])])
    for name in ("Context", "CommandQueue", "Buffer"):
        monkeypatch.setattr(probe.cl, name, lambda *_, **__: None)
    monkeypatch.setattr(probe.cl, "Program", Program)
    with pytest.raises(SystemExit, match="error: kernels are compiled without the processor's vector instructions"):
        probe.main(0, 0)
    assert f"vload{lanes}(" in built[0]


def test_device_works_if_the_probe_result_cannot_be_saved(monkeypatch, tmp_path):
    """As in a cache with a folder of another user."""
    monkeypatch.setattr(runtimes, "run_module", lambda *_, **__: ChildResult(0, ""))
    monkeypatch.setattr(runtimes, "cache_folder", lambda: tmp_path)
    (tmp_path / "probes").touch()
    assert CPU.fault() is None
    assert [path.name for path in tmp_path.iterdir()] == ["probes"]


def refusal(code: int) -> cl.Error:
    return cl.LogicError(_cl._ErrorRecord("clGetInfo", code, ""))


class BrokenDevice:
    """A device that refuses all queries."""

    @property
    def name(self):
        raise refusal(cl.status_code.INVALID_VALUE)


class Platform:
    """A runtime with these devices, or one that refuses to tell them."""

    name, version = "Runtime", "OpenCL 3.0"

    def __init__(self, *set_devices) -> None:
        self.found = set_devices

    def get_devices(self):
        for error in self.found:
            if isinstance(error, cl.Error):
                raise error
        return list(self.found)


def test_broken_runtime_is_reported_and_isolated(monkeypatch, info, caplog):
    platform, number = info.index
    good = discovery.get_platforms()[platform]
    devices = [BrokenDevice(), good.get_devices()[number]]
    runtimes_found = [
        Platform(refusal(cl.status_code.DEVICE_NOT_FOUND)),
        Platform(refusal(cl.status_code.OUT_OF_HOST_MEMORY)),
        Platform(*devices),
    ]
    monkeypatch.setattr(discovery.cl, "get_platforms", lambda: runtimes_found)
    (set_devices,) = discovery.list_devices()
    assert (set_devices.name, set_devices.index) == (info.name, (2, 1))
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2, "one without a device is no fault"
    assert "OpenCL platform 1: its devices cannot be listed (clGetInfo failed: OUT_OF_HOST_MEMORY" in messages[0]
    assert "OpenCL platform 2: its device 0 cannot be queried (clGetInfo failed: INVALID_VALUE" in messages[1]


@pytest.mark.parametrize(("code", "lines"), [("PLATFORM_NOT_FOUND_KHR", 0), ("OUT_OF_HOST_MEMORY", 1)])
def test_only_a_failing_loader_is_reported(monkeypatch, caplog, code, lines):
    def refuse():
        raise refusal(getattr(cl.status_code, code))

    monkeypatch.setattr(discovery.cl, "get_platforms", refuse)
    assert discovery.list_devices() == []
    assert len(caplog.records) == lines


def test_probe_result_is_valid_for_its_kernels_only(monkeypatch, tmp_path):
    results = []
    monkeypatch.setattr(runtimes, "run_module", lambda *_, **__: ChildResult(len(results), "error: none"))
    monkeypatch.setattr(runtimes, "cache_folder", lambda: tmp_path)
    assert CPU.fault() is None
    results.append("fails from now on")
    assert CPU.fault() is None, "it is not tried again"
    monkeypatch.setattr(runtimes, "PROBE", Path(__file__))
    assert CPU.fault() == "error: none"


@pytest.fixture
def info() -> DeviceInfo:
    return choose_device()


def capped(monkeypatch: pytest.MonkeyPatch, items: int, *kernels: str) -> None:
    """Cap the work-groups of these kernels, of all without names, as a compiler may do."""
    limit = program.group_limit
    monkeypatch.setattr(
        program,
        "group_limit",
        lambda kernel, device: items if not kernels or kernel.function_name in kernels else limit(kernel, device),
    )


def image_of(device: Device, rng: np.random.Generator) -> np.ndarray:
    case = random_case(rng, 60, 50, 37)
    frame = Rasterizer(device).forward(case.model(device), case.device_camera(device), device.zeros(3))
    return frame.image.get()[:, :37, :50]


def test_capped_groups_need_the_small_tiles(info, rng, monkeypatch):
    image = image_of(Device(info, "simt16"), np.random.default_rng(1))
    capped(monkeypatch, 255, "blend_forward")
    with pytest.raises(KernelError, match=r"blend_forward needs work-groups of 256 items, but .*rasterizer\.schedule"):
        image_of(Device(info, "simt16"), np.random.default_rng(1))
    np.testing.assert_array_equal(image_of(Device(info, "simt"), np.random.default_rng(1)), image)


def test_kernel_whose_group_is_too_large_is_refused(info, monkeypatch):
    capped(monkeypatch, 63, "scan_blocks")
    with pytest.raises(KernelError, match=r"scan.cl:scan_blocks needs work-groups of 64 items, but .* allows 63; use"):
        Device(info, "simt").program("scan.cl")


def test_limit_understated_by_rusticl_refuses_no_kernel(info, monkeypatch):
    capped(monkeypatch, 32)
    monkeypatch.setattr(program, "group_multiple", lambda *_: 32)
    Device(replace(info, platform="rusticl, OpenCL 3.0"), "simt").program("blend_simt.cl")
    capped(monkeypatch, 48)
    with pytest.raises(KernelError, match="allows 48"):
        Device(replace(info, platform="rusticl, OpenCL 3.0"), "simt").program("blend_simt.cl")


def test_wide_needs_no_kernel_with_barriers(info, rng, monkeypatch):
    image = image_of(Device(info, "wide"), np.random.default_rng(1))
    capped(monkeypatch, 1, "sort_tiles", "blend_forward", "blend_backward", "scan_offsets", "radix_count")
    np.testing.assert_array_equal(image_of(Device(info, "wide"), np.random.default_rng(1)), image)


RUNTIME = """
#include <stdlib.h>
#include <string.h>
int clIcdGetPlatformIDsKHR(unsigned n, void **platforms, unsigned *count) { ACTION; return -1001; }
int clGetPlatformInfo(void *p, unsigned name, size_t size, void *value, size_t *written) { return -30; }
void *clGetExtensionFunctionAddress(const char *name)
{
    return strcmp(name, "clIcdGetPlatformIDsKHR") ? 0 : (void *)clIcdGetPlatformIDsKHR;
}
"""


@pytest.fixture
def drivers(tmp_path, monkeypatch):
    """Lets the test add a runtime of its own to those that the loader finds in OCL_ICD_VENDORS."""
    compiler, folder = shutil.which("cc"), tmp_path / "vendors"
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("no C compiler for the runtime")
    folder.mkdir()

    def add(name: str, action: str) -> Path:
        (tmp_path / "runtime.c").write_text(RUNTIME)
        library = tmp_path / f"{name}.so"
        command = [compiler, "-shared", "-fPIC", f"-DACTION={action}", "-o", library, tmp_path / "runtime.c"]
        subprocess.run(command, check=True)
        (folder / f"{name}.icd").write_text(f"{library}\n")
        return folder / f"{name}.icd"

    monkeypatch.setenv("OCL_ICD_VENDORS", str(folder))
    monkeypatch.setattr(runtimes, "cache_folder", lambda: tmp_path / "cache")
    runtimes.check_runtimes.cache_clear()
    yield add
    runtimes.check_runtimes.cache_clear()


@pytest.mark.parametrize(("action", "end"), [("raise(11)", "crashes with SIGSEGV"), ("exit(0)", "ends the process")])
def test_runtime_that_ends_the_process_is_named(drivers, action, end):
    drivers("a_good", "(void)0")
    bad = drivers("bad", f"extern int raise(int); {action}")
    with pytest.raises(DeviceError) as error:
        discovery.list_devices()
    assert re.fullmatch(
        rf"{re.escape(str(bad))}: the runtime '.*bad.so' {end} when it is loaded; correct or unset OCL_ICD_VENDORS=.*",
        str(error.value),
    )


def test_runtimes_that_load_are_not_loaded_in_a_child_again(drivers, monkeypatch):
    drivers("good", "(void)0")
    runtimes.check_runtimes("loader")
    loaded = []
    monkeypatch.setattr(runtimes, "_loading_fault", lambda variables: loaded.append(variables))
    for change in (lambda: None, lambda: drivers("other", "(void)0")):
        change()
        runtimes.check_runtimes.cache_clear()
        runtimes.check_runtimes("loader")
    assert len(loaded) == 1, "only after a change"


def test_memory_limit_is_named_if_no_device_works(monkeypatch):
    monkeypatch.setattr(runtimes, "process_limit", lambda name: 700_000 << 10)
    runtimes.check_runtimes.cache_clear()
    with pytest.raises(MemoryLimitError, match=r"may use only 683 MiB of address space \(`ulimit -v`\): raise"):
        discovery.list_devices()
    monkeypatch.setattr(discovery, "list_devices", list)
    with pytest.raises(MemoryLimitError, match="no OpenCL device was found; a process may use only 683 MiB"):
        discovery.choose_device()


@pytest.mark.parametrize("name", ["POCL_DEVICES", "OCL_ICD_VENDORS", "OCL_ICD_FILENAMES"])
def test_variable_that_hides_all_devices_is_named(monkeypatch, name):
    monkeypatch.setattr(discovery, "list_devices", list)
    for other in runtimes.VARIABLES:
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(name, "wrong")
    with pytest.raises(DeviceError, match=f"^no OpenCL device was found; {name}='wrong' may hide .*; or install a"):
        discovery.choose_device()
    monkeypatch.setenv(name, str(runtimes.cache_folder() / "drivers" / "x"))  # as `prepare` sets it
    with pytest.raises(DeviceError, match=r"^no OpenCL device was found; install a runtime"):
        discovery.choose_device()
