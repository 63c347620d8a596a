"""Find OpenCL runtimes, and test whether they work.

Import this module before pyopencl: the loader reads its folder of drivers once.  Each runtime is tested in a separate
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

from clsplat.core.errors import OutputError
from clsplat.core.files import write_text
from clsplat.core.machine import cache_folder
from clsplat.opencl.kernel_caches import damaged_kernels, empty_kernel_caches, remove_cut_kernels

SYSTEM_DRIVERS = Path("/etc/OpenCL/vendors")
PROBE = Path(__file__).with_name("probe.py")
PROBE_SECONDS = 120  # a first build may compile for many seconds on a slow machine

INSTALL = (
    "install a runtime: pip install 'clsplat[pocl]', pip install 'clsplat[intel]', apt install pocl-opencl-icd, or "
    "your GPU's driver"
)
_HANGS = f"a test kernel did not finish in {PROBE_SECONDS} s"
_NO_EXECUTION = "PoCL's cache lies where nothing may be executed: mount it with `exec`, or set POCL_CACHE_DIR"
_OTHER_RUNTIMES = "apt install pocl-opencl-icd, or pip install 'clsplat[intel]'"
_ADVICE = (  # words in the output of a failed test kernel -> remedy
    ("without the vectors", f"this runtime does not support the processor: {_OTHER_RUNTIMES}"),
    ("unknown target cpu", f"this PoCL does not support the processor: {_OTHER_RUNTIMES}"),
    ("invalid_kernel_name", f"this runtime may not support the processor: {_OTHER_RUNTIMES}"),
    ("linker", f"PoCL needs a linker: apt install binutils libc6-dev; or use another runtime: {_OTHER_RUNTIMES}"),
    ("abort", f"PoCL may lack a linker: apt install binutils libc6-dev; or use another runtime: {_OTHER_RUNTIMES}"),
)


def prepare() -> None:
    """Do what must precede the loader: let its runtimes write their caches, and add Intel's.  Raises OutputError."""
    cache_folder()
    _add_intel_runtime()


def _add_intel_runtime() -> None:
    """Register Intel's CPU runtime when pip installed it: its own driver file holds a placeholder path.

    This writes a folder of driver files with the system's drivers and Intel's, unless OCL_ICD_VENDORS is set.  The
    loader of Windows takes the library itself, beside the registry's, unless OCL_ICD_FILENAMES is set.
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


def fault_of(key: str, platform: int, device: int) -> str | None:
    """Return None when the device builds and runs a kernel, else one sentence with the fault and the remedy.

    `key` identifies the runtime.  Only successes are stored, so a runtime that was fixed is tested again.  A device
    that fails is tried again with empty caches of built kernels.  It is tested at every
    start where the cache cannot be written.
    """
    tested = PROBE.read_bytes() + key.encode()
    record = cache_folder() / "probes" / hashlib.sha256(tested).hexdigest()[:16]
    if os.path.exists(record):  # False in a folder of another user
        return None
    remove_cut_kernels()
    fault = _probed(platform, device, {})
    if fault is None:
        with suppress(OutputError):
            write_text(record, key)
    elif fault not in (_HANGS, _NO_EXECUTION):
        with empty_kernel_caches() as variables:
            if _probed(platform, device, variables) is None:
                return damaged_kernels()
    return fault


def _probed(platform: int, device: int, variables: Mapping[str, str]) -> str | None:
    """Try a device in a process with these variables besides ours; return the fault, or None."""
    command = [sys.executable, "-P", "-m", "clsplat.opencl.probe", str(platform), str(device)]
    try:
        done = subprocess.run(
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
    if done.returncode == 0:
        return None
    output = f"{done.stdout}\n{done.stderr}"
    if "failed to map segment" in output.lower():
        return _NO_EXECUTION
    reason = "the runtime aborts the process" if done.returncode not in range(256) else _error_line(output)
    for word, advice in _ADVICE:
        if word in f"{output} {reason}".lower():
            return f"{reason}; {advice}"
    return reason


def _error_line(output: str) -> str:
    """The line with the error in the output of a compiler or of Python."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if line.lower().startswith("error:")]
    return (errors or lines or ["the test kernel failed without a message"])[-1 if not errors else 0]
