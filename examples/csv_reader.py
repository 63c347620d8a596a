"""Train on cameras.csv: `clsplat --plugin csv_reader.py run splat_7k --scene DIR`.

A line for each photograph: its path below DIR, pose (world to camera, translation in scene units) and camera in px.
"""

import csv
from pathlib import Path

from clsplat import scene
from clsplat.errors import DataError

COLUMNS = "name,qw,qx,qy,qz,tx,ty,tz,fx,fy,cx,cy,width,height"


class CsvReader(scene.Reader):
    name, expects = "CSV", "cameras.csv"

    def matches(self, path: Path) -> bool:
        return (path / "cameras.csv").is_file()

    def read(self, path: Path, holdout: int) -> scene.Scene:
        file, views = path / "cameras.csv", []
        rows = csv.reader(scene.read_file(file).decode("utf-8-sig", "replace").splitlines())
        try:
            if next(rows, None) != COLUMNS.split(","):
                raise ValueError("other columns")
            for name, *pose, fx, fy, cx, cy, width, height in filter(None, rows):
                camera = scene.Camera(int(width), int(height), float(fx), float(fy), float(cx), float(cy)).check()
                matrix = scene.pose_matrix([float(q) for q in pose[:4]], [float(t) for t in pose[4:]])
                image = scene.inside(path, name, f"{file}: line {rows.line_num}")
                views.append(scene.View(name, camera, matrix, image))
        except (ValueError, csv.Error) as error:
            raise DataError(f"{file}: line {rows.line_num}: {error}; expected {COLUMNS}") from error
        scene.require_files(path, (view.image_path for view in views))
        return scene.make_scene(path, views, scene.every_nth([view.name for view in views], holdout), points=None)
