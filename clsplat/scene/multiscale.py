"""Read the multi-scale Blender datasets of mip-NeRF: one metadata.json, every photograph at several sizes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.errors import DataError, quoted
from clsplat.reading import read_json
from clsplat.scene.images import present
from clsplat.scene.parts import Parts
from clsplat.scene.points import read_ply_table, read_points_ply
from clsplat.scene.readers import Reader
from clsplat.scene.scene import Scene, View, make_scene
from clsplat.scene.transforms import MAX_BYTES, MAX_FRAMES, Frame, camera_of, image_path_of, pose_of, view_name

FILE, POINTS = "metadata.json", "points3d.ply"
COLUMNS = ("file_path", "cam2world", "width", "height", "focal", "label")  # one value for each image


class MultiscaleReader(Reader):
    """A multi-scale Blender scene; an image of label j shows 1/2^j of the full size."""

    name = "multi-scale Blender"
    expects = FILE

    def matches(self, path: Path) -> bool:
        return (path / FILE).is_file()

    def read(self, path: Path, holdout: int) -> Scene:
        splits = read_json(path / FILE, limit=MAX_BYTES)
        train, test = (_views(path / FILE, splits, name) for name in ("train", "test"))
        there = present(path, [view.image_path for view in train + test], self.missing)
        skipped = tuple(view.name for view, found in zip(train + test, there, strict=True) if not found)
        test = [view for view, found in zip(test, there[len(train) :], strict=True) if found]
        train = [view for view, found in zip(train, there[: len(train)], strict=True) if found]
        points = path / POINTS
        held_out = set(range(len(train), len(train) + len(test)))
        cloud = read_points_ply(points) if points.is_file() else None
        return replace(make_scene(path, train + test, held_out, cloud, background="white"), skipped=skipped)

    def list_parts(self, parts: Parts) -> None:
        super().list_parts(parts)
        points = parts.path / POINTS
        parts.points = parts.attempt(read_ply_table, points) if points.is_file() else None


def _views(path: Path, splits: Any, name: str) -> list[View]:
    table = splits.get(name) if isinstance(splits, dict) else None
    columns: list[Any] = [table.get(column) for column in COLUMNS] if isinstance(table, dict) else [None]
    if not all(isinstance(column, list) for column in columns) or len(set(map(len, columns))) > 1:
        raise DataError(f"{path}: '{name}' lacks lists of one length called {', '.join(COLUMNS)}; make it again")
    if len(columns[0]) > MAX_FRAMES:
        raise DataError(f"{path}: '{name}' has {len(columns[0])} images; expected at most {MAX_FRAMES}")
    views = []
    for i, (file, pose, width, height, focal, label) in enumerate(zip(*columns, strict=True)):
        values = {"file_path": file, "transform_matrix": pose, "w": width, "h": height, "fl_x": focal, "label": label}
        frame = Frame(path.parent, f"{path}: {name}[{i}]", values)
        level = frame.number("label")
        if level is None or not 0 <= level <= 8 or level % 1:
            raise DataError(
                f"{frame.where}: label is {quoted(label)}; expected the number of its halvings, 0 to 8: make it again"
            )
        image = image_path_of(frame)
        view = View(view_name(file), camera_of(frame, None), pose_of(frame), image, downscale=2**level)
        views.append(view)
    return views
