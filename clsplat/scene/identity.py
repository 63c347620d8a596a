"""What a scene is, whatever its folder is called: content hashes of its photographs, masks, cameras and points."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clsplat.scene.decoding import ImageFile
from clsplat.scene.scene import SPLITS, PointCloud, Scene
from clsplat.scene.view import View

MAX_NAMES = 3  # in a message
Row = dict[str, str]  # photograph, mask and camera of a view: hashes, "" where there is none; the time where it has one


@dataclass(frozen=True)
class Identity:
    """The views by split and name, in the order of the scene, and the points.

    Cameras and points count as they were read, so a file that was written again with the same numbers is the same.
    """

    train: dict[str, Row]
    test: dict[str, Row]
    points: str
    validation: dict[str, Row] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, files: Mapping[Path, ImageFile]) -> "Identity":
        """Return the identity of a scene whose image files were decoded."""
        train, test, fold = ({view.name: _row(view, files) for view in scene.split(name)} for name in SPLITS)
        return cls(train, test, _points_hash(scene.points) if scene.points else "", fold)

    def divided(self, scene: Scene) -> "Identity":
        """Return the identity of the same views in the splits of `scene`."""
        rows = self._rows
        train, test, fold = ({view.name: rows[view.name] for view in scene.split(name)} for name in SPLITS)
        return replace(self, train=train, test=test, validation=fold)

    @property
    def digest(self) -> str:
        """One hash of all that decides over the bits of a run: the order of the test views does not."""
        parts = [list(self.train.items()), sorted(self.test.items()), self.points]
        parts += [list(self.validation.items())] if self.validation else []
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def changes(self, before: "Identity") -> list[str]:
        """Return what is another than it was, with counts and the first few names: 'the photographs of 2 views (…)'."""
        found = []
        old, new = before._rows, self._rows
        for part in ("photograph", "mask", "camera", "time"):
            names = [name for name in old if name in new and old[name].get(part) != new[name].get(part)]
            found += [f"the {part} of {_named(names)}"] if names else []
        moved = [name for name in old if name in new and before._split_of(name) != self._split_of(name)]
        gone, fresh = [name for name in old if name not in new], [name for name in new if name not in old]
        found += [f"the split of {_named(moved)}"] if moved else []
        found += [f"{_named(gone)}, gone"] if gone else []
        found += [f"{_named(fresh)}, new"] if fresh else []
        if not (moved or gone or fresh) and list(self.train) != list(before.train):
            found.append("the order of the training views")
        return found + (["the points"] if self.points != before.points else [])

    @property
    def _rows(self) -> dict[str, Row]:
        return self.train | self.test | self.validation

    def _split_of(self, name: str) -> tuple[bool, bool]:
        return name in self.train, name in self.validation

    def data(self) -> dict[str, Any]:
        """Return the identity as plain data for JSON."""
        return {"digest": self.digest, **asdict(self)}

    @classmethod
    def from_data(cls, data: Any) -> "Identity":
        """Return what `data` returned.  Raises ValueError where it is damaged."""
        try:
            train, test, points = dict(data["train"]), dict(data["test"]), str(data["points"])
            found = cls(train, test, points, dict(data["validation"]))
            if found.digest == data["digest"]:
                return found
        except (KeyError, TypeError, ValueError):
            pass
        raise ValueError("damaged")


def _row(view: View, files: Mapping[Path, ImageFile]) -> Row:
    camera, lens = view.camera, view.lens
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, view.downscale]
    distortion = [lens.model, lens.width, lens.height, lens.whole, *map(float, lens.params)] if lens else []
    return {
        "photograph": files[view.image_path].digest if view.image_path in files else "",
        "mask": files[view.mask_path].digest if view.mask_path else "",
        "camera": _hash(numbers, view.world_to_camera, text=repr(distortion)),
        **({} if view.time is None else {"time": repr(view.time)}),
    }


def _points_hash(points: PointCloud) -> str:
    return _hash(points.positions, points.colours, *([] if points.times is None else [points.times]))


def _hash(*arrays: ArrayLike, text: str = "") -> str:
    """A hash of the values of arrays, in double precision and little-endian; -0 is 0."""
    state = hashlib.sha256(text.encode())
    for array in arrays:
        values = np.asarray(array, np.float64) + 0.0
        state.update(repr(values.shape).encode() + values.astype("<f8").tobytes())
    return state.hexdigest()


def _named(names: list[str]) -> str:
    more = ", …" if len(names) > MAX_NAMES else ""
    return f"{len(names)} view{'s' if len(names) > 1 else ''} ({', '.join(names[:MAX_NAMES])}{more})"
