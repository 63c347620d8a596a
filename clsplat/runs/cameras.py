"""The cameras of a dataset, or of the dataset of a run, as files of other programs."""

from pathlib import Path

from clsplat.core.errors import ConfigError
from clsplat.runs.model_file import ModelSource
from clsplat.runs.state import has_pipeline
from clsplat.scene.camera_files import write_cameras
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import HOLDOUT, Scene
from clsplat.training.modules.base import scene_beside


def write(scene: Path | Scene, out: Path, format_: str, images: str = "none") -> list[Path]:
    """Write the cameras; return the files.  scene: a dataset, in a folder or as read, or a run folder, whose
    cameras are those that it has learned.

    Raises ClsplatError.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: expected a folder to write into")
    return write_cameras(scene if isinstance(scene, Scene) else _read_with_poses(scene), out, format_, images)


def _read_with_poses(folder: Path) -> Scene:
    if not has_pipeline(folder):
        return read_scene(folder, HOLDOUT)
    source = ModelSource.of(folder, None)
    return scene_beside(source.file, read_scene(source.folder, source.settings.split))
