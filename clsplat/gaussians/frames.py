"""A moving model as files that stand still: one of a moment, or one of each of many moments."""

import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError, DataError
from clsplat.files import is_there, scratch_folder, told_as
from clsplat.formats.motion import EXPECTED, is_moment
from clsplat.formats.table import for_writing, named
from clsplat.gaussians.conversion import Changes, Options, check_place, read, written
from clsplat.gaussians.sky import sky_file

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
    folder, begin, end = _name_of(out)
    digits = max(4, len(str(frames - 1)))
    places = [folder / f"{begin}{number:0{digits}}{end}" for number in range(frames)]
    for place in places:
        check_place(sources, place)
    _require_no_others(folder, re.compile(re.escape(begin) + r"\d{4,}" + re.escape(end)), places)
    reading, writing = options.of(sources, places[0])
    model = read(sources, reading)
    moments = [replace(changes, time=number / (frames - 1)) for number in range(frames)]
    for moment in moments:  # before anything is written
        try:
            moment.of(model)
        except DataError as error:
            raise DataError(f"--frames {frames}: the moment {moment.time:g}: {error}; nothing was written") from error
    done: list[dict[str, Any]] = []
    with _all_or_as_before([*places, *map(sky_file, places)]):
        for place, moment in zip(places, moments, strict=True):
            done.append(written(sources, moment.of(model), place, replace(writing, quiet=bool(done))))
    return {
        **done[0],
        "file": str(out),
        "files": [str(place) for place in places],
        "gaussians": max(one["gaussians"] for one in done),
        "bytes": sum(one["bytes"] for one in done),
    }


@contextmanager
def _all_or_as_before(places: Sequence[Path]) -> Iterator[None]:
    """Where the block fails, as on a disk that fills, give places in one folder what they had; a new folder goes.

    Raises OutputError.
    """
    folder = places[0].parent
    was_there = is_there(folder)
    try:
        with scratch_folder(folder / "series") as kept, told_as(folder):
            before = [place for place in places if place.is_file()]
            for place in before:
                _keep(place, kept / place.name)
            try:
                yield
            except BaseException:
                for place in places:
                    if place in before:
                        os.replace(kept / place.name, place)
                    elif place.is_file():
                        place.unlink()
                raise
    finally:
        if not was_there:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def _keep(place: Path, other: Path) -> None:
    """Give a file, which is replaced and not changed, another name; where a disk has no links, copy it."""
    try:
        os.link(place, other)
    except OSError:
        shutil.copy2(place, other)


def _require_no_others(folder: Path, names: re.Pattern[str], places: Sequence[Path]) -> None:
    """Raise ConfigError where a folder has frames of another series, which a player would take for this one's."""
    own = {place.name for place in places}
    with told_as(folder):
        there = sorted(os.listdir(folder)) if folder.is_dir() else []
    if others := [name for name in there if names.fullmatch(name) and name not in own]:
        raise ConfigError(
            f"{folder / others[0]}: is not of {len(places):,} frames, and would be taken for one; give a new name"
        )


def _name_of(out: Path) -> tuple[Path, str, str]:
    """The folder of frames, and what stands before and after the number in their names."""
    if named(out) is None and out.suffix == "":
        return out, "", ".ply"
    codec = for_writing(out)
    ending = next((end for end in sorted(codec.endings, key=len, reverse=True) if out.name.lower().endswith(end)), "")
    if not ending.startswith("."):
        raise ConfigError(f"{out}: --frames adds a number to a name; expected a folder, or a name such as frame.spz")
    return out.parent, f"{out.name[: -len(ending)]}_", out.name[-len(ending) :]
