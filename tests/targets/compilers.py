"""Find the compilers of this machine and run them."""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

CLANGS = ["clang-19", *(f"clang-{n}" for n in (22, 21, 20, 18, 17, 16)), "clang"]
CLANG_SINCE = 16
LIBCLC_VARIABLE = "LIBCLC"
LIBCLC_FOLDERS = ["/usr/lib/clc", "/usr/share/clc", "/usr/local/lib/clc"]
LIMIT_S = 300


class Missing(Exception):
    """A compiler is not there; the text says which, and how to get it."""


class CompileError(Exception):
    """A kernel file does not compile; the text is the compiler's first error."""


@dataclass(frozen=True)
class Clang:
    """clang, with the built-in functions of OpenCL for one kind of target."""

    program: str
    version: str
    bitcode: Path

    def compile(self, source: Path, options: list[str], target: str, out: Path) -> str:
        """Write assembly for `target`; return what the compiler says."""
        builtins = ["-nogpulib", "-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(self.bitcode)]
        return run(self.program, "-x", "cl", *options, "-O3", "-S", f"--target={target}", *builtins, "-o", out, source)

    def preprocess(self, source: Path, options: list[str], target: str) -> str:
        """Return the text with its macros replaced."""
        return run(self.program, "-x", "cl", *options, "-E", "-P", f"--target={target}", source)


def find_clang(bitcode: str) -> Clang:
    """Return the first clang that is new enough, with a file of libclc.  Raises Missing."""
    folders = [os.environ[LIBCLC_VARIABLE]] if LIBCLC_VARIABLE in os.environ else LIBCLC_FOLDERS
    for program in filter(shutil.which, CLANGS):
        version = first(r"clang version (\S+)", run(program, "--version"))
        if int(version.partition(".")[0]) >= CLANG_SINCE:
            break
    else:
        raise Missing(f"clang {CLANG_SINCE} or later is missing: apt-get install clang-19")
    for folder in folders:
        if (Path(folder) / bitcode).is_file():
            return Clang(program, version, Path(folder) / bitcode)
    raise Missing(f"{bitcode} of libclc is missing in {', '.join(folders)}: apt-get install libclc-19")


def find_ptxas() -> str:
    """Return NVIDIA's assembler, from the path or from PyPI's package.  Raises Missing."""
    if result := shutil.which("ptxas"):
        return result
    for folder in sys.path:
        for program in sorted(Path(folder or ".").glob("nvidia/*/bin/ptxas")):
            return str(program)
    raise Missing("ptxas is missing: pip install nvidia-cuda-nvcc")


def find_ocloc() -> str:
    """Return Intel's offline compiler.  Raises Missing."""
    names = {file.name for folder in os.get_exec_path() for file in Path(folder).glob("ocloc-[0-9]*")}
    for name in ["ocloc", *sorted(names, reverse=True)]:
        if result := shutil.which(name):
            return result
    raise Missing("ocloc is missing: apt-get install intel-opencl-icd")


def run(*command: str | Path, folder: Path | None = None) -> str:
    """Run a compiler in `folder`; return its output and errors as one text.  Raises CompileError."""
    try:
        done = subprocess.run(
            [*map(str, command)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            cwd=folder,
            timeout=LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        raise CompileError(f"{Path(command[0]).name} took more than {LIMIT_S} seconds") from None
    if done.returncode:
        lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
        errors = [line for line in lines if re.search("error|fatal", line, re.IGNORECASE)]
        raise CompileError([*errors, *lines, f"{Path(command[0]).name} ended with {done.returncode}"][0])
    return done.stdout


def first(pattern: str, text: str) -> str:
    """Return the first group of the first match.  Raises CompileError where there is none."""
    match = re.search(pattern, text, re.MULTILINE)
    if match is None:
        raise CompileError(f"the compiler's output holds no '{pattern}'")
    return match[1]
