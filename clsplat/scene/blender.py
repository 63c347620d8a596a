"""Read the Blender datasets of NeRF: transforms_train.json and transforms_test.json."""

from pathlib import Path

from clsplat.scene.scene import Scene, make_scene
from clsplat.scene.transforms import Transforms


def read_blender(path: Path) -> Scene:
    """Read a Blender scene; the test views are those of transforms_test.json, none where that is missing.

    Raises DataError when a file is missing, damaged or not supported.
    """
    transforms = Transforms(path / "transforms_train.json")
    train, test_file = transforms.views(), path / "transforms_test.json"
    test = Transforms(test_file).views() if test_file.is_file() else []
    held_out = set(range(len(train), len(train) + len(test)))
    # NeRF and every paper since show these sets on white.
    return make_scene(path, train + test, held_out, transforms.points(), background="white")
