"""A kill at each temporary file of a run: before its rename, and between the rename and the sync of the folder.

    python -m tests.torture.each_file SCENE FOLDER CASES

prints a JSON list of [case, files of the run, whether the process was killed, the code of the resumed run, whether its
bits and records are those of the undisturbed run].  At most CASES of each kind are tried, spread over the run.
"""

import json
import os
import signal
import sys
from pathlib import Path

import clsplat
from clsplat.core import files
from tests.torture.kills import Attempt, identity

TINY = {
    "optimize.steps": 4,
    "init.count": 20,
    "checkpoint.every": 2,
    "optimize.log_every": 2,
    "optimize.evaluate.every": 3,
}
MOMENTS = ("before the rename", "before the sync")


class AtFile(Attempt):
    """A child process that kills itself at the n-th file that it writes into the run folder; 0: at none."""

    def __init__(self, scene: Path, out: Path, at: int = 0, moment: str = "") -> None:
        self.at, self.moment, self.count = at, moment, 0
        super().__init__(scene, out, "smoke")

    def _train(self, scene: Path, out: Path, recipe: str) -> None:
        rename = files._replace

        def kill(now: str) -> None:
            if (self.count, self.moment) == (self.at, now):
                os.kill(os.getpid(), signal.SIGKILL)

        def counting(temporary: Path, path: Path) -> None:
            self.count += path.is_relative_to(out)
            kill("before the rename")
            rename(temporary, path)
            kill("before the sync")

        files._replace = counting
        clsplat.run(recipe, scene, out, set=TINY, start="resume")
        out.with_suffix(".count").write_text(str(self.count))


def each_file(scene: Path, folder: Path, cases: int) -> list[tuple[str, int, bool, int, bool]]:
    """Kill at the files of a run on a scene, below `folder`, and resume; return what the module's head says."""
    folder.mkdir(parents=True, exist_ok=True)
    whole, results = folder / "whole", []
    AtFile(scene, whole).wait()
    total = int(whole.with_suffix(".count").read_text())
    stride = max(1, total // cases)
    for number, moment in enumerate(MOMENTS):
        for at in range(1 + stride * (1 + 2 * number) // 4, total + 1, stride):
            out = folder / f"{moment} {at}"
            killed = AtFile(scene, out, at, moment).end() == -signal.SIGKILL
            code = AtFile(scene, out).end()
            results.append((out.name, total, killed, code, code == 0 and identity(out) == identity(whole)))
    return results


if __name__ == "__main__":
    print(json.dumps(each_file(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))))
