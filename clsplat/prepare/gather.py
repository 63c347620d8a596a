"""Find the photographs in a folder, link them into another folder, and describe the photographs that are left out."""

import logging
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from clsplat.core.errors import DataError, first_few, pluralize, shell_quote
from clsplat.core.files import open_atomic
from clsplat.core.progress import ItemCounter
from clsplat.core.reading import CONTENT_STARTS, open_regular, read_file
from clsplat.scene.images import (
    IMAGE_SUFFIXES,
    JPEG,
    MAX_BYTES,
    TAIL_SIZE,
    copy_exif,
    decode_image,
    parse_header,
    read_exif_exposure,
    read_gray,
    write_exposures,
)
from clsplat.scene.lookup import describe_unsupported_cameras
from clsplat.scene.multicamera import VIDEO_SUFFIXES
from clsplat.scene.quality import is_blank
from clsplat.scene.times_file import read_times, write_times

LOG = logging.getLogger("clsplat")
CONVERTERS = {  # photographs that OpenCV cannot read, and commands that convert them to JPEG
    "HEIC": ({".heic", ".heif"}, "heif-convert d.heic d.jpg, or sips -s format jpeg *.heic --out . on a Mac"),
    "AVIF": ({".avif"}, "ffmpeg -i d.avif d.jpg"),
    "DNG": ({".dng"}, "darktable-cli d.dng d.jpg"),
    "raw": ({".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}, "darktable-cli d.nef d.jpg"),
    "other": ({".gif", ".jxl", ".jp2", ".exr", ".hdr", ".psd", ".tga"}, "magick d.gif d.jpg"),
}
BRANDS = {  # at byte 8 of a file, after `ftyp`, in HEIF (ISO/IEC 23008-12) and the AV1 Image File Format
    "HEIC": {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"},
    "AVIF": {b"avif", b"avis"},
}
UNREADABLE_SUFFIXES = {suffix for suffixes, _ in CONVERTERS.values() for suffix in suffixes}
OTHER_FORMAT = "contains {} data"  # reason why a photograph cannot be read
MIN_PHOTOGRAPHS = 3  # in a folder, and in a model
CHECKED_SIDE = 64  # px; photographs that are linked are decoded at this size, only to check them


def list_photographs(folder: Path, excluded_folder: Path | None = None) -> list[str]:
    """Return the sorted names of the photographs below a folder, without hidden files and files in `excluded_folder`.

    Logs a warning about files in other formats.  Raises DataError when there are too few photographs.
    """
    names, unreadable_names = _list_photo_names(folder, excluded_folder)
    for warning in (*_conversion_hints(unreadable_names), describe_unsupported_cameras(folder)):
        if warning:
            LOG.warning("%s: %s", folder, warning)
    require_photographs(folder, excluded_folder)
    return names


def require_folder(folder: Path) -> None:
    """Raise DataError unless `folder` is a folder.  For a video, the error names the command to extract photographs."""
    if folder.suffix.lower() in VIDEO_SUFFIXES and folder.is_file():
        raise DataError(
            f"{folder}: is a video; run `clsplat data video {shell_quote(folder)} FOLDER` to extract photos"
        )
    if not folder.is_dir():
        fault = "is a file" if folder.is_file() else "no such folder"
        raise DataError(f"{folder}: {fault}; expected a folder of photos")


def require_photographs(folder: Path, excluded_folder: Path | None = None) -> None:
    """Raise DataError when there are fewer than MIN_PHOTOGRAPHS photographs below a folder."""
    names, unreadable_names = _list_photo_names(folder, excluded_folder)
    if len(names) < MIN_PHOTOGRAPHS:
        suffixes = ", ".join(sorted(IMAGE_SUFFIXES))
        hints = "".join(f"; {text}" for text in _conversion_hints(unreadable_names))
        raise DataError(
            f"{folder}: has {pluralize(len(names), 'photo')}; "
            f"expected at least {MIN_PHOTOGRAPHS}, preferably 30 or more that overlap by two thirds ({suffixes}){hints}"
        )


def _conversion_hints(unreadable_names: list[str]) -> list[str]:
    """For each format that cannot be read, return a sentence with a command that converts its files."""
    hints = []
    for format_name, (suffixes, command) in CONVERTERS.items():
        if names := [name for name in unreadable_names if Path(name).suffix.lower() in suffixes]:
            unreadable_files = f"{pluralize(len(names), f'{format_name} file')} cannot be read ({first_few(names)})"
            hints.append(f"{unreadable_files}: convert to JPEG, for example with {command}")
    return hints


def _list_photo_names(folder: Path, excluded_folder: Path | None) -> tuple[list[str], list[str]]:
    """Return the sorted names of the photographs below a folder, and the names of files in unreadable formats."""
    require_folder(folder)
    names: list[str] = []
    unreadable_names: list[str] = []
    for base, folders, files in os.walk(folder):
        folders[:] = sorted(f for f in folders if f[0] != "." and (Path(base) / f).resolve() != excluded_folder)
        for file in files:
            suffix = Path(file).suffix.lower()
            if file[0] != "." and suffix in IMAGE_SUFFIXES | UNREADABLE_SUFFIXES:
                name = (Path(base) / file).relative_to(folder).as_posix()
                (names if suffix in IMAGE_SUFFIXES else unreadable_names).append(name)
    return sorted(names), unreadable_names


def gather(photographs: Path, images: Path, names: list[str]) -> tuple[list[str], dict[str, str]]:
    """Link photographs into the folder `images`, or copy them upright; keep files that an interrupted call left there.

    Returns the names of the readable photographs, and a dict from the names of the others to the reasons.  Raises
    DataError when too few can be read, or when all are blank.
    """
    readable_names, read_errors, counter = [], dict[str, str](), ItemCounter("photos read", len(names))
    blank_count = 0
    for i, name in enumerate(names, 1):
        counter.reach(i)
        if _is_gathered(photographs / name, images / name):
            readable_names.append(name)
            continue
        try:
            blank_count += _gather_photo(photographs / name, images / name)
        except DataError as error:
            read_errors[name] = failure_reason(photographs / name, error)
            continue
        readable_names.append(name)
    # written separately, since a copy of a PNG has no EXIF data
    write_exposures(images, {name: read_exif_exposure(photographs / name) for name in readable_names})
    if times := read_times(photographs):
        write_times(images, {name: times[name] for name in readable_names if name in times})
    if readable_names and blank_count == len(readable_names):
        raise DataError(f"{photographs}: all photos are blank; export them again, or retake them")
    if len(readable_names) < MIN_PHOTOGRAPHS:
        faults = first_few([f"{name} ({reason})" for name, reason in read_errors.items()])
        raise DataError(
            f"{photographs}: only {len(readable_names)} of {len(names)} photos can be read: {faults}; "
            f"{remedy_for(read_errors)}"
        )
    return readable_names, read_errors


def failure_reason(photograph: Path, error: DataError) -> str:
    """Return the reason why a photograph cannot be read: its actual format, or the message of `error`."""
    with suppress(OSError), open_regular(photograph) as file:
        head = file.read(12)
        for format_name, brands in BRANDS.items():
            if head[4:8] == b"ftyp" and head[8:] in brands:
                return OTHER_FORMAT.format(format_name)
    return str(error).removeprefix(f"{photograph}: ").partition(";")[0]


def remedy_for(read_errors: Mapping[str, str]) -> str:
    """Return a remedy for photographs that cannot be read.  read_errors: reasons by name, from `gather`."""
    remedies = {f"the file is {content}": remedy for _, content, remedy in CONTENT_STARTS}
    for name in BRANDS:
        remedies[OTHER_FORMAT.format(name)] = f"convert {name} files to JPEG, for example with {CONVERTERS[name][1]}"
    sentences = [remedy for reason, remedy in remedies.items() if reason in read_errors.values()]
    if set(read_errors.values()) - remedies.keys():
        sentences.append("export the others again" if sentences else "export them again")
    return "; ".join(sentences)


def _gather_photo(source: Path, target: Path) -> bool:
    """Link a photograph, or write it upright with its EXIF data; return whether the image is blank.

    Raises DataError when it cannot be read.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    data = read_file(source, "an image", limit=MAX_BYTES)
    if data.startswith(JPEG) and (header := parse_header(data, data[-TAIL_SIZE:], lambda: data)):
        is_upright = header.orientation == 1
        pixels = read_gray(source, CHECKED_SIDE)[0] if is_upright else decode_image(data, source, upright=True)
    else:
        raw, pixels = decode_image(data, source), decode_image(data, source, upright=True)
        is_upright = raw.shape[:2] == pixels.shape[:2] and bool((raw[:, :, :3] == pixels[:, :, :3]).all())
    if is_upright:
        link(source, target)
    else:
        _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 98])
        with open_atomic(target) as file:
            file.write(copy_exif(data, encoded.tobytes()))
    return is_blank(pixels)


def link(source: Path, target: Path) -> None:
    """Link a file or folder, or copy it where links are not supported.  Keep an existing link or copy.

    The link is relative, so it stays valid when source and target are moved together.
    """
    if _is_gathered(source, target):
        return
    try:
        target.unlink(missing_ok=True)
        relative = os.path.relpath(source.resolve(), target.parent.resolve())
        target.symlink_to(relative, target_is_directory=source.is_dir())
    except (OSError, ValueError):  # Windows has no relative path to another drive
        partial = target.with_name(f".{target.name}")
        if source.is_dir():
            shutil.rmtree(partial, ignore_errors=True)
            shutil.copytree(source, partial)
        else:
            shutil.copyfile(source, partial)
        partial.replace(target)


def _is_gathered(source: Path, target: Path) -> bool:
    """Return whether the target is a complete copy of the source, or a link to it."""
    return target.exists() and (not target.is_symlink() or target.resolve() == source.resolve())


def log_warnings(statistics: Mapping[str, Any]) -> None:
    """Log a warning about photographs that a step left out.  statistics: those returned by the step."""
    for warning in warnings_for(statistics):
        LOG.warning("%s", warning)


def warnings_for(statistics: Mapping[str, Any]) -> list[str]:
    """Return the warnings about photographs that a step left out.  statistics: those returned by the step."""
    warnings = []
    if errors := statistics.get("damaged"):
        names = [f"{name} ({reason})" for name, reason in errors.items()]
        count = statistics["photographs"] + len(names)
        warnings.append(f"{len(names)} of {count} photos cannot be read: {first_few(names)}; {remedy_for(errors)}")
    if missing_names := statistics.get("not_registered"):
        reasons = statistics.get("reasons", {})
        examples = first_few([f"{name} ({reasons[name]})" if name in reasons else name for name in missing_names])
        alternative = "" if statistics.get("denser_tried") else ", or find more features (find_features.long_side)"
        warnings.append(
            f"{len(missing_names)} of {statistics['registered'] + len(missing_names)} photos could not be registered "
            f"and are not used: {examples}; to register them, add photos from viewpoints in between{alternative}"
        )
    if sizes := statistics.get("other_models"):
        counts = ", ".join([*map(str, sizes[:-1]), pluralize(sizes[-1], "photo")])
        warnings.append(
            f"only the largest model is used, without {pluralize(len(sizes), 'smaller model')} of {counts}; add "
            "photos that connect the models"
        )
    return warnings


def summarize_placement(statistics: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a sentence with the number of registered photos, the mean reprojection error, and the unused photos.

    statistics: the result of `read_statistics`.  Returns "" if they are incomplete.
    """
    cameras = statistics.get("map_cameras", {})
    try:
        read_errors = statistics.get("find_features", {}).get("damaged", {})
        faults = [f"{name} ({reason})" for name, reason in read_errors.items()]
        reasons = cameras.get("reasons", {})
        missing = [f"{name} ({reasons[name]})" if name in reasons else str(name) for name in cameras["not_registered"]]
        count, unused_photos = int(cameras["registered"]), [*faults, *missing]
        error = float(cameras["error_px"])
        text = f"{count} of {count + len(unused_photos)} photos registered, reprojection error {error:.2f} px"
    except (AttributeError, KeyError, TypeError, ValueError):
        return ""
    return text + (f"; left out: {first_few(unused_photos)}" if unused_photos else "")
