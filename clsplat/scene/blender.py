"""Read the Blender datasets of NeRF and D-NeRF: transforms_train.json and transforms_test.json."""

from dataclasses import replace
from pathlib import Path

from clsplat.scene.parts import Parts
from clsplat.scene.readers import Reader
from clsplat.scene.scene import Scene, make_scene
from clsplat.scene.times import clock_of
from clsplat.scene.transforms import Transforms, list_frames

TRAIN_FILE, TEST_FILE = "transforms_train.json", "transforms_test.json"


class BlenderReader(Reader):
    """A Blender scene; the test views are those of transforms_test.json, none where that is missing.

    With a `time` in every frame of both files it moves (D-NeRF): the first moment of all frames is 0, the last 1.
    """

    name = "Blender"
    expects = TRAIN_FILE

    def matches(self, path: Path) -> bool:
        return (path / TRAIN_FILE).is_file()

    def read(self, path: Path, holdout: int) -> Scene:
        transforms = Transforms(path / TRAIN_FILE)
        held = Transforms(path / TEST_FILE) if (path / TEST_FILE).is_file() else None
        clock = clock_of(path, transforms.moments() + (held.moments() if held else []))
        train = transforms.views(self.missing, clock)
        test = held.views(self.missing, clock) if held else []
        held_out = set(range(len(train), len(train) + len(test)))
        # NeRF and later papers render these scenes on white.
        scene = make_scene(path, train + test, held_out, transforms.points(clock), background="white")
        return replace(scene, skipped=transforms.skipped + (held.skipped if held else ()))

    def list_parts(self, parts: Parts) -> None:
        list_frames(parts, TRAIN_FILE, TEST_FILE)
