"""Count the work of blending with both sizes of tiles: `python -m tests.support.tile_counts A B RUN …`, for scenes of
`clsplat bench`, and for trained models at six of their training views.

A line has the mean number of pairs of a view, the median and the longest list of its tiles, the pixels that one pass
computes, and the share of them inside the ellipse of the splat, where alpha is at least 1/255.
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from clsplat.conformance.bench.cases import NEAR, SIZES, synthetic_scene
from clsplat.gaussians.gaussians import Gaussians
from clsplat.opencl.device import Device, constants
from clsplat.pipeline.loading import load
from clsplat.render.camera import upload_camera
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.model_file import ModelFile
from clsplat.scene.quality import near_plane
from clsplat.scene.view import View

VIEWS, CHUNK = 6, 1 << 14
FIELDS = ("X", "Y", "XX", "XY", "YY", "POWER_MIN", "Y_MIN", "Y_MAX")


def inside_share(splats: np.ndarray, x: np.ndarray, y: np.ndarray, tile: int) -> float:
    """The share of the pixels of tiles that are inside the ellipses.  splats: [P, RECORD]; x, y: [P] corners, px."""
    names, offsets, inside = constants("splat.h"), np.arange(tile) + 0.5, 0
    columns = {name: splats[:, int(names[f"SPLAT_{name}"])] for name in FIELDS}
    for first in range(0, len(splats), CHUNK):
        part = slice(first, first + CHUNK)
        s = SimpleNamespace(**{name: column[part, None, None] for name, column in columns.items()})
        row = y[part, None, None] + offsets[:, None]
        dx, dy = s.X - (x[part, None, None] + offsets), s.Y - row
        power = -0.5 * (s.XX * dx * dx + s.YY * dy * dy) - s.XY * dx * dy
        inside += np.count_nonzero((power >= s.POWER_MIN) & (power <= 0) & (row >= s.Y_MIN) & (row <= s.Y_MAX))
    return inside / max(len(splats) * tile * tile, 1)


def count(device: Device, tables: dict[str, np.ndarray], views: list[View], near: float) -> list[float]:
    gaussians, rows = Gaussians(device, tables), []
    model = load("splat").settings.model.model_copy(update={"near": near}).model(gaussians, gaussians.sh_degree)
    rasterizer = Rasterizer(device, "radix")
    for view in views:
        camera = upload_camera(device, view)
        projection, lists = rasterizer._list_band(model, camera, rasterizer._split(camera)[0], "color")
        while not rasterizer.tiler.has_room(lists):
            projection, lists = rasterizer._list_band(model, camera, rasterizer._split(camera)[0], "color")
        lengths = np.diff(lists.tile_offset.get()[: camera.tiles + 1].astype(np.int64))
        splats = projection.splats.get()[lists.pair_splat.get()[lists.tile_pairs.get()[: lists.pairs]]]
        tiles = np.repeat(np.arange(camera.tiles), lengths)
        x, y = tiles % camera.tiles_x * camera.tile, tiles // camera.tiles_x * camera.tile
        share = inside_share(splats, x, y, camera.tile)
        rows.append([lists.pairs, np.median(lengths[lengths > 0]), lengths.max(), lists.pairs * camera.tile**2, share])
    return np.mean(rows, axis=0).tolist()


def main(names: list[str]) -> None:
    for name in names:
        if name in SIZES:
            tables, view = synthetic_scene(*SIZES[name])
            views, near = [view], NEAR
        else:
            model = ModelFile(Path(name))
            tables, views, near = model.gaussians.tables(), model.scene.split("train"), near_plane(model.scene)
            views = views[:: -(-len(views) // VIEWS)]
        for schedule in ("simt16", "simt"):
            pairs, median, longest, pixels, share = count(Device(None, schedule), dict(tables), views, near)
            print(
                f"{Path(name).name}, {len(tables['means']):,} Gaussians, {schedule}: {pairs:,.0f} pairs, lists "
                f"{median:.0f} and {longest:,.0f}, {pixels / 1e6:.1f} M pixels, {share:.0%} inside"
            )


if __name__ == "__main__":
    main(sys.argv[1:])
