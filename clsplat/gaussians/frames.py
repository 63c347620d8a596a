"""A moving model as files that stand still: one of a moment, or one of each of many moments."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError
from clsplat.formats.table import for_writing, named
from clsplat.gaussians.conversion import Changes, Options, convert

MOST = 10_000  # files


def checked_time(time: float | None) -> float | None:
    """Return a time.  Raises ConfigError for one that is not of a scene."""
    if time is not None and not 0 <= time <= 1:
        raise ConfigError(f"--time {time:g}: expected a number from 0, the first moment, to 1, the last")
    return time


def convert_frames(
    sources: Sequence[Path], out: Path, frames: int, changes: Changes, options: Options
) -> dict[str, Any]:
    """Write one static model of each of so many moments, evenly spaced from the first to the last.

    out: a folder, in which they are PLYs with a number for a name; or a file, to whose name a number is added.
    Returns what `convert` does, with the sums over files, the largest number of `gaussians`, and `files`.
    Raises ConfigError, DataError, OutputError.
    """
    if not 2 <= frames <= MOST:
        raise ConfigError(f"--frames {frames}: expected 2 to {MOST:,} moments; `--time T` writes one")
    if changes.time is not None:
        raise ConfigError("--frames and --time: expected one of them")
    done = []
    for number in range(frames):
        moment = replace(changes, time=number / (frames - 1))
        done.append(convert(sources, _numbered(out, number, len(str(frames - 1))), moment, options))
    return {
        **done[0],
        "file": str(out),
        "files": [one["file"] for one in done],
        "gaussians": max(one["gaussians"] for one in done),
        "bytes": sum(one["bytes"] for one in done),
    }


def _numbered(out: Path, number: int, digits: int) -> Path:
    """The file of a moment."""
    count = f"{number:0{max(4, digits)}}"
    if (codec := named(out)) is None and out.suffix == "":
        return out / f"{count}.ply"
    codec = for_writing(out)
    ending = next((end for end in sorted(codec.endings, key=len, reverse=True) if out.name.lower().endswith(end)), "")
    if not ending.startswith("."):
        raise ConfigError(f"{out}: --frames adds a number to a name; expected a folder, or a name such as frame.spz")
    return out.with_name(f"{out.name[: -len(ending)]}_{count}{out.name[-len(ending) :]}")
