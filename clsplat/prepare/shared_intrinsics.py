"""Group photographs that were taken with the same camera, by their EXIF data and size."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from clsplat.core.errors import pluralize
from clsplat.scene.images import read_exif_optics, read_header

Cameras = Literal["auto", "one", "per_folder", "per_image"]
Key = Callable[[Path, str], object]
KEYS: dict[Cameras, Key] = {  # photographs of the same size share a camera if these keys are equal
    "auto": lambda images, name: read_exif_optics(images / name),
    "one": lambda images, name: None,
    "per_folder": lambda images, name: Path(name).parent,
    "per_image": lambda images, name: name,
}


def group_photos(images: Path, names: Sequence[str], cameras: Cameras) -> list[list[str]]:
    """Return groups of photographs that share a camera, sorted by the first name in each; names in a group are sorted.

    Raises DataError when a photograph cannot be read.
    """
    groups: dict[object, list[str]] = defaultdict(list)
    for name in sorted(names):
        header = read_header(images / name)
        groups[header.width, header.height, KEYS[cameras](images, name)].append(name)
    return list(groups.values())


def shared_camera_note(images: Path, groups: Sequence[Sequence[str]]) -> str:
    """Return a sentence about photographs that share a camera because EXIF lacks a lens, or "" if there are none."""
    unknown_groups = [group for group in groups if len(group) > 1 and read_exif_optics(images / group[0]) is None]
    if not unknown_groups:
        return ""
    return (
        f"{sum(map(len, unknown_groups))} photos have no lens data in EXIF, so those of the same size share a "
        f"camera ({pluralize(len(unknown_groups), 'camera')} in total); --set find_features.cameras=per_image "
        "calibrates each one"
    )
