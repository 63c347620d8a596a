"""Tell which kind of dataset a folder holds, and read it."""

from pathlib import Path

from clsplat.errors import DataError
from clsplat.scene.blender import read_blender
from clsplat.scene.colmap import find_models, read_colmap
from clsplat.scene.images import is_image
from clsplat.scene.multiscale import FILE, read_multiscale
from clsplat.scene.nerfstudio import read_nerfstudio
from clsplat.scene.scene import Scene

FILES = ("transforms_train.json", FILE, "transforms.json")  # besides COLMAP's


def holds_scene(path: Path) -> bool:
    """Whether a folder has cameras, of any kind that read_scene knows."""
    return bool(find_models(path)) or any((path / name).is_file() for name in FILES)


def read_scene(path: Path, holdout: int = 8) -> Scene:
    """Read a COLMAP, Blender (of one scale or several) or nerfstudio folder.

    `holdout` is for those that do not tell their test views.
    Raises DataError when it is none of these, or damaged.
    """
    if not path.is_dir():
        raise DataError(f"{path}: no such folder; expected the folder of a dataset")
    if find_models(path):
        return read_colmap(path, holdout)
    if (path / "transforms_train.json").is_file():
        return read_blender(path)
    if (path / FILE).is_file():
        return read_multiscale(path)
    if (path / "transforms.json").is_file():
        return read_nerfstudio(path, holdout)
    if any(is_image(file) for file in path.iterdir()):
        raise DataError(
            f"{path}: photographs without cameras; `clsplat run photos --scene {path}` finds where they were taken"
        )
    raise DataError(
        f"{path}: no dataset found; looked for COLMAP (sparse/0/cameras.bin or .txt), "
        "Blender (transforms_train.json, metadata.json) and nerfstudio (transforms.json)"
    )
