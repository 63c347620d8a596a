"""Read nerfstudio and instant-ngp datasets: one transforms.json."""

import logging
from dataclasses import replace
from pathlib import Path

from clsplat.errors import DataError, quoted
from clsplat.scene.parts import Parts
from clsplat.scene.readers import Reader
from clsplat.scene.scene import Scene, every_nth, make_scene
from clsplat.scene.times import clock_of
from clsplat.scene.transforms import Transforms, list_frames, view_name

FILE = "transforms.json"
logger = logging.getLogger("clsplat")


class NerfstudioReader(Reader):
    """A nerfstudio scene; views are in order of name.

    The lists `train_filenames` and `test_filenames` are the split where the file has one of them; images on neither
    list are left out.  Otherwise every `holdout`-th view is for testing.  With a `time` in every frame the scene moves.
    """

    name = "nerfstudio"
    expects = FILE

    def matches(self, path: Path) -> bool:
        return (path / FILE).is_file()

    def read(self, path: Path, holdout: int) -> Scene:
        transforms = Transforms(path / FILE)
        clock = clock_of(transforms.path, transforms.moments())
        views = sorted(transforms.views(self.missing, clock), key=lambda view: view.name)
        train, test = (_listed(transforms, key) for key in ("train_filenames", "test_filenames"))
        if train is None and test is None:
            scene = make_scene(path, views, every_nth([view.name for view in views], holdout), transforms.points(clock))
            return replace(scene, skipped=transforms.skipped)
        test = test or set()
        kept = views if train is None else [view for view in views if view.name in train | test]
        if len(kept) < len(views):
            logger.info("%s: left out %d images that no split lists", transforms.path, len(views) - len(kept))
        held_out = {i for i, view in enumerate(kept) if view.name in test}
        return replace(make_scene(path, kept, held_out, transforms.points(clock)), skipped=transforms.skipped)

    def list_parts(self, parts: Parts) -> None:
        list_frames(parts, FILE)


def _listed(transforms: Transforms, key: str) -> set[str] | None:
    """Return the view names of a list of file paths, or None where there is none.  Raises DataError."""
    entries = transforms.table.get(key)
    if entries is None:
        return None
    if not isinstance(entries, list) or not all(isinstance(entry, str) for entry in entries):
        raise DataError(f"{transforms.path}: {key} is not a list of file paths; export the file again")
    names = {view_name(entry) for entry in entries}
    unknown = sorted(names - {view_name(path) for frame in transforms.frames if (path := frame.value("file_path"))})
    if unknown:
        raise DataError(
            f"{transforms.path}: {key} lists {quoted(unknown[0])}, which no frame has; remove it from the list"
        )
    return names
