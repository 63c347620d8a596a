"""What photographs look like beside each other: blurred ones, the same one twice, exposures that jump, filled edges."""

import os
from collections.abc import Container, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.inspect.padding import padding
from clsplat.prepare.gather import why_unreadable
from clsplat.progress import counted
from clsplat.scene.exif import CameraExposure, exposure_of
from clsplat.scene.exposures import camera_exposures
from clsplat.scene.images import read_grey
from clsplat.scene.parts import Parts
from clsplat.scene.sharpness import SIDE, both_sharpnesses, is_blurred
from clsplat.scene.view import NO_FILE

THUMBNAIL = 32  # px, of each side
SAME = 1.0  # grey levels between thumbnails: frames of a video are 9 apart, two codings of one photograph 0.3
JUMP = 1.0  # stops from one photograph to the next
STEP = 2.0  # brightness of a photograph by that of the one before: at most 1.4 in five captures with one exposure


@dataclass(frozen=True)
class Look:
    """What is measured of one photograph."""

    sharpness: NDArray[np.float64]  # both
    brightness: NDArray[np.float64]  # mean and median, grey levels
    thumbnail: NDArray[np.float32]  # [THUMBNAIL²], grey levels


@dataclass(frozen=True)
class LookFacts:
    """Names of photographs that stand out."""

    blurred: list[str]  # much less sharp than the others
    same: list[list[str]]  # photographs that look the same
    jumps: list[tuple[str, str, float]]  # one and the next, and the stops between their exposures as EXIF tells them
    steps: list[tuple[str, str, float]]  # one, the next, and its brightness by that of the first; where EXIF is silent
    unreadable: dict[str, str]  # the reason why they cannot be decoded
    padded: dict[str, int]  # px of an edge that repeat the line beside them, in the first photographs


def looks_of(parts: Parts, missing: Container[Path]) -> LookFacts:
    """Compare the photographs of the views of a dataset, or where it has no views, all of its folder."""
    shown = [view for view in parts.views if view.image_path != NO_FILE and view.image_path not in missing]
    if not shown:
        return looks({os.path.relpath(file, parts.path).replace(os.sep, "/"): file for file in parts.on_disk})
    exposures: list[CameraExposure | None] = [None] * len(shown)
    with suppress(DataError):
        exposures = camera_exposures(shown)
    files = {view.name: view.image_path for view in shown}
    return looks(files, {view.name: one for view, one in zip(shown, exposures, strict=True)})


def looks(files: Mapping[str, Path], exposures: Mapping[str, CameraExposure | None] | None = None) -> LookFacts:
    """Compare photographs, by name; those that cannot be read are left out.  Without `exposures`, EXIF tells them."""
    names = sorted(files)
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8), "looking") as pool:
        read = counted(pool.map(_look, (files[name] for name in names)), "photographs looked at", len(names))
        looked = dict(zip(names, read, strict=True))
    found = {name: look for name, look in looked.items() if not isinstance(look, DataError)}
    if exposures is None:
        exposures = {name: exposure_of(files[name]) for name in found}
    values = [(name, exposure.value) for name in names if (exposure := exposures.get(name))]
    steps = [(a, b, round(abs(y - x), 2)) for (a, x), (b, y) in pairwise(values)]
    middle = np.median([look.sharpness for look in found.values()], axis=0) if found else np.zeros(2)
    return LookFacts(
        blurred=[name for name, look in found.items() if is_blurred(look.sharpness, middle)],
        same=_same(list(found), [look.thumbnail for look in found.values()]),
        jumps=[step for step in steps if step[2] > JUMP],
        steps=_steps({name: look.brightness for name, look in found.items()}, {name for name, _ in values}),
        unreadable={
            name: why_unreadable(files[name], error) for name, error in looked.items() if isinstance(error, DataError)
        },
        padded=padding(files[name] for name in found),
    )


def _look(file: Path) -> Look | DataError:
    """Measure a photograph; or return why it cannot be read."""
    try:
        grey = read_grey(file, SIDE)[0]
    except DataError as error:
        return error
    small = cv2.resize(grey, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
    brightness = np.maximum([grey.mean(), np.median(grey)], 1.0)
    return Look(both_sharpnesses(grey), brightness, small.astype(np.float32).ravel())


def _steps(brightness: Mapping[str, NDArray[np.float64]], told: Container[str]) -> list[tuple[str, str, float]]:
    """Neighbours of which mean and median both differ by more than STEP times: one of them follows what is shown.

    told: photographs whose exposures are known; two of them make no step.
    """
    found = []
    for (a, x), (b, y) in pairwise(brightness.items()):
        ratios = y / x
        if a in told and b in told:
            continue
        if min(ratios) > STEP or max(ratios) < 1 / STEP:
            found.append((a, b, round(float(ratios[0]), 2)))
    return found


def _same(names: Sequence[str], thumbnails: Sequence[NDArray[np.float32]]) -> list[list[str]]:
    """Groups of photographs whose thumbnails are the same; plain ones say nothing."""
    groups: list[list[int]] = []
    for i, one in enumerate(thumbnails):
        if one.std() <= SAME:
            continue
        firsts = np.array([thumbnails[group[0]] for group in groups]).reshape(len(groups), len(one))
        near = np.flatnonzero(((firsts - one) ** 2).mean(axis=1) < SAME**2)
        groups[near[0]].append(i) if len(near) else groups.append([i])
    return [[names[i] for i in group] for group in groups if len(group) > 1]
