"""The demo scene: a still life, rendered by an analytic ray caster, so that every camera is known exactly.

    primary ray -> closest shape -> paint x (key light x shadow + sky x openness) -> mean of the pixel's samples

The z axis points up, the table top is z = 0.  Colours are linear light until `photograph` encodes them.  Points and
directions are [3, R], as in shapes.py.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from clsplat.errors import DataError, OutputError
from clsplat.files import is_there
from clsplat.reading import read_file
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud
from data_tools.shapes import Array, Shape, align, disc, dot, rotate, spiral, unit
from data_tools.still_life import SCENE, SCENE_RADIUS, SCENE_VERSION

LOOK_AT = np.array([0.0, 0.0, 0.08])  # scene units: the point in the middle of every image
CAMERA_DISTANCE = 3.75
CAMERA_ANGLE_X = 0.69  # field of view that just holds the table, radians
GRID = 4  # a pixel is the mean of GRID x GRID rays
BLOCK = 65536  # rays at a time, by measurement: smaller blocks cost calls, larger ones memory
SKIN = 1e-6  # secondary rays start this far above the surface
POINT_COUNT = 8000
POINT_NOISE = 0.002 * SCENE_RADIUS


# ---- light: one jittered shadow ray and one sky ray per sample; a pixel's GRID x GRID samples share the work

KEY_DIRECTION = unit(np.array([[0.45], [-0.62], [0.95]]))
KEY_LIGHT = np.array([[1.0], [0.95], [0.86]])
KEY_WIDTH = 0.11  # radius of the light over its distance
SKY_LIGHT = np.array([[0.36], [0.41], [0.50]])
BOUNCE = 0.45  # light on a shape that blocks the sky, over the skylight it blocks


def trace(origins: Array, directions: Array) -> tuple[Array, NDArray[np.intp]]:
    """Distance to the closest shape (inf = miss) and its index in SCENE, both [R]."""
    distance = np.full(np.broadcast_shapes(origins.shape, directions.shape)[1], np.inf)
    index = np.zeros(distance.shape, np.intp)
    for i, shape in enumerate(SCENE):
        here = shape.intersect(origins, directions)
        index[here < distance] = i
        distance = np.minimum(distance, here)
    return distance, index


def by_shape(of: Callable[[Shape, Array], Array], index: NDArray[np.intp], points: Array) -> Array:
    """Evaluate `Shape.normal` or `Shape.texture` at points, each on the shape that it lies on, [3, R]."""
    out = np.zeros(points.shape)
    for i in np.unique(index):
        here = np.flatnonzero(index == i)
        out[:, here] = of(SCENE[i], points[:, here])
    return out


def shade(points: Array, index: NDArray[np.intp], sample: int) -> Array:
    """Light that surface points send out, seen by the `sample`-th shadow ray and sky ray of GRID x GRID, [3, R]."""
    count = GRID * GRID
    lamp, sky = disc(count)[:, [sample * 7 % count, sample * 5 % count]].T  # far apart in neighbouring samples
    normal = by_shape(Shape.normal, index, points)
    start = points + SKIN * normal
    to_key = unit(align(KEY_DIRECTION, KEY_WIDTH * lamp[0], KEY_WIDTH * lamp[1], 1.0))
    lit = np.isinf(trace(start, to_key)[0]) * np.maximum(dot(KEY_DIRECTION, normal), 0)
    to_sky = align(normal, sky[0], sky[1], np.sqrt(1 - dot(sky, sky)))
    distance, blocker = trace(start, to_sky)
    light = SKY_LIGHT * (0.75 + 0.25 * normal[2])
    near = np.flatnonzero(np.isfinite(distance))
    there = start[:, near] + distance[near] * to_sky[:, near]
    light[:, near] *= BOUNCE * by_shape(Shape.texture, blocker[near], there)
    return np.asarray(by_shape(Shape.texture, index, points) * (KEY_LIGHT * lit + light))


# ---- cameras


def camera_pose(direction: Array) -> Array:
    """Camera-to-world [4, 4] in OpenGL axes of the camera that sees LOOK_AT from `direction` [3]."""
    right = unit(np.cross([0.0, 0.0, 1.0], direction))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(direction, right), direction, LOOK_AT + CAMERA_DISTANCE * direction], axis=1)
    return pose


def camera_rays(pose: Array, size: int, x: Array, y: Array) -> tuple[Array, Array]:
    """Origin [3, 1] and unit directions [3, R] of the rays through image positions x, y (pixels)."""
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    through = np.array([(x - 0.5 * size) / focal, (0.5 * size - y) / focal, np.full(x.shape, -1.0)])
    return pose[:3, 3:], unit(rotate(pose[:3, :3], through))


def photograph(pose: Array, size: int) -> NDArray[np.uint8]:
    """Render one view, [size, size, 4] RGBA: colours with gamma 2 (close to sRGB), alpha = covered share."""
    rows = max(1, BLOCK // size)
    return np.concatenate([expose(pose, size, range(r, min(r + rows, size))) for r in range(0, size, rows)])


def expose(pose: Array, size: int, rows: range) -> NDArray[np.uint8]:
    """Render some rows of a view, [rows, size, 4] RGBA."""
    y, x = (v.ravel() for v in np.meshgrid(np.array(rows, float), np.arange(float(size)), indexing="ij"))
    colour, cover = np.zeros((3, len(x))), np.zeros(len(x))
    for sample in range(GRID * GRID):
        down, right = divmod(sample, GRID)
        origin, directions = camera_rays(pose, size, x + (right + 0.5) / GRID, y + (down + 0.5) / GRID)
        distance, index = trace(origin, directions)
        hit = np.flatnonzero(np.isfinite(distance))
        light = shade(origin + distance[hit] * directions[:, hit], index[hit], sample)
        colour[:, hit] += np.sqrt(np.minimum(light, 1))  # encode first: readers average encoded values when they resize
        cover[hit] += 1
    rgba = np.vstack([colour / np.maximum(cover, 1), cover / GRID**2])
    return np.rint(255 * rgba).astype(np.uint8).T.reshape(len(rows), size, 4)


# ---- the folder


@dataclass(frozen=True)
class Options:
    """Options of the data set: image size in pixels, numbers of views, seed of the surface points."""

    size: int = 256
    train: int = 60
    test: int = 12
    seed: int = 0

    def poses(self) -> dict[str, list[Array]]:
        """Camera-to-world matrices of each split; the test cameras stand between the training ones."""
        train, test = spiral(self.train, 10, 70), spiral(self.test, 14, 66, phase=3.0)
        return {"train": [camera_pose(d) for d in train], "test": [camera_pose(d) for d in test]}

    def manifest(self) -> str:
        """The text of OUT/synthetic.json, which identifies a finished data set."""
        return json.dumps({"scene": SCENE_VERSION, **asdict(self)}) + "\n"


def write_dataset(out: Path, options: Options, workers: int | None = None) -> str:
    """Make folder `out`, all of it or nothing, and return a line of text about it.

    `workers` processes share the views (default: one per core; 1 = this process).  Raises DataError when `out` exists
    and is another data set, OutputError when it cannot be written.
    """
    if is_there(out):
        if is_complete(out, options):
            return f"{out} is complete already: nothing to do"
        raise DataError(f"{out} exists and is not this data set; remove it or choose another folder")
    partial_out = out.parent / f".{out.name}.{os.getpid()}.partial"
    try:
        partial_out.mkdir(parents=True)
        count = fill(partial_out, options, workers or os.cpu_count() or 1)
        partial_out.rename(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot write the data set: {error}") from error
    finally:
        shutil.rmtree(partial_out, ignore_errors=True)
    return f"wrote {out}: {options.train} training and {options.test} test views, {options.size} px, {count:,} points"


def is_complete(out: Path, options: Options) -> bool:
    """Return whether `out` holds every file of the data set with these options."""
    manifest = out / "synthetic.json"
    if not manifest.exists() or read_file(manifest).decode(errors="replace") != options.manifest():
        return False
    files = [f"{split}/r_{i:03}.png" for split, poses in options.poses().items() for i in range(len(poses))]
    files += ["transforms_train.json", "transforms_test.json", "points3d.ply"]
    return all((out / name).is_file() for name in files)


def fill(out: Path, options: Options, workers: int) -> int:
    """Write images, cameras and points into `out`; return the number of points."""
    splits = options.poses()
    jobs = [(split, i, pose) for split, poses in splits.items() for i, pose in enumerate(poses)]
    images = photographs([pose for _, _, pose in jobs], options.size, min(workers, len(jobs)))
    rng = np.random.default_rng(options.seed)
    points = []
    for split in splits:
        (out / split).mkdir()
    for (split, i, pose), image in zip(jobs, track(images, "rendering", total=len(jobs)), strict=True):
        png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA))[1]
        (out / split / f"r_{i:03}.png").write_bytes(png.tobytes())
        if split == "train":
            points.append(surface_points(pose, image, -(-POINT_COUNT // options.train), rng))
    for split, poses in splits.items():
        (out / f"transforms_{split}.json").write_text(json.dumps(transforms(split, poses), indent=1) + "\n", "utf-8")
    positions, colours = (np.concatenate(parts).astype(np.float32) for parts in zip(*points, strict=True))
    write_points_ply(out / "points3d.ply", PointCloud(positions, colours))
    (out / "synthetic.json").write_text(options.manifest(), "utf-8")
    return len(positions)


def photographs(poses: list[Array], size: int, workers: int) -> Iterator[NDArray[np.uint8]]:
    """Render views in order, in processes: threads would wait for the interpreter between NumPy calls this short."""
    if workers == 1:
        yield from (photograph(pose, size) for pose in poses)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(partial(photograph, size=size), poses)


def surface_points(pose: Array, image: NDArray[np.uint8], count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return noisy surface points of a view, as from structure from motion: positions and colours, [M, 3]."""
    rows, columns = np.nonzero(image[..., 3] == 255)
    chosen = rng.integers(len(rows), size=count) if len(rows) else np.zeros(0, int)
    x, y = np.stack([columns[chosen], rows[chosen]]) + rng.random((2, len(chosen)))
    origin, directions = camera_rays(pose, len(image), x, y)
    distance, _ = trace(origin, directions)
    hit = np.isfinite(distance)
    positions = (origin + distance[hit] * directions[:, hit]).T
    colours = image[rows[chosen], columns[chosen], :3][hit] / 255
    return positions + POINT_NOISE * rng.standard_normal(positions.shape), colours


def transforms(split: str, poses: list[Array]) -> dict[str, object]:
    """Cameras of a split as the Blender data sets store them: camera-to-world, OpenGL axes."""
    frames = [{"file_path": f"./{split}/r_{i:03}", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    return {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
