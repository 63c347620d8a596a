"""Find OpenCL runtimes, and test whether they work.

Import this module before pyopencl: the loader reads its folder of drivers only once.  Each runtime is tested in a child
process, because some runtimes abort the process on errors (PoCL before 7.2 without a linker).
"""

import hashlib
import os
import sysconfig
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

from clsplat.core.child import run_module
from clsplat.core.errors import DataError, DeviceError, MemoryLimitError, OutputError, quote
from clsplat.core.files import write_text
from clsplat.core.machine import Owner, cache_folder, process_limit
from clsplat.core.reading import read_text
from clsplat.opencl.kernel_caches import empty_kernel_caches, kernel_cache_advice, remove_broken_kernels, require_space

SYSTEM_DRIVERS = Path("/etc/OpenCL/vendors")
PROBE = Path(__file__).with_name("probe.py")
PROBE_MODULE = "clsplat.opencl.probe"
PROBE_SECONDS = 120  # a first build may compile for many seconds on a slow machine

INSTALL_ADVICE = (
    "install a runtime: pip install '.[pocl]' or pip install '.[intel]' in a checkout, apt install pocl-opencl-icd, or "
    "your GPU's driver"
)
VARIABLES = ("POCL_DEVICES", "OCL_ICD_VENDORS", "OCL_ICD_FILENAMES")  # any of them may hide a runtime
LOADER_VARIABLES = (*VARIABLES, "LD_LIBRARY_PATH", "LD_PRELOAD")  # these determine which libraries are loaded
MIN_ADDRESS_SPACE = 1800 << 20  # bytes: with two cores, a run needs about this much
LOADING_SECONDS = 60  # drivers of large servers may take 10 s
LOADING, LOADED = "clsplat loads the runtimes", "clsplat has listed the devices"  # lines of the child process
_TIMEOUT = f"a test kernel did not finish in {PROBE_SECONDS} s"
_NOEXEC = "PoCL's cache is on a file system mounted with `noexec`: mount it with `exec`, or set POCL_CACHE_DIR"
OTHER_DRIVERS = "remove this file, or set OCL_ICD_VENDORS to a folder with the .icd files of the other runtimes"
_OTHER_RUNTIMES = "apt install pocl-opencl-icd, or pip install '.[intel]' in a checkout"
_ADVICE = (  # text in the output of a failed test kernel, and advice
    ("without the processor's vector", f"this runtime does not support the processor: {_OTHER_RUNTIMES}"),
    ("unknown target cpu", f"this PoCL does not support the processor: {_OTHER_RUNTIMES}"),
    ("invalid_kernel_name", f"this runtime may not support the processor: {_OTHER_RUNTIMES}"),
    ("linker", f"PoCL needs a linker: apt install binutils libc6-dev; or use another runtime: {_OTHER_RUNTIMES}"),
    ("abort", f"PoCL may lack a linker: apt install binutils libc6-dev; or use another runtime: {_OTHER_RUNTIMES}"),
)


def prepare() -> None:
    """Prepare the environment for the loader: make caches writable, and add Intel's runtime.  Raises OutputError."""
    cache_folder()
    _add_intel_runtime()


def no_device_error(fault: str, advice: str = "") -> DeviceError | MemoryLimitError:
    """Return the error for a machine where no device works: MemoryLimitError if the address space is limited."""
    limit = process_limit("RLIMIT_AS")
    if limit is None:
        return DeviceError(f"{fault}; {advice}" if advice else fault)
    suffix = f"; if that does not help, {advice}" if advice else ""
    return MemoryLimitError(
        f"{fault}; a process may use only {limit >> 20} MiB of address space (`ulimit -v`): raise this limit{suffix}"
    )


def no_device_advice() -> str:
    """Return advice for a machine without devices: to correct environment variables, or to install a runtime."""
    variables = _user_variables()
    if not variables:
        return INSTALL_ADVICE
    return f"{variables} may hide the runtimes: correct or unset it; or {INSTALL_ADVICE}"


def _user_variables() -> str:
    """Return the variables among VARIABLES that the user has set, as `NAME=VALUE, …`; '' if there are none."""
    folders = (str(cache_folder()), str(Path(sysconfig.get_path("data"))))  # prefixes of values that `prepare` sets
    values = {name: os.environ[name] for name in VARIABLES if not os.environ.get(name, folders[0]).startswith(folders)}
    return ", ".join(f"{name}={quote(value)}" for name, value in values.items())


@cache
def check_runtimes(loader: str) -> None:
    """Load all runtimes in a child process first, since a runtime may crash the process that loads it.

    A success is recorded until the next boot, or until the runtimes change.
    loader: name and version of the OpenCL loader.
    Raises DeviceError, which names the faulty driver file, MemoryLimitError if the address space is limited, and
    OutputError if built kernels do not fit.
    """
    require_space()
    limit = process_limit("RLIMIT_AS")
    if limit is not None and limit < MIN_ADDRESS_SPACE:  # runtimes crash or hang without enough address space
        raise no_device_error(f"OpenCL runtimes need {MIN_ADDRESS_SPACE >> 20} MiB of address space")
    drivers = _drivers()
    variables = [os.environ.get(name) for name in LOADER_VARIABLES]
    files = [path for path in (*drivers.values(), "/etc/ld.so.cache") if os.path.exists(path)]
    times = [os.stat(path).st_mtime_ns for path in files]
    state = repr((loader, limit, Owner.current().boot, variables, drivers, times))
    record = cache_folder() / "runtimes" / hashlib.sha256(state.encode()).hexdigest()[:16]
    if os.path.exists(record):
        return
    fault = _loading_fault({})
    if fault is not None:
        raise no_device_error(f"an OpenCL runtime {fault}") if limit else _find_faulty_driver(drivers, fault)
    with suppress(OutputError):
        write_text(record, state)


