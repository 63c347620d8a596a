"""Find OpenCL runtimes, and test whether they work.

Import this module before pyopencl: the loader reads its folder of drivers only once.  Each runtime is tested in a child
process, because some runtimes abort the process on errors (PoCL before 7.2 without a linker).
"""

import hashlib
import os
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from clsplat.core.errors import OutputError, quote
from clsplat.core.files import write_text
from clsplat.core.machine import cache_folder
from clsplat.opencl.kernel_caches import empty_kernel_caches, kernel_cache_advice, remove_cut_kernels

SYSTEM_DRIVERS = Path("/etc/OpenCL/vendors")
PROBE = Path(__file__).with_name("probe.py")
PROBE_SECONDS = 120  # a first build may compile for many seconds on a slow machine

INSTALL = (
    "install a runtime: pip install 'clsplat[pocl]', pip install 'clsplat[intel]', apt install pocl-opencl-icd, or "
    "your GPU's driver"
)
VARIABLES = ("POCL_DEVICES", "OCL_ICD_VENDORS", "OCL_ICD_FILENAMES")  # any of them may hide a runtime
_HANGS = f"a test kernel did not finish in {PROBE_SECONDS} s"
_NO_EXECUTION = "PoCL's cache is on a file system mounted with `noexec`: mount it with `exec`, or set POCL_CACHE_DIR"
_OTHER_RUNTIMES = "apt install pocl-opencl-icd, or pip install 'clsplat[intel]'"
_ADVICE = (  # words in the output of a failed test kernel -> remedy
    ("without the vectors", f"this runtime does not support the processor: {_OTHER_RUNTIMES}"),
    ("unknown target cpu", f"this PoCL does not support the processor: {_OTHER_RUNTIMES}"),
    ("invalid_kernel_name", f"this runtime may not support the processor: {_OTHER_RUNTIMES}"),
    ("linker", f"PoCL needs a linker: apt install binutils libc6-dev; or use another runtime: {_OTHER_RUNTIMES}"),
    ("abort", f"PoCL may lack a linker: apt install binutils libc6-dev; or use another runtime: {_OTHER_RUNTIMES}"),
)


def prepare() -> None:
    """Prepare the environment for the loader: make runtimes' caches writable, and add Intel's.  Raises OutputError."""
    cache_folder()
    _add_intel_runtime()


def no_device_advice() -> str:
    """Return what to do if there is no device: correct the variables that the user has set, or install a runtime."""
    own = (str(cache_folder()), str(Path(sysconfig.get_path("data"))))  # set by `prepare`
    given = {name: os.environ[name] for name in VARIABLES if not os.environ.get(name, own[0]).startswith(own)}
    named = ", ".join(f"{name}={quote(value)}" for name, value in given.items())
    return f"{named} may hide the runtimes: correct or unset it; or {INSTALL}" if named else INSTALL


def _add_intel_runtime() -> None:
    """Register Intel's CPU runtime if pip installed it: its driver file contains a placeholder path.

    This writes a folder of driver files with the system's drivers and Intel's, unless OCL_ICD_VENDORS is set.  On
    Windows, the loader takes the library in addition to the registry's, unless OCL_ICD_FILENAMES is set.
    """
    data = Path(sysconfig.get_path("data"))
    if (dll := data / "Library" / "bin" / "intelocl64.dll").exists():  # Windows
        os.environ.setdefault("OCL_ICD_FILENAMES", str(dll))
    library = data / "lib" / "libintelocl.so"
    if not library.exists() or "OCL_ICD_VENDORS" in os.environ:
        return
    folder = cache_folder() / "drivers" / hashlib.sha256(str(library).encode()).hexdigest()[:12]
    for old in folder.glob("*.icd"):
        if old.name != "intel-pip.icd" and not (SYSTEM_DRIVERS / old.name).exists():
            old.unlink(missing_ok=True)
    texts = {driver.name: driver.read_text("utf-8", errors="replace") for driver in SYSTEM_DRIVERS.glob("*.icd")}
    for name, text in {**texts, "intel-pip.icd": f"{library}\n"}.items():
        if not (folder / name).exists() or (folder / name).read_text("utf-8", errors="replace") != text:
            write_text(folder / name, text)
    os.environ["OCL_ICD_VENDORS"] = str(folder)


def probe_fault(key: str, platform: int, device: int) -> str | None:
    """Return None if the device builds and runs a kernel, else a sentence with the fault and the remedy.

    `key` identifies the runtime.  Only successes are stored, so that a runtime that was fixed is tested again.  A
    device that fails is tested again with empty caches of built kernels.
    """
    content = PROBE.read_bytes() + key.encode()
    record = cache_folder() / "probes" / hashlib.sha256(content).hexdigest()[:16]
    if os.path.exists(record):  # unlike Path.exists, False in a folder of another user
        return None
    remove_cut_kernels()
    fault = _run_probe(platform, device, {})
    if fault is None:
        with suppress(OutputError):
            write_text(record, key)
    elif fault not in (_HANGS, _NO_EXECUTION):
        with empty_kernel_caches() as variables:
            if _run_probe(platform, device, variables) is None:
                return kernel_cache_advice()
    return fault


def _run_probe(platform: int, device: int, variables: Mapping[str, str]) -> str | None:
    """Test a device in a child process with additional environment variables; return the fault, or None."""
    command = [sys.executable, "-P", "-m", "clsplat.opencl.probe", str(platform), str(device)]
    try:
        result = subprocess.run(
            command,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=PROBE_SECONDS,
            check=False,
            env={**os.environ, **variables},
        )
    except subprocess.TimeoutExpired:
        return _HANGS
    if result.returncode == 0:
        return None
    output = f"{result.stdout}\n{result.stderr}"
    if "failed to map segment" in output.lower():
        return _NO_EXECUTION
    reason = "the runtime aborts the process" if result.returncode not in range(256) else _error_line(output)
    for word, advice in _ADVICE:
        if word in f"{output} {reason}".lower():
            return f"{reason}; {advice}"
    return reason


def _error_line(output: str) -> str:
    """Return the line with the error in the output of a compiler or of Python."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if line.lower().startswith("error:")]
    return (errors or lines or ["the test kernel failed without a message"])[-1 if not errors else 0]
