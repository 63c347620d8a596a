"""The facts about a dataset that decide whether, and how well, it trains."""

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clsplat.inspect.looks import LookFacts, looks_of
from clsplat.inspect.points import PointFacts, points_of
from clsplat.scene.decoding import ImageFile, decode_all
from clsplat.scene.lens import BORDER_POINTS, Lens
from clsplat.scene.parts import Parts
from clsplat.scene.scene import View, camera_extent, strayed
from clsplat.scene.times import by_camera, moments_of
from clsplat.scene.view import fits

MIN_SEEN = 30  # points; COLMAP itself registers no image with fewer inliers


@dataclass(frozen=True)
class CameraFacts:
    """Views of the same size, lens and focal length."""

    views: int
    model: str
    width: int
    height: int
    focal: tuple[float, float]  # px
    distortion: float | None  # px: the largest displacement by the lens at the border; None where it overflows
    kept: float  # share of the photograph that is left when it is undistorted
    centred: bool  # whether the principal point lies in the photograph


@dataclass(frozen=True)
class PhotographFacts:
    """The image files and masks of the views, by name."""

    unreadable: dict[str, str]  # the reason why they cannot be decoded
    cut: list[str]  # the end of the file is missing; they cannot be decoded either
    misfits: dict[str, str]  # the sizes of file and camera
    on_side: list[str]  # misfits whose width and height are swapped
    exif_turned: list[str]  # read as stored although their Exif data have a rotation
    larger: list[str]  # reduced to their cameras' size when they are read
    masks: int


@dataclass(frozen=True)
class Facts:
    """All measurements of a dataset; names are those of the views, paths are relative to the dataset."""

    path: str
    kind: str
    registered: int
    train: int | None  # None when the dataset cannot be read
    test: int | None
    on_disk: int
    missing: list[str]
    unregistered: list[str]
    folders: int  # that the registered images lie in
    submodels: dict[str, int]  # images of each COLMAP model; the first is used
    cameras: list[CameraFacts]
    photos: PhotographFacts
    looks: LookFacts
    points: PointFacts | None
    seen: dict[str, int]  # points seen by each view; empty where the dataset has no such counts
    extent: float | None  # scene units
    strayed: list[str]
    moments: int  # different times of the views; 0 where the scene does not move
    stations: int  # different cameras that took the views, where the scene moves
    one_place: bool  # all cameras have the same centre
    same_pose: list[list[str]]
    same_but_case: list[list[str]]
    same_base: int  # names that several folders hold
    left_out: list[str]  # sentences about files that `prepare` does not read as photographs
    faults: list[str]  # why pieces of it cannot be read
    refusal: str  # why training does not start

    @property
    def few_seen(self) -> list[str]:
        """Views that see fewer than MIN_SEEN points."""
        return sorted((name for name, count in self.seen.items() if count < MIN_SEEN), key=lambda name: self.seen[name])


def survey(parts: Parts) -> Facts:
    """Measure a dataset that was read in pieces."""
    views, expected = parts.views, parts.expected
    missing = [file for file in expected if not os.path.exists(file)]  # never raises
    known = {*expected, *(view.mask_path for view in views), *(view.static_path for view in views)}
    names = [view.name for view in views]
    centres = np.stack([view.position for view in views]) if views else np.empty((0, 3))
    extent = parts.scene.extent if parts.scene else camera_extent(views) if views else None
    return Facts(
        path=str(parts.path),
        kind=parts.kind,
        registered=len(expected),
        train=len(parts.scene.train) if parts.scene else None,
        test=len(parts.scene.test) if parts.scene else None,
        on_disk=len(parts.on_disk),
        missing=[_relative(file, parts) for file in missing],
        unregistered=[_relative(file, parts) for file in parts.on_disk if file not in known],
        folders=len({file.parent for file in expected}),
        submodels=parts.submodels,
        cameras=_cameras(parts),
        photos=_photographs(views, set(missing)),
        looks=looks_of(parts, set(missing)),
        points=points_of(parts, extent, centres) if parts.points else None,
        seen=parts.observed if any(parts.observed.values()) else {},
        extent=extent,
        strayed=[view.name for view, far in zip(views, strayed(views), strict=True) if far] if views else [],
        moments=len(moments_of(views)),
        stations=len(by_camera(views)) if moments_of(views) else 0,
        one_place=len(views) > 1 and bool(np.allclose(centres, centres[0], rtol=0, atol=1e-9)),
        same_pose=_repeated(names, [(v.time, v.downscale, *v.world_to_camera.ravel().round(9)) for v in views]),
        same_but_case=[group for group in _repeated(names, [n.casefold() for n in names]) if len(set(group)) > 1],
        same_base=sum(count > 1 for count in Counter(file.name for file in set(expected)).values()),
        left_out=parts.left_out,
        faults=parts.faults,
        refusal=parts.refusal,
    )


