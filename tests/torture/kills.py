"""`kill -9` at random moments: every run, resumed as often as needed, ends with the bits of the undisturbed one.

A process that has imported the program forks one child for each attempt, so that an attempt costs a run and no start.
Checkpoints are written at every step: a large share of the kills meets a write.
"""

import hashlib
import os
import random
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import clsplat
from clsplat.core.files import PARTIAL
from clsplat.training import checkpoint
from clsplat.training.records import Records

ATTEMPTS = 200  # of one run: each has time for a step at least, most for many
MORE = 1.1  # time for the next, where one has come no further
TIMES = ("ms", "cpu_seconds", "stages")  # of a record
SETTINGS = {
    "smoke": {"checkpoint.every": 1, "optimize.steps": 30},
    "mip_splatting_7k": {
        "checkpoint.every": 1,
        "optimize.steps": 20,
        "densify.start": 5,
        "densify.every": 5,
        "init.count": 500,
    },
}


def kills(scene: Path, folder: Path, count: int, seed: int = 0) -> Iterator[Counter[str]]:
    """Kill `count` runs on a scene, below `folder`; yield the tally after each.

    Its entries: killed, in a write (a temporary file was left), finished (runs that came to their end), and equal
    (those with the bits and the records of the undisturbed run).
    """
    folder.mkdir(parents=True, exist_ok=True)
    chance, tally = random.Random(seed), Counter[str]()
    expected, seconds = {}, {}
    while tally["killed"] < count:
        recipe = list(SETTINGS)[tally["finished"] % len(SETTINGS)]
        undisturbed = (folder / recipe, folder / f"{recipe}-built")  # the first one builds the kernels
        for out in () if recipe in expected else undisturbed:
            start = time.perf_counter()
            Attempt(scene, out, recipe).wait()
            expected[recipe], seconds[recipe] = identity(out), time.perf_counter() - start
        out = folder / f"{recipe}-{tally['finished']}"
        for _ in range(ATTEMPTS):
            left = partials(out)  # by earlier kills: the next one may come before they are swept
            before = checkpoint.list_files(out)[-1:]
            attempt = Attempt(scene, out, recipe)
            if attempt.killed_after(chance.uniform(0.05, 1.0) * seconds[recipe]):
                tally["killed"] += 1
                tally["in a write"] += bool(partials(out) - left)
                if checkpoint.list_files(out)[-1:] == before:  # the machine has become slower
                    seconds[recipe] *= MORE
                yield tally
            else:
                break
        else:
            raise RuntimeError(f"{out}: {ATTEMPTS} attempts, and the run has not come to its end")
        tally["finished"] += 1
        tally["equal"] += attempt.code == 0 and identity(out) == expected[recipe]
        yield tally


def partials(out: Path) -> set[Path]:
    """The temporary files below a folder."""
    return {path for path in out.rglob(".*") if PARTIAL.fullmatch(path.name)}


def identity(out: Path) -> tuple[str, str, list[str]]:
    """The bits of a run's model, its records without times, and the names of its files.

    Of the checkpoints only the newest: a kill between the writing of the last and the removal of an older leaves that.
    """
    model = hashlib.sha256((out / "point_cloud.ply").read_bytes()).hexdigest()
    lines = [{key: value for key, value in line.items() if key not in TIMES} for line in Records(out).read()]
    older = checkpoint.list_files(out)[:-1]
    files = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and path not in older)
    return model, repr(lines), files


class Attempt:
    """A child process that runs a pipeline, from the newest checkpoint where there is one."""

    def __init__(self, scene: Path, out: Path, recipe: str) -> None:
        self.code: int | None = None
        self.process = os.fork()
        if self.process == 0:
            self._run(scene, out, recipe)

    def _run(self, scene: Path, out: Path, recipe: str) -> None:
        code = 1
        try:
            log = os.open(out.with_suffix(".txt"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 1)
            os.dup2(log, 2)
            self._train(scene, out, recipe)
            code = 0
        except BaseException:
            traceback.print_exc(file=sys.stderr)
        finally:
            sys.stderr.flush()
            os._exit(code)

    def _train(self, scene: Path, out: Path, recipe: str) -> None:
        clsplat.run(recipe, scene, out, set=SETTINGS[recipe], start="resume")

    def end(self) -> int:
        """Wait for the process; return its exit code, the negative number of a signal where one has ended it."""
        self.code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
        return self.code

    def wait(self) -> None:
        if self.end() != 0:
            raise RuntimeError("the undisturbed run failed")

    def killed_after(self, seconds: float) -> bool:
        """Whether the process was killed after so many seconds; it may have ended before."""
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            if self._ended():
                return False
            time.sleep(0.002)
        os.kill(self.process, signal.SIGKILL)
        return self.end() == -signal.SIGKILL

    def _ended(self) -> bool:
        process, status = os.waitpid(self.process, os.WNOHANG)
        if process:
            self.code = os.waitstatus_to_exitcode(status)
        return bool(process)
