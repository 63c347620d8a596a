"""Read the Blender datasets of NeRF: transforms_train.json and transforms_test.json."""

from pathlib import Path

from clsplat.scene.parts import Parts
from clsplat.scene.readers import Reader
from clsplat.scene.scene import Scene, make_scene
from clsplat.scene.transforms import Transforms, list_frames

TRAIN, TEST = "transforms_train.json", "transforms_test.json"


class BlenderReader(Reader):
    """A Blender scene; the test views are those of transforms_test.json, none where that is missing."""

    name = "Blender"
    expects = TRAIN

    def matches(self, path: Path) -> bool:
        return (path / TRAIN).is_file()

    def read(self, path: Path, holdout: int) -> Scene:
        transforms = Transforms(path / TRAIN)
        train = transforms.views()
        test = Transforms(path / TEST).views() if (path / TEST).is_file() else []
        held_out = set(range(len(train), len(train) + len(test)))
        # NeRF and every paper since show these sets on white.
        return make_scene(path, train + test, held_out, transforms.points(), background="white")

    def list_parts(self, parts: Parts) -> None:
        list_frames(parts, TRAIN, TEST)
