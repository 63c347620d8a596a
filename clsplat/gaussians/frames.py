"""A moving model as files that stand still: one of a moment, or one of each of many moments."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError, DataError, one_line
from clsplat.files import make_folder, scratch_folder, told_as
from clsplat.formats.motion import EXPECTED, is_moment
from clsplat.formats.table import for_writing, named
from clsplat.gaussians.conversion import Changes, Options, check_place, convert

MOST = 10_000  # files


def checked_time(time: float | None) -> float | None:
    """Return a time.  Raises ConfigError for one that is not of a scene."""
    if time is not None and not is_moment(time):
        raise ConfigError(f"--time {time:g}: {EXPECTED}")
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
    places = [_numbered(out, number, len(str(frames - 1))) for number in range(frames)]
    for place in places:
        check_place(sources, place)
    done = []
    folder = places[0].parent
    with scratch_folder(folder / "frames" if folder.is_dir() else folder) as scratch:  # all of them, or none
        for number, place in enumerate(places):
            time = number / (frames - 1)
            try:
                done.append(convert(sources, scratch / place.name, replace(changes, time=time), options))
            except DataError as error:
                what = one_line(error).replace(str(scratch), str(folder))
                raise DataError(f"--frames {frames}: the moment {time:g}: {what}; nothing was written") from error
        make_folder(folder)
        for place in places:
            with told_as(place):
                os.replace(scratch / place.name, place)
    return {
        **done[0],
        "file": str(out),
        "files": [str(place) for place in places],
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
