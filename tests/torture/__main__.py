"""The long form of the tests against data loss: `make torture`, more than an hour on two cores.

    python -m tests.torture [--kills 1000] [--inputs 100000] [--write]

With `--write` the table goes to docs/reliability.md.  Exit code 1 where a line of it does not hold.
"""

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from clsplat.core.resources import __version__
from clsplat.data_tools.synthetic import SyntheticOptions, write_dataset
from tests.torture.kills import kills

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reliability.md"
READERS = (  # what is damaged, the tests, and the share of --inputs that each gets: in some a case takes 10 ms and more
    ("PLY files", ["test_ply.py"], 1.0),
    ("other formats of models", ["test_formats.py"], 1.0),
    ("photographs", ["test_images.py"], 1.0),
    ("files of cameras", ["test_camera_files.py"], 1.0),
    ("scenes", ["test_scenes.py"], 0.2),
    ("pipelines and records", ["test_pipelines.py"], 0.05),
    ("files of a whole run", ["test_run_folders.py", "-k", "whole_run"], 0.01),
    ("archives of a checkpoint", ["test_run_folders.py", "-k", "archive"], 1.0),
)
BEGIN, END = "<!-- torture: begin -->", "<!-- torture: end -->"


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    what: str
    cases: int
    result: str
    holds: bool
    seconds: float

    @property
    def text(self) -> str:
        return f"| {self.what} | {self.cases:,} | {self.result} | {self.seconds / 60:.0f} min |"


def killed(count: int, folder: Path) -> Row:
    """`kill -9` at random moments of runs on a tiny scene."""
    start, scene = time.perf_counter(), folder / "scene"
    write_dataset(scene, SyntheticOptions(size=40, train=8, test=2, seed=0), workers=1)
    for tally in kills(scene, folder / "runs", count):
        print(f"\r{dict(tally)}", end="", flush=True)
    print()
    result = (
        f"{tally['equal']} of {tally['finished']} runs ended with the bits of an undisturbed run; "
        f"{tally['in a write']} kills happened during a write"
    )
    holds = tally["equal"] == tally["finished"] > 0
    return Row(
        "`kill -9` at a random moment, then resumed", tally["killed"], result, holds, time.perf_counter() - start
    )


def tested(what: str, holds: str, count: int, *arguments: str) -> Row:
    """Tests with many more examples than in the suite: `count` of each, or as many as it says that it has tried.

    holds: what is shown when they pass.
    """
    start = time.perf_counter()
    environment = {**os.environ, "CLSPLAT_FUZZ": str(count)}
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "results.xml"
        pytest = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:logging"]
        command = [*pytest, f"--junit-xml={results}", *arguments]
        end = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        cases = cases_in(results, count)
    if end.returncode:
        print(
            *(line[:2000] for line in end.stdout.splitlines() if line.startswith(("example", "E  ", "FAILED"))),
            sep="\n",
        )
    return Row(
        what, cases, holds if end.returncode == 0 else "failed", end.returncode == 0, time.perf_counter() - start
    )


def cases_in(results: Path, count: int) -> int:
    """The number of cases in a file of results: what a test has recorded as the property `cases`, or `count`."""
    if not results.exists():
        return 0
    tests = ElementTree.parse(results).iter("testcase")
    recorded = (
        [int(item.get("value", 0)) for item in test.iter("property") if item.get("name") == "cases"] for test in tests
    )
    return sum(sum(cases) if cases else count for cases in recorded)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.torture", description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=1000, help="number of kills")
    parser.add_argument("--inputs", type=int, default=100_000, help="number of damaged inputs of each reader")
    parser.add_argument("--write", action="store_true", help="write the table to docs/reliability.md")
    options = parser.parse_args()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        rows.append(killed(options.kills, Path(folder)))
    for what, (file, *only), share in READERS:
        count = max(1, int(share * options.inputs))
        rows.append(
            tested(f"damaged {what}", "each read or rejected with one sentence", count, f"tests/fuzz/{file}", *only)
        )
    same = "nothing lost; resumed to the same bits"
    rows.append(tested("a failing write, for each write of a run", same, 1, "tests/runs/test_failing_writes.py"))
    rows.append(
        tested(
            "`kill -9` at each file, before and after its rename",
            same,
            1,
            "tests/torture/test_torture.py",
            "-k",
            "whichever_file",
        )
    )
    table = "\n".join(["| test | cases | result | time |", "|---|---|---|---|", *(row.text for row in rows)])
    print(table)
    if options.write:
        head, _, rest = PAGE.read_text().partition(BEGIN)
        tail = rest.partition(END)[2]
        place = f"clsplat {__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
        PAGE.write_text(f"{head}{BEGIN}\n{place}:\n\n{table}\n{END}{tail}")
    return 0 if all(row.holds for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
