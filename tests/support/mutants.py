"""Plant faults in a copy of the checkout, and check whether tests detect them.

    python -m tests.support.mutants --seed 49 --count 40 --out mutants.json

Faults are drawn by the seed, over all rooms and the kernels in turn: signs, off-by-ones, constants, swapped arguments,
dropped checks and dropped waits.  Each is tried on the tests of its room, and those that survive on the whole suite.
"""

import argparse
import ast
import json
import random
import re
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.support.sources import FILES, ROOT

SWAPS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "+": "-", "-": "+", "*": "+", "==": "!="}
OPERATORS = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.Add: "+", ast.Sub: "-", ast.Mult: "*",
}  # fmt: skip
WAITS = re.compile(r"^\s*(?:barrier\(|self\.\w*\.?finish\(\)|\w+(?:\.\w+)*\.(?:finish|flush|fsync)\(|os\.fsync\()")
KERNEL_SITES = re.compile(r"(?<=\s)(<=?|>=?|\+|-|\*)(?=\s)|\b\d+(?:\.\d+)?f?\b|^\s*barrier\(.*;$", re.M)


@dataclass(frozen=True)
class Mutant:
    """A fault: `old` becomes `new` at an offset of a file."""

    file: str
    line: int
    offset: int  # in characters
    old: str
    new: str


def room_of(path: Path) -> str:
    parts = path.relative_to(ROOT).parts
    return parts[1] if parts[0] == "clsplat" and len(parts) > 2 else parts[0]