def distortion(lens: Lens) -> float | None:
    """Return the largest displacement by the lens along the border, in pixels; None where it overflows."""
    camera, along = lens.camera, np.linspace(0, 1, BORDER_POINTS)
    zeros, ones = np.zeros(BORDER_POINTS), np.ones(BORDER_POINTS)
    x = np.concatenate([along, along, zeros, ones]) * lens.width
    y = np.concatenate([zeros, ones, along, along]) * lens.height
    with np.errstate(all="ignore"):
        moved_x, moved_y = lens.distort((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
        moved = float(np.hypot(moved_x - x, moved_y - y).max())
    return moved if np.isfinite(moved) else None


def _relative(file: Path, parts: Parts) -> str:
    return os.path.relpath(file, parts.path).replace(os.sep, "/")


def _repeated(names: Sequence[str], keys: Iterable[object]) -> list[list[str]]:
    """Names whose keys are equal, in groups of two and more."""
    groups = defaultdict(list)
    for name, key in zip(names, keys, strict=True):
        groups[key].append(name)
    return [group for group in groups.values() if len(group) > 1]


def _cameras(parts: Parts) -> list[CameraFacts]:
    grouped: dict[object, list[View]] = defaultdict(list)
    for view in parts.views:
        grouped[(view.lens or view.camera, parts.models.get(view.name))].append(view)
    found = []
    for views in grouped.values():
        lens, camera = views[0].lens, views[0].camera
        original = lens.camera if lens else camera
        model = parts.models.get(views[0].name) or (lens.model if lens else "PINHOLE")
        kept = camera.width * camera.height / (original.width * original.height)
        centred = 0 <= original.cx <= original.width and 0 <= original.cy <= original.height
        size, focal = (original.width, original.height), (original.fx, original.fy)
        found.append(CameraFacts(len(views), model, *size, focal, distortion(lens) if lens else 0.0, kept, centred))
    return sorted(found, key=lambda facts: -facts.views)


def _photographs(views: Sequence[View], missing: set[Path]) -> PhotographFacts:
    facts = PhotographFacts({}, [], {}, [], [], [], sum(view.mask_path is not None for view in views))
    decoded = decode_all(view for view in views if view.image_path not in missing)
    for view in views:
        files = {view.name: view.image_path, f"mask of {view.name}": view.mask_path}
        files[f"static mask of {view.name}"] = view.static_path
        for name, file in files.items():
            if file in decoded:
                _photograph(facts, view, name, file, decoded[file])
    return facts


def _photograph(facts: PhotographFacts, view: View, name: str, path: Path, file: ImageFile) -> None:
    """Note what there is to say about a view's photograph or mask."""
    camera = view.lens or view.camera
    if file.cut:
        facts.cut.append(name)
    elif file.size is None:
        facts.unreadable[name] = file.fault.removeprefix(f"{path}: ")
    elif file.fault and not fits(view, file.size):
        facts.misfits[name] = f"{file.size[0]}x{file.size[1]}, its camera {camera.width}x{camera.height}"
        if fits(view, file.size[::-1]):
            facts.on_side.append(name)
    else:
        turned = not fits(view, file.size)  # the reader rotates it
        if file.orientation > 1 and not turned:
            facts.exif_turned.append(name)
        if (file.size[::-1] if turned else file.size) != (camera.width, camera.height):
            facts.larger.append(name)
