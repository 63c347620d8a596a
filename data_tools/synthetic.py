"""Write datasets of ray-cast scenes with exact cameras, such as the still life."""

import json
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import new_folder, path_exists, raising_output_error, sync_below
from clsplat.core.progress import counted
from clsplat.core.reading import read_file
from clsplat.scene.images import write_image
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud

from .casting import World, camera_pose
from .shapes import Array, spiral
from .still_life import SCENE, SCENE_RADIUS, SCENE_VERSION

View = TypeVar("View")
LOOK_AT = np.array([0.0, 0.0, 0.08])  # scene units: the point at the center of every image
CAMERA_DISTANCE = 3.75
POINT_COUNT = 8000
POINT_NOISE = 0.002 * SCENE_RADIUS
STILL_LIFE = World(SCENE, camera_angle_x=0.69, grid=4)  # the field of view just covers the table


@dataclass(frozen=True)
class SyntheticOptions:
    """Options of a dataset: image size in pixels, number of views per split, and seed of the surface points."""

    size: int = 256
    train: int = 60
    test: int = 12
    seed: int = 0

    version = SCENE_VERSION
    points = POINT_COUNT
    noise = POINT_NOISE  # standard deviation of the points, scene units

    @property
    def world(self) -> World:
        """The scene to render."""
        return STILL_LIFE

    def poses(self) -> dict[str, list[Array]]:
        """Return the camera-to-world matrices of each split; test cameras are between training cameras."""
        splits = {"train": spiral(self.train, 10, 70), "test": spiral(self.test, 14, 66, phase=3.0)}
        return {
            split: [camera_pose(LOOK_AT + CAMERA_DISTANCE * direction, direction) for direction in directions]
            for split, directions in splits.items()
        }

    def manifest(self) -> str:
        """Return the content of OUT/synthetic.json, which identifies a complete dataset."""
        return json.dumps({"scene": self.version, **asdict(self)}) + "\n"

    def images(self) -> list[str]:
        """Return the paths of all images of a complete dataset, relative to its folder."""
        return [f"{split}/r_{i:03}.png" for split, poses in self.poses().items() for i in range(len(poses))]

    def write_files(self, out: Path, workers: int) -> str:
        """Write images, cameras, and points to `out`, and return a summary."""
        count = write_files(out, self, workers)
        return f"{self.train} training and {self.test} test views, {self.size} px, {count:,} points"


def write_dataset(out: Path, options: SyntheticOptions, workers: int | None = None) -> str:
    """Write a dataset to the folder `out`, and return a summary.  After an error, no incomplete folder remains.

    workers: number of processes that render the views; default: the number of cores; 1 renders in this process

    Raises DataError if `out` contains another dataset, and OutputError if it cannot be written.
    """
    if path_exists(out):
        if is_complete(out, options):
            return f"{out} is already complete"
        raise DataError(f"{out}: already contains another dataset; remove it or choose another folder")
    with new_folder(out) as partial_out, raising_output_error(out):
        text = options.write_files(partial_out, workers or os.cpu_count() or 1)
        (partial_out / "synthetic.json").write_text(options.manifest(), "utf-8")
        sync_below(partial_out)
    return f"wrote {out}: {text}"


def is_complete(out: Path, options: SyntheticOptions) -> bool:
    """Return whether `out` contains all files of a dataset with these options."""
    manifest = out / "synthetic.json"
    if not manifest.exists() or read_file(manifest).decode(errors="replace") != options.manifest():
        return False
    files = [*options.images(), "transforms_train.json", "transforms_test.json", "points3d.ply"]
    return all((out / name).is_file() for name in files)


def write_files(out: Path, options: SyntheticOptions, workers: int) -> int:
    """Write images, cameras, and points into `out`; return the number of points."""
    splits = options.poses()
    jobs = [(split, i, pose) for split, poses in splits.items() for i, pose in enumerate(poses)]
    world = options.world
    images = photographs(partial(world.photograph, size=options.size), [pose for _, _, pose in jobs], workers)
    rng = np.random.default_rng(options.seed)
    points = []
    for (split, i, pose), image in zip(jobs, counted(images, "images rendered", len(jobs)), strict=True):
        write_image(out / split / f"r_{i:03}.png", image)
        if split == "train":
            points.append(surface_points(world, pose, image, -(-options.points // options.train), options.noise, rng))
    for split, poses in splits.items():
        frames = [{"file_path": f"./{split}/r_{i:03}", "transform_matrix": p.tolist()} for i, p in enumerate(poses)]
        write_transforms(out / f"transforms_{split}.json", world, frames)
    positions, colors = (np.concatenate(parts).astype(np.float32) for parts in zip(*points, strict=True))
    write_points_ply(out / "points3d.ply", PointCloud(positions, colors))
    return len(positions)


def photographs(
    render: Callable[[View], NDArray[np.uint8]], views: Sequence[View], workers: int
) -> Iterator[NDArray[np.uint8]]:
    """Render views in order, in several processes, because threads would wait for the GIL between short NumPy calls."""
    workers = min(workers, len(views))
    if workers == 1:
        yield from map(render, views)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_exit_with_parent) as pool:
        yield from pool.map(render, views)


def _exit_with_parent() -> None:
    """Exit this worker process when its parent exits; otherwise an idle worker would wait forever."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)


def write_transforms(path: Path, world: World, frames: list[dict[str, Any]]) -> None:
    """Write the cameras of a split in the format of Blender datasets: camera-to-world matrices in OpenGL axes."""
    table = {"camera_angle_x": world.camera_angle_x, "frames": frames}
    path.write_text(json.dumps(table, indent=1) + "\n", "utf-8")


def surface_points(
    world: World, pose: Array, image: NDArray[np.uint8], count: int, noise: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return the positions and colors, both [M, 3], of noisy points on the surfaces in a view.

    The points imitate those of structure from motion.

    count: number of rays through opaque pixels; M is smaller if rays miss
    noise: standard deviation of each coordinate, scene units
    """
    rows, columns = np.nonzero(image[..., 3] == 255)
    pixels = rng.integers(len(rows), size=count) if len(rows) else np.zeros(0, int)
    x, y = np.stack([columns[pixels], rows[pixels]]) + rng.random((2, len(pixels)))
    origin, directions = world.camera_rays(pose, len(image), x, y)
    distance, _ = world.trace(origin, directions)
    hit = np.isfinite(distance)
    positions = (origin + distance[hit] * directions[:, hit]).T
    colors = image[rows[pixels], columns[pixels], :3][hit] / 255
    return positions + noise * rng.standard_normal(positions.shape), colors