def _drivers() -> dict[Path, str]:
    """Return the library of each runtime.  Keys are the files that the loader reads: .icd files or the libraries."""
    vendors = Path(os.environ.get("OCL_ICD_VENDORS") or SYSTEM_DRIVERS)
    files = sorted(vendors.glob("*.icd")) if vendors.is_dir() else [vendors]
    drivers = {
        path: str(path)
        for path in (*files, *map(Path, filter(None, os.environ.get("OCL_ICD_FILENAMES", "").split(os.pathsep))))
    }
    for path in drivers:
        if path.suffix == ".icd":
            with suppress(DataError):
                drivers[path] = read_text(path).partition("\n")[0].strip()
    return drivers


def _find_faulty_driver(drivers: Mapping[Path, str], fault: str) -> DeviceError:
    """Load each driver separately, and return the error for the first one that crashes the process."""
    remedy = f"correct or unset {variables}" if (variables := _user_variables()) else OTHER_DRIVERS
    for path, library in drivers.items():
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            write_text(Path(folder, "driver.icd"), f"{library}\n")
            driver_fault = _loading_fault({"OCL_ICD_VENDORS": folder, "OCL_ICD_FILENAMES": ""})
        if driver_fault is not None:
            file = SYSTEM_DRIVERS / path.name if path.is_relative_to(cache_folder()) else path
            return DeviceError(f"{file}: the runtime {quote(library)} {driver_fault}; {remedy}")
    return DeviceError(f"an OpenCL runtime {fault}; {remedy}")


def _loading_fault(variables: Mapping[str, str]) -> str | None:
    """Load all runtimes in a child process.

    Returns None if the child process lists the devices or ends before it loads a runtime; otherwise a verb phrase that
    says how loading fails.
    """
    result = run_module(PROBE_MODULE, seconds=LOADING_SECONDS, variables=variables)
    if LOADED in result.output or LOADING not in result.output:  # without the first line, loading did not start
        return None
    return f"{result.crash or 'ends the process'} when it is loaded"


def _add_intel_runtime() -> None:
    """Register Intel's CPU runtime if pip installed it, because its driver file contains a placeholder path.

    Unless OCL_ICD_VENDORS is set, write a folder of driver files with the system's drivers and Intel's.  On Windows,
    unless OCL_ICD_FILENAMES is set, the loader uses the library in addition to those in the registry.
    """
    data = Path(sysconfig.get_path("data"))
    if (dll := data / "Library" / "bin" / "intelocl64.dll").exists():  # Windows
        os.environ.setdefault("OCL_ICD_FILENAMES", str(dll))
    library = data / "lib" / "libintelocl.so"
    if not library.exists() or "OCL_ICD_VENDORS" in os.environ:
        return
    folder = cache_folder() / "drivers" / hashlib.sha256(str(library).encode()).hexdigest()[:12]
    for file in folder.glob("*.icd"):
        if file.name != "intel-pip.icd" and not (SYSTEM_DRIVERS / file.name).exists():
            file.unlink(missing_ok=True)
    contents = {driver.name: driver.read_text("utf-8", errors="replace") for driver in SYSTEM_DRIVERS.glob("*.icd")}
    for name, text in {**contents, "intel-pip.icd": f"{library}\n"}.items():
        if not (folder / name).exists() or (folder / name).read_text("utf-8", errors="replace") != text:
            write_text(folder / name, text)
    os.environ["OCL_ICD_VENDORS"] = str(folder)


def probe_fault(key: str, platform: int, device: int) -> str | None:
    """Test a device: return None if it builds and runs a test kernel, else a sentence with the fault and a remedy.

    key: identifies the runtime.  Only successes are recorded, so that a repaired runtime is tested again.  A device
    that fails is tested again with empty caches of built kernels.
    """
    content = PROBE.read_bytes() + key.encode()
    record = cache_folder() / "probes" / hashlib.sha256(content).hexdigest()[:16]
    if os.path.exists(record):  # unlike Path.exists, never raises PermissionError
        return None
    remove_broken_kernels()
    fault = _run_probe(platform, device, {})
    if fault is None:
        with suppress(OutputError):
            write_text(record, key)
    elif fault not in (_TIMEOUT, _NOEXEC):
        with empty_kernel_caches() as variables:
            if _run_probe(platform, device, variables) is None:
                return kernel_cache_advice()
    return fault


def _run_probe(platform: int, device: int, variables: Mapping[str, str]) -> str | None:
    """Test a device in a child process with additional environment variables; return the fault, or None."""
    result = run_module(PROBE_MODULE, str(platform), str(device), seconds=PROBE_SECONDS, variables=variables)
    if result.code is None:
        return _TIMEOUT
    if result.code == 0:
        return None
    output = result.output
    if "failed to map segment" in output.lower():
        return _NOEXEC
    reason = "the runtime aborts the process" if result.crash else _error_line(output)
    for pattern, advice in _ADVICE:
        if pattern in f"{output} {reason}".lower():
            return f"{reason}; {advice}"
    return reason


def _error_line(output: str) -> str:
    """Return the line with the error in the output of a compiler or of Python."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if line.lower().startswith("error:")]
    return (errors or lines or ["the test kernel failed without a message"])[-1 if not errors else 0]
