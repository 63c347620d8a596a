"""Find the photographs below a folder, and link them into another."""

import logging
import os
import shutil
from pathlib import Path

import cv2
import numpy as np

from clsplat.errors import DataError
from clsplat.files import atomic
from clsplat.progress import Count
from clsplat.scene.exif import exposure_of, write_exposures
from clsplat.scene.images import IMAGE_SUFFIXES, read_image

LOG = logging.getLogger("clsplat")
UNREADABLE_SUFFIXES = {".heic", ".heif", ".avif", ".dng", ".cr2", ".nef", ".arw"}  # photographs that OpenCV cannot read
MIN_PHOTOGRAPHS = 3  # in a folder, and in a model


def list_photographs(folder: Path, without: Path | None = None) -> list[str]:
    """Return the names of the photographs below a folder, sorted, without hidden ones and those below `without`.

    Raises DataError when there are too few of them.
    """
    names, unreadable = _found(folder, without)
    if unreadable:
        LOG.warning(
            "%s: %d files such as %s are left out: convert them to JPEG", folder, len(unreadable), unreadable[0]
        )
    require_photographs(folder, without)
    return names


def require_photographs(folder: Path, without: Path | None = None) -> None:
    """Raise DataError when there are too few photographs below a folder."""
    names, _ = _found(folder, without)
    if len(names) < MIN_PHOTOGRAPHS:
        suffixes = ", ".join(sorted(IMAGE_SUFFIXES))
        raise DataError(f"{folder}: found {len(names)} photographs; expected at least {MIN_PHOTOGRAPHS}, of {suffixes}")


def _found(folder: Path, without: Path | None) -> tuple[list[str], list[str]]:
    """The names of photographs, sorted, and of those that cannot be read."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; expected one with photographs")
    names: list[str] = []
    unreadable: list[str] = []
    for base, folders, files in os.walk(folder):
        folders[:] = sorted(f for f in folders if f[0] != "." and (Path(base) / f).resolve() != without)
        for file in files:
            suffix = Path(file).suffix.lower()
            if file[0] != "." and suffix in IMAGE_SUFFIXES | UNREADABLE_SUFFIXES:
                name = (Path(base) / file).relative_to(folder).as_posix()
                (names if suffix in IMAGE_SUFFIXES else unreadable).append(name)
    return sorted(names), unreadable


def gather(photographs: Path, images: Path, names: list[str]) -> tuple[list[str], dict[str, str]]:
    """Link photographs into a folder, or copy them upright.

    Return the names of those that can be read, and why the others cannot; what an interrupted call has put there stays.
    """
    kept, damaged, count = [], dict[str, str](), Count("photographs read", len(names))
    for number, name in enumerate(names, 1):
        count.reach(number)
        if _is_there(photographs / name, images / name):
            kept.append(name)
            continue
        try:
            stored, upright = read_image(photographs / name), read_image(photographs / name, upright=True)
        except DataError as error:
            damaged[name] = str(error).removeprefix(f"{photographs / name}: ").partition(";")[0]
            continue
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        if stored.shape[:2] == upright.shape[:2] and (stored[:, :, :3] == upright[:, :, :3]).all():
            link(photographs / name, images / name)
        else:
            _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(upright[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 98])
            with atomic(images / name) as file:
                file.write(encoded.tobytes())
        kept.append(name)
    write_exposures(images, {name: exposure_of(photographs / name) for name in kept})  # a copy has none
    if len(kept) < MIN_PHOTOGRAPHS:
        raise DataError(f"{photographs}: only {len(kept)} of {len(names)} photographs can be read; export them again")
    return kept, damaged


def link(source: Path, target: Path) -> None:
    """Link a file or folder, or copy it where links are not supported; what is there already stays.

    The link is relative: moved together, both are found.
    """
    if _is_there(source, target):
        return
    try:
        target.unlink(missing_ok=True)
        there = os.path.relpath(source.resolve(), target.parent.resolve())
        target.symlink_to(there, target_is_directory=source.is_dir())
    except (OSError, ValueError):  # no path leads to another drive of Windows
        half = target.with_name(f".{target.name}")
        if source.is_dir():
            shutil.rmtree(half, ignore_errors=True)
            shutil.copytree(source, half)
        else:
            shutil.copyfile(source, half)
        half.replace(target)


def _is_there(source: Path, target: Path) -> bool:
    """Whether a target is a copy, which is complete, or a link to this source."""
    return target.exists() and (not target.is_symlink() or target.resolve() == source.resolve())