def python_mutants(path: Path) -> list[Mutant]:
    """All faults that can be planted in a Python file."""
    text = path.read_text()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    lines, results = text.splitlines(), []

    def at(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    def add(line: int, offset: int, old: str, new: str) -> None:
        results.append(Mutant(str(path.relative_to(ROOT)), line, offset, old, new))

    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in OPERATORS:
            add_operator(node.left, node.comparators[0], OPERATORS[type(node.ops[0])], text, at, add)
        elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            add_operator(node.left, node.right, OPERATORS[type(node.op)], text, at, add)
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            begin, end = at(node.lineno, node.col_offset), at(node.end_lineno or 0, node.end_col_offset or 0)
            new = str(node.value + 1) if isinstance(node.value, int) else repr(node.value * 1.5 or 0.5)
            add(node.lineno, begin, text[begin:end], new)
        elif isinstance(node, ast.Call) and len(node.args) == 2 and not node.keywords:
            first, second = node.args
            begin, end = at(first.lineno, first.col_offset), at(second.end_lineno or 0, second.end_col_offset or 0)
            one, two = ast.get_source_segment(text, first), ast.get_source_segment(text, second)
            if one and two and one != two and "\n" not in text[begin:end]:
                add(node.lineno, begin, text[begin:end], f"{two}, {one}")
        elif isinstance(node, ast.If) and len(node.body) == 1 and isinstance(node.body[0], ast.Raise):
            begin = at(node.test.lineno, node.test.col_offset)
            end = at(node.test.end_lineno or 0, node.test.end_col_offset or 0)
            if ":=" not in text[begin:end]:
                add(node.lineno, begin, text[begin:end], "False")
        elif isinstance(node, ast.Expr) and WAITS.match(lines[node.lineno - 1]) and node.lineno == node.end_lineno:
            add(node.lineno, at(node.lineno, node.col_offset), lines[node.lineno - 1].strip(), "pass")
    return results


def add_operator(left: ast.expr, right: ast.expr, operator: str, text: str, at, add) -> None:  # type: ignore[no-untyped-def]
    begin = at(left.end_lineno, left.end_col_offset)
    end = at(right.lineno, right.col_offset)
    if (place := text.find(operator, begin, end)) >= 0:
        add(left.end_lineno, place, operator, SWAPS[operator])


def kernel_mutants(path: Path) -> list[Mutant]:
    """All faults that can be planted in a kernel file, outside of comments and preprocessor lines."""
    text, results = path.read_text(), []
    bare = re.sub(
        r"//[^\n]*|/\*.*?\*/|^[ \t]*#[^\n]*", lambda m: re.sub(r"[^\n]", " ", m.group()), text, flags=re.M | re.S
    )
    for match in KERNEL_SITES.finditer(bare):
        old = match.group()
        if old.strip().startswith("barrier"):
            new = old.replace(old.strip(), ";")
        elif old in SWAPS:
            new = SWAPS[old]
        else:
            new = f"{float(old.rstrip('f')) * 1.5 or 0.5}f" if "." in old else str(int(old.rstrip("f")) + 1)
        results.append(
            Mutant(str(path.relative_to(ROOT)), text.count("\n", 0, match.start()) + 1, match.start(), old, new)
        )
    return results


def draw(seed: int, count: int) -> list[Mutant]:
    """Draw faults over all rooms and the kernels, one file of a room in turn."""
    rng = random.Random(seed)
    places: dict[str, list[Path]] = {}
    for path in FILES:
        if path.name != "__init__.py" and room_of(path) != "clsplat":
            places.setdefault(room_of(path), []).append(path)
    kernels = sorted((ROOT / "cl_kernels").glob("*.cl"))
    rooms = sorted(places)
    rng.shuffle(rooms)
    drawn = []
    for i in range(count):
        if i % 4 == 3:
            options = kernel_mutants(rng.choice(kernels))
        else:
            options = python_mutants(rng.choice(places[rooms[(i - i // 4) % len(rooms)]]))
        if options:
            kind = rng.choice(sorted({_kind(option) for option in options}))
            drawn.append(rng.choice([option for option in options if _kind(option) == kind]))
    return drawn


def _kind(mutant: Mutant) -> str:
    if mutant.new in ("False", "pass", ";"):
        return "dropped"
    return "operator" if mutant.old in SWAPS else "constant" if re.match(r"[\d.]", mutant.old) else "swapped"


def tests_of(mutant: Mutant) -> list[str]:
    """The tests that are run first: those of the room; of a kernel, all tests of kernels."""
    room = room_of(ROOT / mutant.file)
    return ["tests", "-m", "kernels"] if room == "cl_kernels" else [f"tests/{room}"]


def is_killed(copy: Path, mutant: Mutant, tests: list[str], limit: float) -> bool:
    """Whether tests fail with the fault; one that makes them hang is killed too."""
    file = copy / mutant.file
    text = file.read_text()
    assert text.startswith(mutant.old, mutant.offset), mutant
    file.write_text(text[: mutant.offset] + mutant.new + text[mutant.offset + len(mutant.old) :])
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--numprocesses", "2", *tests]
    try:
        done = subprocess.run(command, cwd=copy, capture_output=True, text=True, timeout=limit, env=_environment(copy))
        return done.returncode != 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        file.write_text(text)


def _environment(copy: Path) -> dict[str, str]:
    import os

    path = os.pathsep.join([str(copy), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=49)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path("build/mutants.json"))
    parser.add_argument("--whole", action="store_true", help="try survivors on the whole suite")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds for one mutant and set of tests")
    options = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "checkout"
        subprocess.run(["git", "clone", "-q", ROOT, copy], check=True)  # what is committed
        collect = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-p", "no:cacheprovider"]
        done = subprocess.run(collect, cwd=copy, capture_output=True, text=True, env=_environment(copy))
        if done.returncode:  # all faults would seem to be killed
            sys.exit(f"the tests of the copy cannot be collected:\n{done.stdout}{done.stderr}")
        for mutant in draw(options.seed, options.count):
            killed = is_killed(copy, mutant, tests_of(mutant), options.limit)
            if not killed and options.whole:
                killed = is_killed(copy, mutant, ["tests"], options.limit)
            results.append({**asdict(mutant), "killed": killed})
            print(
                f"{'killed  ' if killed else 'SURVIVED'} {mutant.file}:{mutant.line}: {mutant.old} -> {mutant.new}",
                flush=True,
            )
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
