"""Train on cameras.csv: `clsplat --plugin csv_reader.py run splat_7k --scene DIR`.

One line per photo: its path relative to DIR, its pose (world to camera, in scene units), and its camera in px.
"""

import csv
from pathlib import Path

from clsplat import plugin

COLUMNS = "name,qw,qx,qy,qz,tx,ty,tz,fx,fy,cx,cy,width,height"


class CsvReader(plugin.Reader):
    name, expects = "CSV", "cameras.csv"

    def matches(self, path: Path) -> bool:
        return (path / "cameras.csv").is_file()

    def read(self, path: Path, holdout: int) -> plugin.Scene:
        file, views = path / "cameras.csv", []
        rows = csv.reader(plugin.read_file(file).decode("utf-8-sig", "replace").splitlines())
        try:
            if next(rows, None) != COLUMNS.split(","):
                raise ValueError("other columns")
            for name, *pose, fx, fy, cx, cy, width, height in filter(None, rows):
                camera = plugin.Camera(int(width), int(height), float(fx), float(fy), float(cx), float(cy)).check()
                matrix = plugin.pose_matrix([float(q) for q in pose[:4]], [float(t) for t in pose[4:]])
                image = plugin.safe_join(path, name, f"{file}: line {rows.line_num}")
                views.append(plugin.View(name, camera, matrix, image))
        except (ValueError, csv.Error) as error:
            raise plugin.DataError(f"{file}: line {rows.line_num}: {error}; expected {COLUMNS}") from error
        plugin.require_files(path, (view.image_path for view in views))
        return plugin.make_scene(path, views, plugin.every_nth([view.name for view in views], holdout), points=None)
